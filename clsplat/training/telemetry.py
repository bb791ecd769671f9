# SPDX-License-Identifier: Apache-2.0
"""Records for a training's report in metrics.jsonl: device and versions, time of each stage, contributions.

The loop writes a line every REPORT_EVERY steps (`training/loop.py`).
"""

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

from clsplat.device import cl
from clsplat.device.context import Device
from clsplat.errors import CapacityError
from clsplat.rendering.contributions import sums_of_weights
from clsplat.stages.device_gaussians import HostGaussians
from clsplat.version import package_version

if TYPE_CHECKING:
    from clsplat.training.trainer import Trainer

T = TypeVar("T")

REPORTED_PACKAGES = ("numpy", "pyopencl", "OpenImageIO", "scipy", "scikit-image")
CONTRIBUTION_SECONDS = 1.0
"""Time limit, in seconds, for measuring the Gaussians' contributions to training views; the first view is not
counted."""
CONTRIBUTION_BIN_EDGES = tuple(float(edge) for edge in np.round(np.arange(-3.0, 5.01, 0.2), 1))
"""Edges of the bins of the histogram of contributions, as base-10 logarithms of pixels."""


def session(device: Device, step: int) -> dict[str, Any]:
    """Record of the device, driver and versions that train from `step` on.

    It names no user, host or folder, because reports are shared.
    """
    versions = {"clsplat": package_version(), "Python": platform.python_version()}
    for package in REPORTED_PACKAGES:
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
    """Run `work`. Returns its result, and the wall time of each stage in milliseconds.

    The key "other" is for time outside the stages, "all" for the total. The device is idle before and after each stage,
    so that times include launches, and the queue needs no profiling. Use it rarely: it keeps host and device from
    working at the same time.
    """
    with device.recorder.recording(wait=True) as stages:
        result, total = device.timed(work)
    times = {name: record.wall_ms for name, record in stages.items() if record.wall_ms > 0}
    return result, {**times, "other": max(total - sum(times.values()), 0.0), "all": total}


def contributions(trainer: Trainer, seconds: float = CONTRIBUTION_SECONDS) -> dict[str, Any] | None:
    """Return a histogram of the Gaussians' largest contributions to a training view (`largest_contributions`), for the
    report. Returns None if device memory is limited, because the memory plan reserves none for this measurement.

    The result has these keys:
    views, of: number of training views that were sampled, and number of all training views.
    none: number of Gaussians that no sampled view shows.
    edges: edges of the bins, as base-10 logarithms of pixels.
    counts: number of Gaussians in each bin. The outer bins include all values beyond their outer edge.
    """
    if trainer.device.memory.limit is not None or isinstance(trainer.parameters, HostGaussians):
        return None
    try:
        largest, looked = largest_contributions(trainer, seconds)
    except (CapacityError, cl.MemoryError):
        return None
    seen = largest[np.isfinite(largest) & (largest > 0)]
    powers = np.clip(np.log10(seen.astype(np.float64)), CONTRIBUTION_BIN_EDGES[0], CONTRIBUTION_BIN_EDGES[-1])
    counts, _ = np.histogram(powers, CONTRIBUTION_BIN_EDGES)
    return {
        "views": looked,
        "of": len(trainer.views),
        "none": len(largest) - len(seen),
        "edges": list(CONTRIBUTION_BIN_EDGES),
        "counts": counts.tolist(),
    }


def largest_contributions(trainer: Trainer, seconds: float = CONTRIBUTION_SECONDS) -> tuple[NDArray[np.float32], int]:
    """Largest contribution of each Gaussian (n,) to a sampled view (`sums_of_weights`), and the number of these views.

    As many training views are sampled, evenly spaced, as `seconds` allow. The training state does not change. Raises
    CapacityError.
    """
    rasterizer, views, looked = trainer.rasterizer, trainer.views, 0
    parameters = trainer.complete_parameters
    largest: NDArray[np.float32] = np.zeros(parameters.count, np.float32)
    start = time.perf_counter()
    for index in _spread(len(views)):
        frame = rasterizer.forward(parameters, trainer.local(views[index].camera), trainer.background)
        np.maximum(largest, sums_of_weights(rasterizer, frame), out=largest)
        looked += 1
        if looked == 1:
            start = time.perf_counter()  # do not count the first view, which may have built kernels
        elif time.perf_counter() - start > seconds:
            break
    return largest, looked


def _spread(count: int) -> list[int]:
    """Indices 0 to count - 1 in bit-reversed order, so that the first few, however many, are far apart."""
    bits = max(count - 1, 1).bit_length()
    turned = (int(f"{index:0{bits}b}"[::-1], 2) for index in range(1 << bits))
    return [index for index in turned if index < count]
