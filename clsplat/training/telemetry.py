# SPDX-License-Identifier: Apache-2.0
"""Notes of a training in metrics.jsonl for its report: device and versions, time of each stage, contributions."""

from __future__ import annotations

import os
import platform
import time
from collections.abc import Callable
from contextlib import suppress
from datetime import datetime, timezone
from importlib.metadata import PackageNotFoundError, version
from typing import TYPE_CHECKING, Any, TypeVar

import numpy as np
from numpy.typing import NDArray

import clsplat
from clsplat.device import cl
from clsplat.device.context import Device
from clsplat.errors import CapacityError
from clsplat.rendering.contributions import sums_of_weights
from clsplat.stages.device_gaussians import HostGaussians

if TYPE_CHECKING:
    from clsplat.training.trainer import Trainer

T = TypeVar("T")

PACKAGES = ("numpy", "pyopencl", "OpenImageIO", "scipy", "scikit-image")
SECONDS = 1.0
"""Seconds in which training views are looked at for contributions, beside the first."""
EDGES = tuple(float(edge) for edge in np.round(np.arange(-3.0, 5.01, 0.2), 1))
"""Powers of ten of pixels, between the bins of contributions."""


def session(device: Device, step: int) -> dict[str, Any]:
    """Record of the machine that trains, from `step` on. No name of a user, host or folder: reports are sent to
    others."""
    versions = {"clsplat": clsplat.__version__, "Python": platform.python_version()}
    for package in PACKAGES:
        with suppress(PackageNotFoundError):
            versions[package] = version(package)
    return {
        "from_step": step,
        "started": datetime.now(timezone.utc).isoformat(timespec="seconds"),
        "device": device.name,
        "driver": device.driver,
        "kind": device.kind,
        "shape": device.shape.words,
        "memory_limit": device.memory.limit,
        "system": f"{platform.system()} {platform.machine()}, {os.cpu_count()} cores",
        "versions": versions,
    }


def timed(device: Device, work: Callable[[], T]) -> tuple[T, dict[str, float]]:
    """The result, and milliseconds of each stage, "other" for what is in none and "all" for everything.

    Wall time from an idle device to an idle device, so that launches are in it and no queue needs profiling. Only for
    this once: waiting at every seam takes the overlap of host and device away.
    """
    with device.recorder.recording(wait=True) as stages:
        result, total = device.timed(work)
    times = {name: record.wall_ms for name, record in stages.items() if record.wall_ms > 0}
    return result, {**times, "other": max(total - sum(times.values()), 0.0), "all": total}


def contributions(trainer: Trainer, seconds: float = SECONDS) -> dict[str, Any] | None:
    """A histogram of `largest_contributions`: `none` counts those that none shows, `counts` those between `edges`,
    powers of ten of pixels; the first and last take what is beyond. None where memory is limited, as that was planned
    for training alone."""
    if trainer.device.memory.limit is not None or isinstance(trainer.parameters, HostGaussians):
        return None
    try:
        largest, looked = largest_contributions(trainer, seconds)
    except (CapacityError, cl.MemoryError):
        return None
    seen = largest[np.isfinite(largest) & (largest > 0)]
    powers = np.clip(np.log10(seen.astype(np.float64)), EDGES[0], EDGES[-1])
    counts, _ = np.histogram(powers, EDGES)
    return {
        "views": looked,
        "of": len(trainer.views),
        "none": len(largest) - len(seen),
        "edges": list(EDGES),
        "counts": counts.tolist(),
    }


def largest_contributions(trainer: Trainer, seconds: float = SECONDS) -> tuple[NDArray[np.float32], int]:
    """Largest contribution of each Gaussian (n,) to one of the views (`sums_of_weights`), and the number of views.

    It looks at as many training views, spread evenly, as `seconds` allow. Changes nothing that training goes by. Raises
    CapacityError.
    """
    rasterizer, views, looked = trainer.rasterizer, trainer.views, 0
    largest: NDArray[np.float32] = np.zeros(trainer.parameters.count, np.float32)
    start = time.perf_counter()
    for index in _spread(len(views)):
        frame = rasterizer.forward(trainer.parameters, trainer.local(views[index].camera), trainer.background)
        np.maximum(largest, sums_of_weights(rasterizer, frame), out=largest)
        looked += 1
        if looked == 1:
            start = time.perf_counter()  # kernels may have been built
        elif time.perf_counter() - start > seconds:
            break
    return largest, looked


def _spread(count: int) -> list[int]:
    """0 to count - 1, any first few of them far from each other: by the bits of the index reversed."""
    bits = max(count - 1, 1).bit_length()
    turned = (int(f"{index:0{bits}b}"[::-1], 2) for index in range(1 << bits))
    return [index for index in turned if index < count]
