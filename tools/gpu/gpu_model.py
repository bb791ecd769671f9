# SPDX-License-Identifier: Apache-2.0
"""Predict the milliseconds of a training step on a GPU from its instructions and from the bytes that it moves.

The model assumes that every unit starts the maximum number of instructions in each cycle at its boost clock, that
memory has the bandwidth of its data sheet, and that each launch reads and writes its arrays once. Nothing ever waits:
ratios can be trusted, but real times are longer.
"""

from __future__ import annotations

import math
from collections.abc import Iterable, Mapping
from dataclasses import dataclass
from typing import Any

from gpu_compilers import Built, Source
from gpu_devices import ARCHITECTURES, Gpu
from gpu_loops import Cost, cost_of, rules_of
from gpu_rules import BY_PAIR, NUMBERS, Run

from clsplat.layouts.columns import TILE

COPIES = ("write", "read")
"""Transfers between host and device, which are not predicted."""


@dataclass(frozen=True)
class Stage:
    """Milliseconds of a stage for instructions and for bytes, and its number of launches, including fills."""

    issue: float = 0.0
    memory: float = 0.0
    launches: int = 0

    @property
    def both(self) -> float:
        """The sum of both times, as if they did not overlap."""
        return self.issue + self.memory

    def __add__(self, other: Stage) -> Stage:
        return Stage(self.issue + other.issue, self.memory + other.memory, self.launches + other.launches)


def run_of(frame: Mapping[str, Any], launch: Mapping[str, Any], items: int, wave: int) -> Run:
    """The numbers of a frame and a launch on which loops depend."""
    tiles = -(-frame["width"] // TILE) * -(-frame["height"] // TILE)
    numbers = dict(zip(NUMBERS.get(launch["kernel"], ()), map(int, launch["scalars"]), strict=False))
    return Run(
        items,
        wave,
        addends=frame["listed"] / max(frame["visible"], 1),
        listed=frame["walked"] / tiles,
        coefficients=(frame["sh_degree"] + 1) ** 2,
        groups=math.prod(launch["size"]) // items,
        **{name: numbers[name] for name in ("elements", "digits") if name in numbers},
    )


def issued(cost: Cost, target: str) -> tuple[float, float]:
    """Instructions that use a unit's main issue slots, outside of loops and in them. AMD's scalar unit, branches and
    waits have issue slots of their own."""
    apart = () if target.startswith("sm_") else ("scalar", "control")
    once, rounds = (
        sum(count for kind, count in counts.items() if kind not in apart) for counts in (cost.once, cost.rounds)
    )
    return once, rounds


def predict(
    launches: Iterable[Mapping[str, Any]],
    built: Mapping[tuple[Source, str], Built],
    frame: Mapping[str, Any],
    gpu: Gpu,
) -> dict[str, Stage]:
    """The stages of a step in order, from its launches (`gpu_variants.py`) and kernels compiled for the GPU."""
    stages: dict[str, Stage] = {}
    wave = ARCHITECTURES[gpu.target].wave
    for launch in launches:
        if launch["kernel"] in COPIES:
            continue
        instructions = 0.0
        if "stem" in launch:
            source, name = Source(launch["stem"], tuple(launch["options"])), launch["kernel"]
            run = run_of(frame, launch, source.items, wave)
            once, rounds = issued(cost_of(built[source, name], source.lines, rules_of(name), run), gpu.target)
            waves = math.prod(launch["size"]) / wave
            if name in BY_PAIR:
                waves = max(waves, math.prod(launch["size"]) / source.items)
                instructions = waves * once + frame["walked"] * rounds * run.waves
            else:
                instructions = waves * (once + rounds)
        stage = Stage(instructions / gpu.issued, launch["bytes"] / gpu.gb * 1e-6, 1)
        stages[launch["stage"]] = stages.get(launch["stage"], Stage()) + stage
    return stages
