# SPDX-License-Identifier: Apache-2.0
"""The work on a city after its plan, as tasks for `clsplat.jobs`: a task for each block, the merge and the finish."""

from __future__ import annotations

import json
from collections.abc import Sequence
from contextlib import suppress
from functools import partial
from pathlib import Path

from clsplat.blocks.merging import digests_of_blocks, merge_digest, merged_of
from clsplat.blocks.plan import BLOCKS_FOLDER, BlockPlan
from clsplat.blocks.progress_records import MERGED_FILE, is_done
from clsplat.errors import ClsplatError
from clsplat.jobs.task import JobTask

METRICS_END_BYTES = 1 << 16
"""Number of bytes at the end of metrics.jsonl in which the last step is looked for."""


def tasks_of(city: Path, plan: BlockPlan, steps: int | None, machine: Sequence[str] = ()) -> list[JobTask]:
    """Return the tasks of a city.

    steps: number of steps of the finish; None for the plan's.
    machine: flags about device and memory, for the commands that train.
    """
    words, digest = ("clsplat", "blocks"), plan.digest
    place = str(city.absolute())
    tasks = [
        JobTask(
            f"block-{block.name}",
            (*words, "train", place, "--block", block.name.replace("_", ","), *machine),
            partial(is_done, city / BLOCKS_FOLDER / block.name, digest),
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
            partial(is_finished, city, plan),
            ("merge",),
            partial(steps_done, city),
            steps or plan.finish_steps,
        )
    )
    return tasks


def is_merged(city: Path, plan: BlockPlan) -> bool:
    """True if merged.ply has the models of all blocks."""
    with suppress(ClsplatError):
        return merged_of(city / MERGED_FILE) == merge_digest(plan, digests_of_blocks(city, plan))
    return False


def is_finished(city: Path, plan: BlockPlan) -> bool:
    """True if the finish of the merged models of all blocks is done."""
    with suppress(ClsplatError):
        return is_done(city, plan.digest, merge_digest(plan, digests_of_blocks(city, plan)))
    return False


def steps_done(run: Path) -> int:
    """Return the number of steps that a run's metrics.jsonl tells of; 0 without this file."""
    with suppress(OSError), (run / "metrics.jsonl").open("rb") as file:
        file.seek(max(file.seek(0, 2) - METRICS_END_BYTES, 0))
        for line in reversed(file.read().splitlines()):
            with suppress(ValueError, TypeError, KeyError):
                return int(json.loads(line)["step"])
    return 0
