# SPDX-License-Identifier: Apache-2.0
"""Kill dispatchers, commands, workers and schedulers of jobs at random times, and compare the results.

    tools/stress/run job_kills -o OUT --kills 30 [--dask]
    tools/stress/run job_kills -o OUT --kills 30 [--dask] -- SCENE --blocks 2 --iterations 600 --checkpoint-every 20

Without arguments after --, the tasks count in files (tests/support/counting.py), and notice if two processes count at
once. Otherwise these are arguments of `clsplat train`, without -o. OUT must not exist. With --dask the tasks run on a
Dask cluster of two workers, and workers and the scheduler are killed too. After each kill, what is missing is started
again by the same command. In the end the files must have the bytes of an undisturbed call, in OUT/whole. The exit
status is 0 if so, otherwise 1.
"""

from __future__ import annotations

import json
import os
import random
import re
import signal
import subprocess
import sys
import time
from collections import Counter
from collections.abc import Sequence
from contextlib import suppress
from pathlib import Path

import dispatching
from dask_processes import DaskProcesses
from measuring import plain_parser

TASKS, WORKERS = 4, 2
"""Number of tasks that can run at once, and of workers."""
STEP_SECONDS = 0.02
"""Seconds of a step."""
STEPS_A_KILL = 60
"""Steps of all tasks together for each kill, so that work is left until the last kill."""
CALM_SECONDS = 60.0
"""Seconds to wait at most for progress before a kill, so that most kills hit running tasks."""
EARLY_SHARE, EARLY_SECONDS = 0.25, 6.0
"""Share of kills that do not wait for progress, and the longest time after which they come."""
KILL_SECONDS = 1.5
"""Longest time from progress to a kill."""
FINISH_SECONDS = 1200.0
"""Seconds that the tasks have to end after the last kill."""
RESULTS = ("*.count", "merged.ply", "model.ply", "blocks/*/model.ply", "**/appearance.json")
"""Patterns of the files that are compared."""
_ATTEMPT = re.compile(r"^--- .*, process (\d+): ", re.MULTILINE)


def main(argv: Sequence[str]) -> int:
    """Run the test, and print its result as JSON. Returns the exit status."""
    parser = plain_parser(__doc__)
    parser.add_argument("-o", "--output", type=Path, required=True, help="folder for the tasks")
    parser.add_argument("--kills", type=int, default=30, help="number of kills, default 30")
    parser.add_argument("--seed", type=int, default=0, help="seed of the random times, default 0")
    parser.add_argument("--dask", action="store_true", help="on a Dask cluster; otherwise on local processes")
    parser.add_argument("train", nargs="*", help="arguments of clsplat train; without them the tasks count")
    arguments = parser.parse_args(argv)
    if arguments.output.exists():
        parser.error(f"{arguments.output}: exists, expected a new folder")
    whole, killed = arguments.output / "whole", arguments.output / "killed"
    for folder in (whole, killed, arguments.output / "dask"):
        folder.mkdir(parents=True)
    work = command(arguments.train, arguments.kills)
    subprocess.run([*work, *place(whole, arguments.train), "--workers", str(WORKERS)], check=True)
    cluster = DaskProcesses(arguments.output / "dask") if arguments.dask else None
    killer = Killer([*work, *place(killed, arguments.train)], killed, random.Random(arguments.seed), cluster)
    try:
        for _ in range(arguments.kills):
            killer.kill()
        status = killer.finish()
    finally:
        killer.close()
    wanted, found = contents(whole), contents(killed)
    wrong = sorted(name for name in wanted.keys() | found.keys() if wanted.get(name) != found.get(name))
    twice = [path.name for path in killer.logs() if "BlockingIOError" in path.read_text()]
    result = {"kills": killer.kills, "attempts": killer.attempts(), "files": len(wanted), "status": status}
    print(json.dumps({**result, "wrong": wrong, "twice": twice}, indent=2))
    return 1 if status or wrong or twice else 0


def command(train: Sequence[str], kills: int) -> list[str]:
    """The command of the dispatcher, without its folder and engine."""
    if train:
        return [sys.executable, "-m", "clsplat", "train", *train]
    steps = max(kills, 1) * STEPS_A_KILL // TASKS
    words = ["--tasks", str(TASKS), "--steps", str(steps), "--seconds", str(STEP_SECONDS)]
    return [sys.executable, dispatching.__file__, *words]


def place(folder: Path, train: Sequence[str]) -> list[str]:
    """The arguments that name the folder of the results."""
    return ["-o", str(folder)] if train else [str(folder)]


def contents(folder: Path) -> dict[str, bytes]:
    """The bytes of the results in a folder, by name."""
    paths = (path for pattern in RESULTS for path in folder.glob(pattern))
    return {str(path.relative_to(folder)): path.read_bytes() for path in paths}


class Killer:
    """A dispatcher with workers, which are killed and started again.

    words: the dispatcher's command without its engine. folder: folder of the results.
    cluster: the Dask cluster; None for local processes.
    """

    def __init__(
        self, words: Sequence[str], folder: Path, chance: random.Random, cluster: DaskProcesses | None
    ) -> None:
        self.words, self.folder, self.chance, self.cluster = words, folder, chance, cluster
        self.kills: Counter[str] = Counter()
        self.dispatcher: subprocess.Popen[bytes] | None = None

    def kill(self) -> None:
        """Start what is missing, wait for progress or a random time, and kill a process with SIGKILL."""
        self._start()
        early = self.chance.uniform(0.0, EARLY_SECONDS) if self.chance.random() < EARLY_SHARE else CALM_SECONDS
        before, until = self._size(), time.monotonic() + early
        while self._size() == before and time.monotonic() < until:
            time.sleep(0.02)
        time.sleep(self.chance.uniform(0.0, KILL_SECONDS))
        kind = self.chance.choice(
            ["dispatcher", "command", "attempt", *(["worker", "scheduler"] if self.cluster else [])]
        )
        pids = [pid for path in self.logs() for pid in map(int, _ATTEMPT.findall(path.read_text())) if is_attempt(pid)]
        if not pids and kind in ("command", "attempt"):
            kind = "dispatcher"
        with suppress(OSError, IndexError):  # the process has just ended
            if kind == "dispatcher":
                assert self.dispatcher is not None
                self.dispatcher.kill()
                self.dispatcher.wait()
            elif kind in ("worker", "scheduler"):
                assert self.cluster is not None
                self.cluster.kill(self.chance.choice("ab") if kind == "worker" else "scheduler")
            else:
                pid = self.chance.choice(pids)
                os.kill(pid if kind == "attempt" else children(pid)[0], signal.SIGKILL)
            self.kills[kind] += 1

    def finish(self) -> int:
        """Let the tasks end. Returns 0, or 1 if they have not ended after FINISH_SECONDS."""
        until = time.monotonic() + FINISH_SECONDS
        while time.monotonic() < until:
            self._start()  # three killed tries may end a dispatcher, and workers end after their scheduler
            assert self.dispatcher is not None
            with suppress(subprocess.TimeoutExpired):
                if self.dispatcher.wait(1.0) == 0:
                    return 0
        return 1

    def logs(self) -> list[Path]:
        """The tasks' logs."""
        return sorted((self.folder / "jobs").glob("*.log"))

    def attempts(self) -> int:
        """Number of attempts that have begun."""
        return sum(len(_ATTEMPT.findall(path.read_text())) for path in self.logs())

    def close(self) -> None:
        """Kill everything that is left."""
        if self.dispatcher is not None:
            self.dispatcher.kill()
            self.dispatcher.wait()
        if self.cluster is not None:
            self.cluster.close()

    def _size(self) -> int:
        """Number of bytes of the files that grow with each step."""
        paths = [*self.folder.glob("*.count"), *self.folder.rglob("metrics.jsonl")]
        return sum(path.stat().st_size for path in paths)

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
            with (self.folder.parent / "dispatcher.txt").open("ab") as log:
                self.dispatcher = subprocess.Popen([*self.words, *words], stdout=log, stderr=log)


def is_attempt(pid: int) -> bool:
    """True if a process with this id runs an attempt."""
    try:
        return b"clsplat.jobs.attempt" in Path(f"/proc/{pid}/cmdline").read_bytes()
    except OSError:
        return False


def children(pid: int) -> list[int]:
    """Process ids of the children of a process."""
    found = []
    for path in Path("/proc").glob("[0-9]*/stat"):
        with suppress(OSError, ValueError, IndexError):
            if int(path.read_text().rpartition(")")[2].split()[1]) == pid:
                found.append(int(path.parent.name))
    return found
