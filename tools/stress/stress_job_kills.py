# SPDX-License-Identifier: Apache-2.0
"""Kill dispatchers, commands, workers and schedulers of jobs at random times, and compare the results.

    tools/stress/run job_kills -o OUT --kills 30 [--dask]

The tasks count in files (tests/support/counting.py), and notice if two processes count at once. OUT must not exist.
With --dask the tasks run on a Dask cluster of two workers, and workers and the scheduler are killed too. After each
kill what is missing is started again by the same command. In the end all files must have the bytes of undisturbed
tasks. The exit status is 0 if so, otherwise 1.
"""

from __future__ import annotations

import json
import os
import random
import signal
import subprocess
import sys
import time
from collections import Counter
from collections.abc import Sequence
from contextlib import suppress
from pathlib import Path

import counting
import dispatching
from dask_processes import DaskProcesses
from measuring import plain_parser

TASKS, WORKERS = 4, 2
"""Number of tasks that can run at once, and of workers."""
STEP_SECONDS = 0.02
"""Seconds of a step."""
STEPS_A_KILL = 60
"""Steps of all tasks together for each kill, so that work is left until the last kill."""


def main(argv: Sequence[str]) -> int:
    """Run the test, and print its result as JSON. Returns the exit status."""
    parser = plain_parser(__doc__)
    parser.add_argument("-o", "--output", type=Path, required=True, help="folder for the tasks")
    parser.add_argument("--kills", type=int, default=30, help="number of kills, default 30")
    parser.add_argument("--seed", type=int, default=0, help="seed of the random times, default 0")
    parser.add_argument("--dask", action="store_true", help="on a Dask cluster; otherwise on local processes")
    arguments = parser.parse_args(argv)
    if arguments.output.exists():
        parser.error(f"{arguments.output}: exists, expected a new folder")
    killed = Killed(arguments.output, arguments.kills, arguments.seed, dask=arguments.dask)
    try:
        killed.kill_all()
        status = killed.finish()
    finally:
        killed.close()
    wrong = [name for name, data in killed.wanted().items() if (arguments.output / name).read_bytes() != data]
    twice = [path.name for path in killed.logs() if "BlockingIOError" in path.read_text()]
    result = {"kills": killed.kills, "attempts": killed.attempts(), "status": status, "wrong": wrong, "twice": twice}
    print(json.dumps(result, indent=2))
    return 1 if status or wrong or twice else 0


class Killed:
    """A dispatcher and its tasks, whose processes are killed.

    folder: folder of the tasks. count: number of kills.
    """

    def __init__(self, folder: Path, count: int, seed: int, *, dask: bool) -> None:
        self.folder, self.count, self.chance = folder, count, random.Random(seed)
        self.steps = count * STEPS_A_KILL // TASKS
        self.kills: Counter[str] = Counter()
        (folder / "dask").mkdir(parents=True)
        self.cluster = DaskProcesses(folder / "dask") if dask else None
        self.dispatcher: subprocess.Popen[bytes] | None = None

    def kill_all(self) -> None:
        """Kill processes `count` times, and start what is missing after each kill."""
        while self.kills.total() < self.count:
            self._start()
            before, until = self._counted(), time.monotonic() + self.chance.uniform(0.0, 20.0)
            while self._counted() == before and time.monotonic() < until:
                time.sleep(0.02)
            time.sleep(self.chance.uniform(0.0, 1.5))
            kinds = ["dispatcher", "command", "attempt", *(["worker", "scheduler"] if self.cluster else [])]
            kind = self.chance.choice(kinds)
            with suppress(OSError, ValueError, KeyError):  # the process has just ended
                self._kill(kind)
                self.kills[kind] += 1

    def finish(self) -> int:
        """Let the tasks end. Returns the dispatcher's exit status."""
        status = 1
        for _ in range(5):  # three tries without progress may have ended the running dispatcher
            self._start()
            assert self.dispatcher is not None
            status = self.dispatcher.wait(600)
            if status == 0:
                break
        return status

    def wanted(self) -> dict[str, bytes]:
        """The files of undisturbed tasks, by name."""
        names = {**{str(number): self.steps for number in range(TASKS)}, "sum": dispatching.SUM_STEPS}
        return {f"{name}.count": b"".join(b"%d\n" % step for step in range(steps)) for name, steps in names.items()}

    def logs(self) -> list[Path]:
        """The tasks' logs."""
        return sorted((self.folder / "jobs").glob("*.log"))

    def attempts(self) -> int:
        """Number of attempts that have begun."""
        return sum(path.read_text().count("--- ") for path in self.logs())

    def close(self) -> None:
        """Kill everything that is left."""
        if self.dispatcher is not None:
            self.dispatcher.kill()
            self.dispatcher.wait()
        if self.cluster is not None:
            self.cluster.close()

    def _counted(self) -> int:
        """Number of steps that are counted in all files."""
        return sum(counting.counted(self.folder, str(number)) for number in range(TASKS))

    def _start(self) -> None:
        """Start the scheduler, the workers and the dispatcher, if they do not run."""
        words = ["--workers", str(WORKERS)]
        if self.cluster is not None:
            words = ["--scheduler", self.cluster.address]
            if not self.cluster.runs("scheduler"):
                self.cluster.start_scheduler()
            for name in "ab"[:WORKERS]:
                if not self.cluster.runs(name):
                    self.cluster.start_worker(name)
        if self.dispatcher is None or self.dispatcher.poll() is not None:
            words = [*words, "--tasks", str(TASKS), "--steps", str(self.steps), "--seconds", str(STEP_SECONDS)]
            command = [sys.executable, dispatching.__file__, str(self.folder), *words]
            self.dispatcher = subprocess.Popen(command, stdout=subprocess.DEVNULL, stderr=subprocess.DEVNULL)

    def _kill(self, kind: str) -> None:
        """Kill a process of this kind with SIGKILL. Raises OSError, ValueError or KeyError if there is none."""
        if kind == "dispatcher":
            assert self.dispatcher is not None
            os.kill(self.dispatcher.pid, signal.SIGKILL)
            self.dispatcher.wait()
        elif kind in ("worker", "scheduler"):
            assert self.cluster is not None
            self.cluster.kill(self.chance.choice("ab") if kind == "worker" else "scheduler")
        else:
            names = [str(number) for number in range(TASKS) if not (self.folder / f"{number}.done").exists()]
            pid = int((self.folder / f"{self.chance.choice([*names, 'sum'])}.pid").read_text())
            if f"{counting.__name__}.py".encode() not in Path(f"/proc/{pid}/cmdline").read_bytes():
                raise ValueError(f"{pid}: another process")
            os.kill(pid if kind == "command" else parent(pid), signal.SIGKILL)


def parent(pid: int) -> int:
    """Process id of the parent of a process. Raises OSError."""
    return int(Path(f"/proc/{pid}/stat").read_text().rpartition(")")[2].split()[1])
