#!/usr/bin/env python3
# SPDX-License-Identifier: Apache-2.0
"""Measure the host's work in a training step by capacity: calls on the queue, and the launching thread's CPU time.

    python tools/bench/bench_host.py SCENE [--size 400] [--steps 100] [--shape 1x64] [--repeat 101] [--device DEVICE]

The scene is first trained for --steps steps, with photographs whose longer side has --size pixels. Their size does not
affect the host's work, unless lists are so long that they are sorted by radix. Each measured step is then launched on
an idle device, whose queue waits for a user event until the launch has returned. So meanwhile no kernel uses the same
cores, and no call waits for a kernel. The thread's CPU time is measured. Caches are cold, as after a wait.

The time is divided among CAUSES. The time of a cause excludes the time of other causes that run inside it. The
measurement itself adds half a microsecond to each call. Prints medians, and the least time of all steps, which other
load on the machine affects least.
"""

from __future__ import annotations

import os
import statistics
import sys
import time
from collections.abc import Callable, Iterator, Sequence
from contextlib import ExitStack, contextmanager
from dataclasses import asdict, replace
from pathlib import Path
from typing import Any
from unittest.mock import patch

import pyopencl as cl
from measuring import Result, machine, options_parser, parsed, require, show, tool

from clsplat.bench.stages import calls_of
from clsplat.config.training import TrainConfig
from clsplat.device.buffers import DeviceArray, Workspace
from clsplat.device.command_buffer import CommandBuffer
from clsplat.device.context import Device
from clsplat.device.selection import open_device
from clsplat.progress import aligned
from clsplat.rendering.rasterizer import Rasterizer
from clsplat.scenes.loading import load_scene
from clsplat.training.step.gradient_step import GradientStep
from clsplat.training.step.monitor import StepMonitor
from clsplat.training.step.speculative_steps import BY_CAPACITY_VARIABLE, SpeculativeSteps
from clsplat.training.supervision.host_photographs import HostPhotographs
from clsplat.training.supervision.view_loader import ViewLoader
from clsplat.training.trainer import Trainer

CAUSES: dict[str, Sequence[tuple[type, str]]] = {
    "driver's calls of a replay": [(Device, "replay")],
    "numbers and arrays given anew": [(CommandBuffer, "set")],
    "finding the command buffer": [(Workspace, "replayed")],
    "launches outside command buffers": [(Device, "enqueue")],
    "sending the camera": [(Rasterizer, "send"), (Rasterizer, "keep"), (DeviceArray, "send")],
    "gradient, its key": [(GradientStep, "run")],
    "Adam's key and numbers": [(GradientStep, "_change")],
    "monitor and statistics": [(StepMonitor, name) for name in ("forward", "loss", "before_rows", "after_rows")],
    "counts of the step before": [(SpeculativeSteps, "_look")],
    "view, rates and settings": [(Trainer, "_inputs"), (Trainer, "_gradient_step")],
    "reading ahead": [(ViewLoader, "read_ahead"), (HostPhotographs, "read_ahead")],
    "mark to step back to": [(Trainer, "_note")],
}
REST = "all else"


class Stopwatch:
    """Measures this thread's microseconds for each cause, without the time of other causes that run inside it."""

    def __init__(self) -> None:
        self.taken: dict[str, float] = {}
        self._inner: list[int] = [0]

    def around(self, cause: str, function: Callable[..., Any]) -> Callable[..., Any]:
        """A function that calls `function`, and adds the time of the call to a cause."""

        def timed(*arguments: Any, **options: Any) -> Any:
            start = time.thread_time_ns()
            self._inner.append(0)
            try:
                return function(*arguments, **options)
            finally:
                whole = time.thread_time_ns() - start
                self.taken[cause] = self.taken.get(cause, 0.0) + 1e-3 * (whole - self._inner.pop())
                self._inner[-1] += whole

        return timed

    @contextmanager
    def on(self) -> Iterator[None]:
        """A context manager, inside which the functions of CAUSES are timed."""
        with ExitStack() as patches:
            for cause, places in CAUSES.items():
                for owner, name in places:
                    patches.enter_context(patch.object(owner, name, self.around(cause, getattr(owner, name))))
            yield


def held(device: Device, work: Callable[[], object]) -> float:
    """Microseconds of this thread in `work`. The commands that `work` queues begin only after its return."""
    device.finish()
    gate = cl.UserEvent(device.context)
    cl.enqueue_barrier(device.queue, wait_for=[gate])
    start = time.thread_time_ns()
    try:
        work()
        return 1e-3 * (time.thread_time_ns() - start)
    finally:
        gate.set_status(cl.command_execution_status.COMPLETE)
        device.finish()


def measure(trainer: Trainer, steps: int, repeat: int) -> Result:
    """Train for `steps` steps, then measure `repeat` steps, and as many others with the time of each cause.

    Calls on the queue are counted in further steps.
    """
    device = trainer.device
    for _ in range(steps):
        trainer.train_step()
    whole, by_cause = [], []
    for _ in range(repeat):
        whole.append(held(device, trainer.train_step))
        watch = Stopwatch()
        with watch.on():
            total = held(device, trainer.train_step)
        by_cause.append({**watch.taken, REST: total - sum(watch.taken.values())})
    calls = [asdict(calls_of(device, trainer.train_step)) for _ in range(10)]
    device.finish()
    return {
        **machine(device, repeat),
        "subject": trainer.scene.name,
        "gaussians": trainer.parameters.count,
        "repeated": trainer.pending.redone,
        "calls": {name: max(each[name] for each in calls) for name in calls[0]},
        "step_us": statistics.median(whole),
        "least_us": min(whole),
        "us": {name: statistics.median(each.get(name, 0.0) for each in by_cause) for name in (*CAUSES, REST)},
    }


@tool("bench_host")
def main(arguments: Sequence[str]) -> int:
    """Run the measurement and print its results."""
    parser = options_parser(__doc__, 101, plot=False)
    parser.add_argument("subject", type=Path)
    parser.add_argument("--size", metavar="PIXELS", type=int, default=400)
    parser.add_argument("--steps", metavar="N", type=int, default=100)
    parser.add_argument("--shape", default="")
    options = parsed(parser, arguments)
    require(options.steps >= 10, f"--steps {options.steps}: expected at least 10, so that capacities are known")
    device = open_device(options.device)
    device = device.with_shape(options.shape) if options.shape else device
    scene = load_scene(options.subject, resolution=options.size)
    with patch.dict(os.environ, {BY_CAPACITY_VARIABLE: "1"}):
        trainer = Trainer(scene, replace(TrainConfig(), warmup=()), device)
        result = measure(trainer, options.steps, options.repeat)
        trainer.close()
    calls = ", ".join(f"{count} {name.replace('_', ' ')}" for name, count in result["calls"].items())
    lines = [f"{result['subject']}, {result['gaussians']:,} Gaussians", f"at most, in a step: {calls}", ""]
    rows = [("host's part of a step", "us"), *((name, f"{us:.1f}") for name, us in result["us"].items())]
    lines += [
        *aligned(
            [*rows, ("a step, without timers", f"{result['step_us']:.1f}"), ("the least", f"{result['least_us']:.1f}")]
        )
    ]
    show(result, lines, as_json=options.json)
    return 0


if __name__ == "__main__":
    sys.exit(main(sys.argv[1:]))
