# SPDX-License-Identifier: Apache-2.0
"""Search for the fastest kernel shape on a device.

Each candidate runs in a separate process, because a driver may abort.
`clsplat tune` saves the result (device/drivers/shapes.py).
The search never starts automatically: while other programs run, it may choose another shape. Gradients have other bits
in another shape, so the same seed would then give other results.
"""

from __future__ import annotations

import statistics
import sys
from collections.abc import Callable
from contextlib import closing
from dataclasses import dataclass

import numpy as np

from clsplat.bench.workload import synthetic
from clsplat.device import cl
from clsplat.device.buffers import upload
from clsplat.device.context import Device, all_devices
from clsplat.device.drivers.shapes import Shape, candidates, default_shape, save_shape
from clsplat.device.drivers.worker_process import (
    WorkerEndedError,
    WorkerProcess,
    driver_timeout,
    end_with_parent,
    python_module,
    tell,
)
from clsplat.errors import DriverError
from clsplat.rendering.rasterizer import Rasterizer
from clsplat.stages.device_gaussians import allocate_gaussians, upload_gaussians

TRIAL_WORKLOAD = (50_000, 640, 480)
"""Number of Gaussians, and width and height of the frame in pixels, in a trial of a shape."""
REPLACEMENT_TIME_RATIO = 0.97
"""A shape replaces the default if its time, divided by the default's, is at most this. Smaller gains may be noise."""


@dataclass(frozen=True)
class Trial:
    """Result of a candidate shape's trial.

    ms: milliseconds of a frame and its gradient; None if the driver failed or took too long.
    """

    shape: Shape
    ms: float | None


def tune(device: cl.Device, index: int, progress: Callable[[Shape], None]) -> tuple[list[Trial], Shape]:
    """Try the candidate shapes on a device and save the result of `choose`. Returns all trials, and this result.

    index: the device's index among all devices.
    progress: function that is called with each shape before its trial.
    Raises DriverError if no candidate works, and OSError if the shape cannot be saved.
    """
    trials = []
    for shape in candidates(device):
        progress(shape)
        trials.append(Trial(shape, _in_a_process(index, shape)))
    if all(trial.ms is None for trial in trials):
        shapes = ", ".join(trial.shape.label for trial in trials)
        raise DriverError(
            f"{device.name.strip()}: the driver aborted or hung with every shape that was tried, {shapes}; run "
            "clsplat selftest for details"
        )
    best = choose(trials)
    save_shape(device, None if best == default_shape(device) else best)
    return trials, best


def choose(trials: list[Trial]) -> Shape:
    """Return the fastest shape if it is clearly faster than the default shape, otherwise the default shape.

    trials: the first trial is of the default shape.
    """
    default = trials[0]
    timed = [(trial.ms, trial.shape) for trial in trials if trial.ms is not None]
    if not timed:
        return default.shape
    ms, shape = min(timed, key=lambda trial: trial[0])
    return shape if default.ms is None or ms <= REPLACEMENT_TIME_RATIO * default.ms else default.shape


def _in_a_process(index: int, shape: Shape) -> float | None:
    with closing(WorkerProcess(python_module("clsplat.bench.shapes", str(index), shape.label))) as child:
        try:
            return float(child.receive(driver_timeout())["ms"])
        except WorkerEndedError:
            return None


def measure(device: Device, workload: tuple[int, int, int] = TRIAL_WORKLOAD, repeat: int = 7) -> float:
    """Measure the median milliseconds of a frame and its gradient, for a synthetic scene.

    workload: number of Gaussians, and width and height of the frame in pixels.
    repeat: number of measurements.
    """
    subject = synthetic(*workload)
    rasterizer = Rasterizer(device)
    gaussians = upload_gaussians(device, subject.gaussians)
    gradients = allocate_gaussians(device, gaussians.count, gaussians.coefficients, zero=True)
    background = upload(device, np.zeros(3, np.float32))

    def draw() -> None:
        frame = rasterizer.forward(gaussians, subject.camera, background)
        rasterizer.backward(gaussians, frame, frame.blended.image, gradients)

    times = [device.timed(draw)[1] for _ in range(repeat + 2)]
    return statistics.median(times[2:])


if __name__ == "__main__":
    end_with_parent()
    chosen = all_devices()[int(sys.argv[1])]
    shape = default_shape(chosen).relabelled(sys.argv[2])
    tell(ms=measure(Device(chosen, shape)))
