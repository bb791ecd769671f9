# SPDX-License-Identifier: Apache-2.0
"""The project's own elementary functions (shared/math.h, shared/lanes.h) through probe.cl."""

from __future__ import annotations

import numpy as np
from numpy.typing import NDArray
from pipeline import shaped

from clsplat.device.buffers import allocate, upload
from clsplat.device.context import Device
from clsplat.device.launch import launch_grid


def probe(device: Device, x: NDArray[np.float32]) -> NDArray[np.float32]:
    """exp1, log2_1, sigmoid1 and exp2L of x, (4, n)."""
    n = len(x)
    out = allocate(device, (4, n), np.float32)
    launch_grid(device, device.kernels("probe").probe_elementary, (n,), upload(device, x), out, n)
    result: NDArray[np.float32] = out.get()
    return result


def test_the_same_bits_in_every_shape(device: Device) -> None:
    x = np.linspace(-8, 8, 4001, dtype=np.float32)
    frames = [probe(shaped(device, lanes, 1), x) for lanes in (1, 4, 8)]
    for other in frames[1:]:
        np.testing.assert_array_equal(frames[0].view(np.uint32), other.view(np.uint32))


def test_multiply_add_has_one_rounding(shaped_device: Device) -> None:
    lanes = shaped_device.shape.lanes
    out = allocate(shaped_device, (2 * lanes,), np.float32)
    factor = float(np.float32(1 + 2.0**-12))
    launch_grid(shaped_device, shaped_device.kernels("probe").probe_fma, (1,), out, factor, -(1 + 2.0**-11))
    np.testing.assert_array_equal(out.get(), np.float32(2.0**-24))


def test_every_finite_half(shaped_device: Device) -> None:
    bits = np.arange(2**16, dtype=np.uint16)
    bits = bits[np.isfinite(bits.view(np.float16))]
    out = allocate(shaped_device, (len(bits), 4), np.float32)
    launch_grid(
        shaped_device, shaped_device.kernels("probe").probe_half, (len(bits),), upload(shaped_device, bits), out
    )
    wanted = np.repeat(bits.view(np.float16).astype(np.float32)[:, None], 4, axis=1)
    np.testing.assert_array_equal(out.get().view(np.uint32), wanted.view(np.uint32))
