# SPDX-License-Identifier: Apache-2.0
"""Dispatch many tasks that do nothing, and measure the dispatcher's memory, and its time for each task.

    tools/stress/run jobs [--tasks 10000] [--workers 64]

A stub takes the place of the workers: it makes a task's result, an empty file, at once. The exit status is 1 if the
dispatcher takes more than 500 MB or 5 ms a task.
"""

from __future__ import annotations

import json
import sys
import time
from collections.abc import Sequence
from functools import partial
from pathlib import Path
from tempfile import TemporaryDirectory

from measuring import plain_parser

from clsplat.jobs.dispatcher import JobProgress, run_tasks
from clsplat.jobs.task import Attempt, JobTask, Outcome

MOST_MEGABYTES, MOST_MILLISECONDS = 500, 5.0
"""Limits of the dispatcher's memory, and of its time for each task."""
STEPS = 100
"""Steps of each task."""


class StubEngine:
    """An engine that makes a task's result when the attempt starts."""

    def __init__(self, results: Path, workers: int) -> None:
        self.results, self.workers = results, workers
        self.ended: list[Outcome] = []

    def free(self) -> int:
        return self.workers - len(self.ended)

    def start(self, attempt: Attempt) -> None:
        (self.results / attempt.name).touch()
        self.ended.append(Outcome(attempt.name, "ended"))

    def wait(self, seconds: float) -> list[Outcome]:
        del seconds
        ended, self.ended = self.ended, []
        return ended

    def leave_out(self, worker: str) -> bool:
        return bool(worker)

    def stop(self) -> None:
        pass


def main(argv: Sequence[str]) -> int:
    """Run the test, and print its result as JSON. Returns the exit status."""
    import resource  # POSIX only

    parser = plain_parser(__doc__)
    parser.add_argument("--tasks", type=int, default=10_000, help="number of tasks, default 10000")
    parser.add_argument("--workers", type=int, default=64, help="number of workers, default 64")
    arguments = parser.parse_args(argv)
    with TemporaryDirectory() as name:
        folder = Path(name)
        (folder / "results").mkdir()
        tasks = [task(folder / "results", f"block-{number}") for number in range(arguments.tasks - 1)]
        tasks.append(task(folder / "results", "merge", tuple(one.name for one in tasks)))
        engine, reports = StubEngine(folder / "results", arguments.workers), list[JobProgress]()
        start = time.monotonic()
        run_tasks(tasks, engine, folder / "jobs", reports.append)
        seconds = time.monotonic() - start
        done = len([*(folder / "results").iterdir()])
    peak = resource.getrusage(resource.RUSAGE_SELF).ru_maxrss / (1e6 if sys.platform == "darwin" else 1e6 / 1024)
    result = {
        "tasks": len(tasks),
        "done": done,
        "seconds": round(seconds, 2),
        "ms_a_task": round(1000 * seconds / len(tasks), 3),
        "peak_megabytes": round(peak, 1),
    }
    print(json.dumps(result, indent=2))
    good = done == len(tasks) == reports[-1].done and result["ms_a_task"] <= MOST_MILLISECONDS
    return 0 if good and peak <= MOST_MEGABYTES else 1


def task(results: Path, name: str, after: tuple[str, ...] = ()) -> JobTask:
    """A task whose result is a file."""
    path = results / name
    return JobTask(name, ("true",), path.exists, after, partial(progress_of, path), STEPS)


def progress_of(path: Path) -> int:
    """Number of steps done of a task."""
    return STEPS if path.exists() else 0
