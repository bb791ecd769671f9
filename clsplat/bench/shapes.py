# SPDX-License-Identifier: Apache-2.0
"""Search for the quickest shape of the kernels on a device.

Each candidate runs in a process of its own, as a driver may abort. `clsplat tune` keeps the answer (device/shapes.py).
The search does not start by itself at the first use: gradients have the same bits only within a shape, and a trial that
another load disturbed would change what a seed gives.
"""

from __future__ import annotations

import statistics
import sys
from collections.abc import Callable
from contextlib import closing
from dataclasses import dataclass

import numpy as np

from clsplat.bench.subject import synthetic
from clsplat.device import cl
from clsplat.device.buffers import upload
from clsplat.device.child import Child, end_with_parent, patience, python_module, tell
from clsplat.device.context import Device, all_devices
from clsplat.device.shapes import Shape, candidates, default_shape, save_shape
from clsplat.errors import DriverError
from clsplat.rendering.rasterizer import Rasterizer
from clsplat.stages.device_gaussians import allocate_gaussians, upload_gaussians

WORKLOAD = (50_000, 640, 480)
"""Gaussians, width and height of what is drawn."""
ENOUGH = 0.97
"""A shape takes the default's place at this part of its time or less: what is nearer may be the trial's noise."""


@dataclass(frozen=True)
class Trial:
    """ms: a frame and its gradient, None where the driver failed or took too long."""

    shape: Shape
    ms: float | None


def tune(device: cl.Device, index: int, progress: Callable[[Shape], None]) -> tuple[list[Trial], Shape]:
    """Try the candidates on the device, the `index`-th of all, and keep the quickest. Raises DriverError where none
    works, and OSError."""
    trials = []
    for shape in candidates(device):
        progress(shape)
        trials.append(Trial(shape, _in_a_process(index, shape)))
    if all(trial.ms is None for trial in trials):
        shapes = ", ".join(trial.shape.label for trial in trials)
        raise DriverError(
            f"{device.name.strip()}: the driver aborted or hung in every shape that was tried, {shapes}; clsplat "
            "selftest tells more"
        )
    best = choose(trials)
    save_shape(device, None if best == default_shape(device) else best)
    return trials, best


def choose(trials: list[Trial]) -> Shape:
    """The quickest; the first, which is the default, unless another is clearly quicker."""
    default = trials[0]
    timed = [(trial.ms, trial.shape) for trial in trials if trial.ms is not None]
    if not timed:
        return default.shape
    ms, shape = min(timed, key=lambda trial: trial[0])
    return shape if default.ms is None or ms <= ENOUGH * default.ms else default.shape


def _in_a_process(index: int, shape: Shape) -> float | None:
    with closing(Child(python_module("clsplat.bench.shapes", str(index), shape.label))) as child:
        try:
            answer = child.receive(patience())
        except TimeoutError:
            return None
    return float(answer["ms"]) if answer is not None else None


def measure(device: Device, workload: tuple[int, int, int] = WORKLOAD, repeat: int = 7) -> float:
    """Median milliseconds of a frame and its gradient on a made-up scene."""
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
