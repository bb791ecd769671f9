# SPDX-License-Identifier: Apache-2.0
"""The work on a city after its plan, as tasks for `clsplat.jobs`: a task for each block, the merge and the finish."""

from __future__ import annotations

import json
from collections.abc import Sequence
from contextlib import suppress
from functools import partial
from pathlib import Path

from clsplat.blocks.block_training import is_finished, is_trained
from clsplat.blocks.merging import is_merged
from clsplat.blocks.plan import BLOCKS_FOLDER, BlockPlan
from clsplat.jobs.task import JobTask

METRICS_END_BYTES = 1 << 16
"""Number of bytes at the end of metrics.jsonl in which the last step is looked for."""


def tasks_of(city: Path, plan: BlockPlan, steps: int | None, machine: Sequence[str] = ()) -> list[JobTask]:
    """Return the tasks of a city.

    steps: number of steps of the finish; None for those of the existing run, or of the plan if there is no run.
    machine: flags about device and memory, for the commands that train.
    """
    words = ("clsplat", "blocks")
    place = str(city.absolute())
    tasks = [
        JobTask(
            f"block-{block.name}",
            (*words, "train", place, "--block", block.shown, *machine),
            partial(is_trained, city, plan, block),
            progress=partial(steps_done, city / BLOCKS_FOLDER / block.name),
            total=block.iterations,
        )
        for block in plan.blocks
    ]
    blocks = tuple(task.name for task in tasks)
    tasks.append(JobTask("merge", (*words, "merge", place), partial(is_merged, city, plan), blocks))
    more = () if steps is None else ("--finish", str(steps))
    tasks.append(
        JobTask(
            "finish",
            (*words, "finish", place, *more, *machine),
            partial(is_finished, city, plan, steps),
            ("merge",),
            partial(steps_done, city),
            steps or plan.finish_steps,
        )
    )
    return tasks


def steps_done(run: Path) -> int:
    """Return the number of steps that a run's metrics.jsonl tells of; 0 without this file."""
    with suppress(OSError), (run / "metrics.jsonl").open("rb") as file:
        file.seek(max(file.seek(0, 2) - METRICS_END_BYTES, 0))
        for line in reversed(file.read().splitlines()):
            with suppress(ValueError, TypeError, KeyError):
                return int(json.loads(line)["step"])
    return 0
