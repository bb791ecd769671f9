# SPDX-License-Identifier: Apache-2.0
"""A dispatcher of tasks that count (`counting.py`), as a process that tests end and kill.

    python dispatching.py FOLDER --tasks 4 --steps 100 --seconds 0.02 --workers 2
    python dispatching.py FOLDER --tasks 4 --steps 100 --seconds 0.02 --scheduler ADDRESS

The last task, "sum", is after all others. Exit status: 0 if all tasks are done, 1 if some failed, 130 after Ctrl-C.
"""

from __future__ import annotations

import argparse
import sys
from contextlib import nullcontext
from pathlib import Path

from counting import counting_task

from clsplat.errors import ClsplatError
from clsplat.jobs.dask_engine import dask_engine
from clsplat.jobs.dispatcher import run_tasks
from clsplat.jobs.local_engine import LocalEngine
from clsplat.jobs.task import JobTask
from clsplat.process import terminable

SUM_STEPS = 3
"""Number of steps of the last task."""


def counting_tasks(folder: Path, count: int, steps: int, seconds: float) -> list[JobTask]:
    """Tasks "0", "1" and so on, and "sum" after all of them."""
    tasks = [counting_task(folder, str(number), steps, seconds=seconds) for number in range(count)]
    return [*tasks, counting_task(folder, "sum", SUM_STEPS, after=tuple(task.name for task in tasks), seconds=seconds)]


def main() -> int:
    """Run the tasks, and print how it ended. Returns the exit status."""
    parser = argparse.ArgumentParser()
    parser.add_argument("folder", type=Path)
    parser.add_argument("--tasks", type=int, default=2)
    parser.add_argument("--steps", type=int, default=100)
    parser.add_argument("--seconds", type=float, default=0.02)
    parser.add_argument("--workers", type=int, default=2)
    parser.add_argument("--scheduler")
    arguments = parser.parse_args()
    tasks = counting_tasks(arguments.folder, arguments.tasks, arguments.steps, arguments.seconds)
    try:
        local = nullcontext(LocalEngine(arguments.workers))
        with terminable(), dask_engine(arguments.scheduler) if arguments.scheduler else local as engine:
            run_tasks(tasks, engine, arguments.folder / "jobs")
    except KeyboardInterrupt as error:
        print("interrupted", *error.args)
        return 130
    except ClsplatError as error:
        print(error)
        return 1
    return 0


if __name__ == "__main__":
    sys.exit(main())
