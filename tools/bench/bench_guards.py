#!/usr/bin/env python3
# SPDX-License-Identifier: Apache-2.0
"""Cost of a training step's checks for numbers that are not finite: steps with and without them alternate.

    python tools/bench/bench_guards.py [RUN | MODEL.ply | SCENE] [--repeat 41] [--device DEVICE] [--json]

Kernels without checks are built with UNGUARDED, which exists only for this comparison: `adam` stores every result, and
`project` draws any colour. Both trainers have the same model and picture, and learning rates of zero, so that every
step is the same work. Without a subject, the scene is the synthetic one of `clsplat bench`. Each round runs a step of
each trainer, in alternating order. Prints medians of wall time and of the process's CPU time. It also prints the median
over all rounds of the ratio of the two steps' times, which other load on the machine affects least.
"""

from __future__ import annotations

import statistics
import sys
import time
from collections.abc import Sequence
from pathlib import Path

from measuring import Result, machine, options_parser, parsed, show, tool

from clsplat.bench.stages import trainer_of
from clsplat.bench.workload import load_subject, synthetic
from clsplat.config.rasterizer import RasterizerConfig
from clsplat.device.context import Device
from clsplat.device.selection import open_device
from clsplat.training.trainer import Trainer

WARM_UP = 3


def step_seconds(trainer: Trainer) -> tuple[float, float]:
    """Wall and CPU seconds of one step, from an idle device to an idle device."""
    trainer.device.finish()
    used = time.process_time()
    ms = trainer.device.timed(trainer.train_step)[1]
    return 1e-3 * ms, time.process_time() - used


def measure(device: Device, path: Path | None, repeat: int) -> Result:
    """Measure the times (ms) and ratios that the module describes. path: None for the synthetic scene."""
    subject = load_subject(path) if path is not None else synthetic()
    trainers = [
        trainer_of(subject, each, RasterizerConfig()) for each in (device, device.with_switches({"UNGUARDED": True}))
    ]
    for _ in range(WARM_UP):
        for trainer in trainers:
            step_seconds(trainer)
    rounds: list[list[tuple[float, float]]] = []
    for index in range(repeat):
        order = trainers if index % 2 == 0 else trainers[::-1]
        times = [step_seconds(trainer) for trainer in order]
        rounds.append(times if index % 2 == 0 else times[::-1])
    result = machine(device, repeat)
    result.update(subject=subject.name, gaussians=len(subject.gaussians))
    for kind, column in (("wall", 0), ("cpu", 1)):
        with_guards, without = ([1e3 * times[which][column] for times in rounds] for which in (0, 1))
        result[kind] = {
            "with_ms": statistics.median(with_guards),
            "without_ms": statistics.median(without),
            "ratio": statistics.median(a / b for a, b in zip(with_guards, without, strict=True)),
        }
    return result


@tool("bench_guards")
def main(arguments: Sequence[str]) -> int:
    """Run the measurement and print its results."""
    parser = options_parser(__doc__, 41, plot=False)
    parser.add_argument("subject", nargs="?", type=Path)
    options = parsed(parser, arguments)
    result = measure(open_device(options.device), options.subject, options.repeat)
    lines = [f"{result['subject']}, {result['gaussians']:,} Gaussians", ""]
    lines += ["| time | with, ms | without, ms | ratio |", "|---|---|---|---|"]
    for kind in ("wall", "cpu"):
        row = result[kind]
        lines.append(f"| {kind} | {row['with_ms']:.2f} | {row['without_ms']:.2f} | {row['ratio']:.4f} |")
    show(result, lines, as_json=options.json)
    return 0


if __name__ == "__main__":
    sys.exit(main(sys.argv[1:]))
