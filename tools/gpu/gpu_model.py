# SPDX-License-Identifier: Apache-2.0
"""Predict the milliseconds of a training step on a GPU, and fit the model's few constants to measured steps.

A launch takes the time of its bytes, plus the longest of six times: of its instructions, cache lines, passes through
banks of local memory, atomics and groups, and of its warps' chains (`gpu_chain.py`). As many chains run at a time as
warps fit, and the chain of the slowest tile's warp is a lower limit. No launch takes less than LAUNCH. Bytes are added
because an H100 and an H200, which differ in nothing but memory, differ in each stage by the time of its bytes. All
stages share every constant.
"""

from __future__ import annotations

import math
from collections.abc import Callable, Iterable, Mapping
from dataclasses import dataclass, fields, replace
from functools import cache
from typing import Any

from gpu_chain import NOTHING, Chain
from gpu_compilers import Built, Source
from gpu_devices import ARCHITECTURES, Gpu, waves_at_a_time
from gpu_lists import boxes_of, lists_of, sorting_of
from gpu_loops import Cost, cost_of, rules_of
from gpu_rules import BY_PAIR, NUMBERS
from gpu_run import BLOCKS, VISITS, WARPS, Run

from clsplat.layouts.columns import TILE

COPIES = ("write", "read")
"""Transfers between host and device, which are not predicted."""
LAUNCH = 0.003
"""Least milliseconds of a launch: those of the shortest in docs/gpus/calibration.json."""
LINES = 2
"""Cache lines that a unit looks up per cycle."""
PASSES = 1
"""Passes through the banks of local memory of a unit per cycle."""
DRIVERS_ITEMS = 256
"""Items per group where the driver chooses."""
APPENDING, SORTING = ("count_tiles", "append_pairs"), "sort_lists"
"""Kernels of lists by append with an atomic in global memory for each pair, and the one that sorts the lists.
count_tiles is in measured code alone."""
COUNTING = "-DCOUNTS_LISTS"
"""Beginning of the option of a projection that counts the pairs of lists, with an atomic for each pair."""
MOVED = {"density_statistics": 0.68}
"""Share of its arrays' bytes that a kernel moves, if it reads only part of their rows. Of a splat's 64 bytes the
statistics need the first sector of 32; with 36 bytes in other arrays, they move 68 of 100 for each Gaussian."""


@dataclass(frozen=True)
class Constants:
    """Constants of the model, which all stages and GPUs share.

    efficiency: fraction of a unit's issue slots that are used if it has enough work.
    access: nanoseconds of an access to global memory.
    host: milliseconds that the host takes to queue a launch.
    copy: fraction of the data sheet's bandwidth that is reached.
    groups: number of groups that start per cycle.
    atomic: mean nanoseconds per atomic in global memory, if the whole device makes them.
    counter: nanoseconds between two atomics on the same counter.
    """

    efficiency: float = 0.71
    access: float = 600
    host: float = 0.04
    copy: float = 0.9
    groups: float = 0.83
    atomic: float = 0.0079
    counter: float = 82


FITTED = {"efficiency": (0.5, 1, 0.01), "access": (100, 1000, 10), "host": (0.005, 0.1, 0.001)}
"""The constants that are fitted: lower and upper limit, and step."""


@dataclass(frozen=True)
class Stage:
    """Milliseconds of a stage.

    issue, memory, chain: time for instructions, for bytes, and of its warps' chains.
    ms: time of the whole stage.
    launches: number of launches, including fills.
    """

    issue: float = 0.0
    memory: float = 0.0
    chain: float = 0.0
    ms: float = 0.0
    launches: int = 0

    def __add__(self, other: Stage) -> Stage:
        return Stage(*(getattr(self, each.name) + getattr(other, each.name) for each in fields(Stage)))


@dataclass(frozen=True)
class Work:
    """The work of a launch.

    instructions: number of instructions of all waves.
    resident: number of waves that fit in a unit.
    chain: chain of an average wave.
    longest: chain of a wave in the slowest tile.
    kernel: name of the kernel; `fill` for a fill.
    atomics, counters: number of atomics in global memory, and of the counters among which they are spread.
    """

    stage: str
    bytes: float
    instructions: float = 0.0
    waves: float = 1.0
    groups: float = 0.0
    resident: int = 1
    chain: Chain = NOTHING
    longest: Chain = NOTHING
    kernel: str = ""
    atomics: float = 0.0
    counters: int = 1

    def on(self, gpu: Gpu, constants: Constants) -> Stage:
        """The predicted milliseconds of the launch, as a part of its stage."""
        rounds = max(self.waves / gpu.units / self.resident, 1)
        waited = (
            each.cycles + each.accesses * constants.access * gpu.ghz
            for each in (self.chain.times(rounds), self.longest)
        )
        issue, chain = self.instructions / gpu.issued / constants.efficiency, max(waited) / gpu.ghz * 1e-6
        lines = self.waves * self.chain.lines / LINES / gpu.units / gpu.ghz * 1e-6
        local = self.waves * self.chain.passes / PASSES / gpu.units / gpu.ghz * 1e-6
        starts = self.groups / constants.groups / gpu.ghz * 1e-6
        counted = self.atomics * (constants.atomic + constants.counter / self.counters) * 1e-6
        memory = self.bytes / gpu.gb / constants.copy * 1e-6
        return Stage(issue, memory, chain, max(LAUNCH, memory + max(issue, lines, local, starts, chain, counted)), 1)


def blocks_of(frame: Mapping[str, Any], items: int) -> dict[str, Any]:
    """The numbers of a frame that tell how a group's warps walk a pair. A group has a warp for each 32 items."""
    warps = min(max(items // 32, 1), WARPS[-1])  # kernels in larger groups walk no pairs
    found = {name: frame[name][WARPS.index(warps)] for name in VISITS}
    for name in ("visits", "dense", "turns_back", "whole_back", "rounds_back"):
        found[name] /= warps
    return {"reached": frame["reached"], "taken": frame["taken"], **found}


def longest_of(frame: Mapping[str, Any], items: int) -> dict[str, Any]:
    """The numbers of `blocks_of`, as if each warp had the pairs of the longest warp in the slowest tile."""
    warps = min(max(items // 32, 1), WARPS[-1])
    longest = {name: [value * warps for value in frame[f"longest_{name}"]] for name in VISITS}
    halves = {name: BLOCKS / 4 * frame[f"longer_{name}"] for name in ("reached", "taken")}
    return blocks_of({**longest, **halves}, items)


def tiles_of(frame: Mapping[str, Any]) -> int:
    """Number of a frame's tiles."""
    columns, rows = (-(-int(frame[side]) // TILE) for side in ("width", "height"))
    return columns * rows


def run_of(frame: Mapping[str, Any], launch: Mapping[str, Any], items: int, wave: int) -> Run:
    """The numbers of a frame and a launch on which loops depend."""
    tiles = tiles_of(frame)
    numbers = dict(zip(NUMBERS.get(launch["kernel"], ()), map(int, launch["scalars"]), strict=False))
    more: dict[str, Any] = {name: numbers[name] for name in ("elements", "digits") if name in numbers}
    if launch["kernel"] == SORTING:
        more["sorting"] = sorting_of(lists_of(frame), items)
    return Run(
        items,
        wave,
        addends=frame["listed"] / max(frame["visible"], 1),
        shown=frame["visible"] / max(frame["gaussians"], 1),
        listed=frame["walked"] / tiles,
        **blocks_of(frame, items),
        coefficients=(frame["sh_degree"] + 1) ** 2,
        groups=math.prod(launch["size"]) // items,
        lists=tiles,
        boxes=boxes_of(frame, items),
        **more,
    )


def issued(cost: Cost, target: str) -> tuple[float, float]:
    """Numbers of instructions that use a unit's main issue slots, outside of loops and in them.

    AMD's scalar unit, branches and waits have issue slots of their own.
    """
    apart = () if target.startswith("sm_") else ("scalar", "control")
    once, rounds = (
        sum(count for kind, count in counts.items() if kind not in apart) for counts in (cost.once, cost.rounds)
    )
    return once, rounds


def works_of(
    launches: Iterable[Mapping[str, Any]],
    built: Mapping[tuple[Source, str], Built],
    frame: Mapping[str, Any],
) -> list[Work | None]:
    """The work of a step's launches in order (`gpu_variants.py`), with kernels compiled for one target.

    None stands for a wait of the host for a number. A frame has one; a step has none (decision 0025).
    """
    works: list[Work | None] = []
    costs = cache(
        lambda source, name, run: cost_of(built[source, name], source.lines, rules_of(name, source.commit), run)
    )
    for launch in launches:
        if "stem" in launch:
            kernel = built[Source.of(launch), launch["kernel"]]
            works.append(_work_of(launch, kernel, frame, costs))
        elif launch["kernel"] not in COPIES:
            works.append(Work(launch["stage"], launch["bytes"], kernel=launch["kernel"]))
        elif launch["kernel"] == "read":
            works.append(None)
    return works


def _work_of(
    launch: Mapping[str, Any], kernel: Built, frame: Mapping[str, Any], costs: Callable[[Source, str, Run], Cost]
) -> Work:
    source, name = Source.of(launch), launch["kernel"]
    wave = ARCHITECTURES[kernel.target].wave
    run = run_of(frame, launch, source.items, wave)
    items, size = math.prod(launch["local"] or (DRIVERS_ITEMS,)), math.prod(launch["size"])
    waves, pairs, longest = size / wave, 1.0, NOTHING
    cost = costs(source, name, run)
    once, rounds = issued(cost, kernel.target)
    if name in BY_PAIR:
        waves = max(waves, size / source.items)
        pairs = frame["walked"] * run.waves / waves
        walked = min(frame["slowest"], _part_of(launch))
        slow = costs(source, name, replace(run, listed=walked, **longest_of(frame, source.items)))
        longest = slow.first + slow.then.times(walked)
    if name == SORTING:
        slow = costs(source, name, replace(run, sorting=sorting_of([(1, frame["longest_listed"])], source.items)))
        longest = slow.first + slow.then
    return Work(
        launch["stage"],
        launch["bytes"] * MOVED.get(name, 1.0),
        waves * (once + rounds * pairs),
        waves,
        size / items,
        max(waves_at_a_time(kernel, items, launch["shared"]), 1),
        cost.first + cost.then.times(pairs),
        longest,
        name,
        **({"atomics": frame["listed"], "counters": run.lists} if _counts_pairs(launch) else {}),
    )


def _counts_pairs(launch: Mapping[str, Any]) -> bool:
    """True if the kernel has an atomic in global memory for each pair."""
    return launch["kernel"] in APPENDING or any(each.startswith(COUNTING) for each in launch["options"])


def _part_of(launch: Mapping[str, Any]) -> float:
    """Maximum number of a list's pairs that a group walks: the pairs of a part, if blend_grad divides lists."""
    parts = [each.partition("=")[2] for each in launch["options"] if each.startswith("-DPART_PAIRS=")]
    return int(parts[0]) if parts and launch["kernel"] == "blend_grad" else math.inf


def stages_of(works: Iterable[Work | None], gpu: Gpu, constants: Constants) -> dict[str, Stage]:
    """The stages of a step in order."""
    stages: dict[str, Stage] = {}
    for work in filter(None, works):
        stages[work.stage] = stages.get(work.stage, Stage()) + work.on(gpu, constants)
    return stages


def wall(works: Iterable[Work | None], gpu: Gpu, constants: Constants) -> float:
    """Milliseconds until all is done. A launch begins when the host has queued it and the launch before is done."""
    queued = done = 0.0
    for work in works:
        if work is None:
            queued = max(queued, done)
        else:
            queued += constants.host
            done = max(queued, done) + work.on(gpu, constants).ms
    return done


def fit(error: Callable[[Constants], float], begin: Constants) -> Constants:
    """The constants with the least error. Each in turn gets its best value, until none changes."""
    best = begin
    while True:
        before = best
        for name, (low, high, step) in FITTED.items():
            values = (round(low + step * k, 6) for k in range(round((high - low) / step) + 1))
            best = min((replace(best, **{name: value}) for value in values), key=error)
        if best == before:
            return best
