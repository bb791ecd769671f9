# SPDX-License-Identifier: Apache-2.0
"""Launches peak.cl: the device's peak rates of arithmetic and copies, to which `clsplat bench` compares the stages."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from clsplat.device.buffers import allocate, upload
from clsplat.device.context import Device
from clsplat.device.launch import launch_groups, launch_items
from clsplat.layouts.columns import SPLAT, TILE
from clsplat.stages.blend import tile_items

_PEAK_SPLATS = 64
_GROUPS_PER_COMPUTE_UNIT = {"cpu": 4, "gpu": 32, "other": 32}
"""Groups per compute unit of a measurement, by kind of device: enough to keep all compute units busy until the end."""
_COPY_BYTES = 256 * 2**20


@dataclass(frozen=True)
class Limits:
    """The peak rates of a device.

    pairs_per_second, gradient_pairs_per_second: pairs of a Gaussian and a pixel in the arithmetic of blending and of
        its gradient, without memory traffic and with every lane in use.
    copy_bytes_per_second: bytes read plus bytes written by a copy too large for the caches.
    lanes, items: the kernel shape of all measurements.
    """

    pairs_per_second: float
    gradient_pairs_per_second: float
    copy_bytes_per_second: float
    lanes: int
    items: int


def measure_limits(
    device: Device, *, seconds: float = 0.1, repeat: int = 5, copy_bytes: int = _COPY_BYTES, widened: bool = True
) -> Limits:
    """Measure the device's peak rates (`Limits`): of each rate, the best of `repeat` runs.

    seconds: approximate duration of each run of arithmetic.
    copy_bytes: size of the array that is copied, in bytes. It is smaller if the device has too little memory.
    widened: True uses vectors of 16 lanes where blending does. False always uses the lanes of the kernel shape.
    """
    items = tile_items(device)
    defines = {} if widened else {"NARROW": True}
    return Limits(
        _pairs_per_second(device, "limit_blend", items, seconds, repeat, defines),
        _pairs_per_second(device, "limit_blend_grad", items, seconds, repeat, defines),
        _copy_rate(device, copy_bytes, repeat),
        device.shape.lanes,
        items,
    )


def _splats() -> NDArray[np.float32]:
    """Splats for the measurement of arithmetic: all different and faint, and wide enough to cover a whole tile."""
    index = np.arange(_PEAK_SPLATS)
    splats = np.zeros((_PEAK_SPLATS, len(SPLAT)), np.float32)
    columns = {"L11": 0.02, "L12": 0.005, "L22": 0.02, "RED": 0.3, "GREEN": 0.5, "BLUE": 0.7}
    for name, value in columns.items():
        splats[:, SPLAT.index(name)] = value + 1e-4 * index
    splats[:, SPLAT.index("PIXEL_X")] = splats[:, SPLAT.index("PIXEL_Y")] = index % TILE
    splats[:, SPLAT.index("LOG2O")] = -6.0
    return splats


def _pairs_per_second(
    device: Device, name: str, items: int, seconds: float, repeat: int, defines: Mapping[str, object]
) -> float:
    kernel = getattr(device.kernels("peak", {"ITEMS": items, **defines}), name)
    groups = _GROUPS_PER_COMPUTE_UNIT[device.kind] * int(device.cl_device.max_compute_units)
    splats = upload(device, _splats())
    sums = allocate(device, (groups * items,), np.float32)

    def run(rounds: int) -> float:
        _, ms = device.timed(lambda: launch_groups(device, kernel, groups, items, rounds, splats, sums))
        return 1e-3 * ms

    run(64)
    rounds = 256
    while (taken := run(rounds)) < seconds / 2 and rounds < 2**24:
        rounds = min(2 * rounds if taken < seconds / 16 else int(rounds * seconds / taken), 2**24)
    pairs = groups * rounds * TILE * TILE
    return max(pairs / run(rounds) for _ in range(repeat))


def _copy_rate(device: Device, nbytes: int, repeat: int) -> float:
    copied = max(device.shape.lanes, 4)  # elements per work-item: a GPU keeps its memory busy by loads of 16 bytes
    n = min(nbytes, device.max_allocation // 4, device.budget // 4) // 4 // copied * copied
    source, copy = allocate(device, (n,), np.float32), allocate(device, (n,), np.float32)
    source.fill(1.0)
    copy.fill(0.0)  # so that the host maps the memory's pages before the measurement
    kernel = device.kernels("peak", {"ITEMS": tile_items(device), "NARROW": True}).limit_copy
    runs = [device.timed(lambda: launch_items(device, kernel, n // copied, n, source, copy)) for _ in range(repeat + 1)]
    return 8e3 * n / min(ms for _, ms in runs)
