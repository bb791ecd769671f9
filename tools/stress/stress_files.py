# SPDX-License-Identifier: Apache-2.0
"""Spoil valid files of every kind at random, and give them to their readers.

    tools/stress/run files [--cases 100000] [--seed 0] [--readers ply,scene,...] [--jobs N] [--keep FOLDER]
    tools/stress/run files --readers ply --first 1234 --cases 1        # a case again, by its number

A case passes if the reader returns, or raises an InputError of one line that names a file. Everything else is a
failure: another exception, a warning of several lines, a crash of the process, more than --seconds of CPU time, or more
than --memory MiB. The spoilt files of failures are kept in the folder --keep. The exit status is 1 after a failure.
"""

from __future__ import annotations

import argparse
import contextlib
import json
import multiprocessing
import os
import random
import resource
import shutil
import sys
import tempfile
import threading
import time
import traceback
import warnings
from collections import Counter
from collections.abc import Iterator
from dataclasses import dataclass, field
from multiprocessing.connection import Connection
from pathlib import Path
from typing import Any

from hostile import READERS, Reader, spoil

from clsplat.errors import ClsplatError
from clsplat.progress import aligned

MIB = 1 << 20
SPOILING = 60
"""Seconds, in addition to --seconds, after which a case counts as hung. They include the spoiling, and allow for a busy
machine."""


@dataclass
class Tally:
    """Counts of a reader's cases.

    refused: number of cases in which the reader raised an error.
    slowest: seconds and number of the slowest case.
    peak: additional MiB and number of the case that took most memory.
    """

    cases: int = 0
    refused: int = 0
    slowest: tuple[float, int] = (0.0, -1)
    peak: tuple[float, int] = (0.0, -1)
    failures: list[tuple[int, str]] = field(default_factory=list)

    def add(self, other: Tally) -> None:
        """Add the counts of another tally."""
        self.cases += other.cases
        self.refused += other.refused
        self.slowest, self.peak = max(self.slowest, other.slowest), max(self.peak, other.peak)
        self.failures += other.failures


def numbered(seed: int, reader: str, case: int) -> random.Random:
    """The random generator of a case."""
    return random.Random(f"{seed} {reader} {case}")


def verdict(reader: Reader, folder: Path) -> tuple[bool, str]:
    """Give the files to the reader. Returns True if it raised an error, and a description of the failure or ""."""
    with warnings.catch_warnings(record=True) as heard:
        warnings.simplefilter("always")
        try:
            reader.read(folder)
        except ClsplatError as error:
            message = str(error)
            if error.exit_status != 2:
                return True, f"{type(error).__name__}, expected InputError: {message[:300]}"
            if "\n" in message or "\r" in message or not message.isprintable():
                return True, f"an error that is not a plain line: {message[:300]!r}"
            if str(folder) not in message:
                return True, f"an error that names no file: {message[:300]}"
            return True, ""
        except BaseException as error:  # noqa: BLE001  # any other exception is a failure
            where = traceback.extract_tb(error.__traceback__)[-1]
            return True, f"{type(error).__name__} at {Path(where.filename).name}:{where.lineno}: {str(error)[:300]}"
    bad = next((str(each.message) for each in heard if not str(each.message).isprintable()), None)
    return False, f"a warning that is not a plain line: {bad[:300]!r}" if bad else ""


@contextlib.contextmanager
def spoilt(reader: Reader, valid: Path, folder: Path, seed: int, case: int) -> Iterator[str]:
    """A context manager, inside which `folder` is a spoilt copy of the reader's valid files. It gives a description of
    the changes."""
    shutil.copytree(valid, folder, symlinks=True)
    try:
        yield spoil(reader, folder, numbered(seed, reader.name, case))
    finally:
        shutil.rmtree(folder, ignore_errors=True)


def _status(name: str) -> float:
    """A value of /proc/self/status in MiB."""
    with open("/proc/self/status", encoding="ascii") as file:
        return next(int(line.split()[1]) / 1024 for line in file if line.startswith(name))


def _work(tasks: Connection, names: list[str], seed: int, memory: int, most_seconds: float, scratch: str) -> None:
    """Run cases in a worker process, until it receives None.

    tasks: receives (reader, first, stop). Sends ("case", number) and ("done", seconds, MiB, refused, trouble) for each
    case, then ("end",).
    memory, most_seconds: maximum MiB and CPU seconds of a case; with more it fails.
    """
    import signal

    signal.signal(signal.SIGINT, signal.SIG_IGN)
    quiet = os.open(os.devnull, os.O_WRONLY)
    os.dup2(quiet, 1)  # decoders may print
    os.dup2(quiet, 2)
    root = Path(tempfile.mkdtemp(prefix="worker-", dir=scratch))
    readers = {name: READERS[name] for name in names}
    valid = {}
    for name, reader in readers.items():
        valid[name] = root / f"{name}-valid"
        valid[name].mkdir()
        reader.make(valid[name])
        reader.read(valid[name])  # loads all modules before memory is measured
    with open("/proc/self/statm", encoding="ascii") as file:
        size = int(file.read().split()[0]) * resource.getpagesize()
    limit = size + memory * MIB
    resource.setrlimit(resource.RLIMIT_AS, (limit, limit))
    resource.setrlimit(resource.RLIMIT_CORE, (0, 0))
    while (task := tasks.recv()) is not None:
        name, first, stop = task
        for case in range(first, stop):
            tasks.send(("case", case))
            try:
                with spoilt(readers[name], valid[name], root / "case", seed, case):
                    Path("/proc/self/clear_refs").write_text("5", encoding="ascii")
                    before, start = _status("VmRSS"), time.process_time()
                    refused, trouble = verdict(readers[name], root / "case")
                    seconds, peak = time.process_time() - start, _status("VmHWM") - before
            except Exception as error:  # noqa: BLE001  # a defect of these tools, reported like a failure
                seconds, peak, refused, trouble = 0.0, 0.0, False, f"no case: {type(error).__name__}: {error}"
            if peak > memory and not trouble:
                trouble = f"{peak:.0f} MiB of memory"
            if seconds > most_seconds and not trouble:
                trouble = f"{seconds:.0f} s"
            tasks.send(("done", seconds, peak, refused, trouble))
        tasks.send(("end",))


class _Worker:
    """A worker process. It is started again if a case has ended it or has taken too long."""

    def __init__(self, names: list[str], seed: int, memory: int, seconds: float, scratch: str) -> None:
        self.arguments, self.seconds = (names, seed, memory, seconds, scratch), seconds
        self._start()

    def _start(self) -> None:
        self.pipe, other = multiprocessing.Pipe()
        context = multiprocessing.get_context("spawn")  # readers start threads, which do not survive a fork
        self.process = context.Process(target=_work, args=(other, *self.arguments), daemon=True)
        self.process.start()
        other.close()

    def run(self, name: str, first: int, stop: int, tally: Tally) -> None:
        while first < stop:
            self.pipe.send((name, first, stop))
            case, trouble, started = first, "", False
            try:
                while True:
                    if not self.pipe.poll(self.seconds + SPOILING if started else 120):
                        trouble = f"not done after {self.seconds:g} s"
                        break
                    answer = self.pipe.recv()
                    if answer[0] == "case":
                        case, started = answer[1], True
                    elif answer[0] == "end":
                        return
                    else:
                        tally.add(_one(case, *answer[1:]))
            except (EOFError, ConnectionError):
                self.process.join(10)
                trouble = f"the process ended, status {self.process.exitcode}"
            self.close()
            tally.add(_one(case, self.seconds if "done" in trouble else 0.0, 0.0, True, trouble))
            first = case + 1
            self._start()

    def close(self) -> None:
        self.process.kill()
        self.process.join()
        self.pipe.close()


def _one(case: int, seconds: float, peak: float, refused: bool, trouble: str) -> Tally:
    return Tally(1, int(refused), (seconds, case), (peak, case), [(case, trouble)] if trouble else [])


def stress(
    names: list[str],
    cases: int,
    *,
    seed: int = 0,
    first: int = 0,
    jobs: int = 1,
    memory: int = 1024,
    seconds: float = 20.0,
) -> dict[str, Tally]:
    """Run `cases` cases, divided among the readers by their weights. Returns the tally of each reader.

    first: number of each reader's first case.
    memory, seconds: maximum MiB and CPU seconds of a case; with more it fails.
    """
    weights = {name: READERS[name].weight for name in names}
    share = {name: max(round(cases * weight / sum(weights.values())), 1) for name, weight in weights.items()}
    chunks = [
        (name, start, min(start + 500, first + share[name]))
        for name in names
        for start in range(first, first + share[name], 500)
    ]
    tallies = {name: [Tally() for _ in range(jobs)] for name in names}
    lock = threading.Lock()

    def work(index: int, scratch: str) -> None:
        worker = _Worker(names, seed, memory, seconds, scratch)
        try:
            while True:
                with lock:
                    if not chunks:
                        return
                    name, start, stop = chunks.pop(0)
                worker.run(name, start, stop, tallies[name][index])
        finally:
            worker.close()

    memory_disk = "/dev/shm" if os.access("/dev/shm", os.W_OK) else None  # noqa: S108  # a folder in it is made safely
    with tempfile.TemporaryDirectory(prefix="clsplat-hostile-", dir=memory_disk) as scratch:
        threads = [threading.Thread(target=work, args=(index, scratch)) for index in range(jobs)]
        for thread in threads:
            thread.start()
        for thread in threads:
            thread.join()
    return {name: _sum(each) for name, each in tallies.items()}


def _sum(parts: list[Tally]) -> Tally:
    whole = Tally()
    for part in parts:
        whole.add(part)
    whole.failures.sort()
    return whole


def keep(folder: Path, name: str, case: int, seed: int) -> Path:
    """Make the files of a case again, in a folder of their own inside `folder`, and return that folder."""
    target = folder / f"{name}-{case}"
    shutil.rmtree(target, ignore_errors=True)
    target.mkdir(parents=True)
    READERS[name].make(target)
    done = spoil(READERS[name], target, numbered(seed, name, case))
    (target / "what-was-done.txt").write_text(done + "\n", encoding="utf-8", errors="replace")
    return target


def table(tallies: dict[str, Tally]) -> str:
    """Text table with a line for each reader."""
    rows = [("reader", "cases", "refused", "slowest", "most memory", "failures")]
    for name, tally in {**tallies, "all": _sum(list(tallies.values()))}.items():
        most = f"{tally.slowest[0]:.2f} s", f"{tally.peak[0]:.0f} MiB"
        rows.append((name, f"{tally.cases:,}", f"{tally.refused:,}", *most, f"{len(tally.failures):,}"))
    return "\n".join(aligned(rows))


def main(arguments: list[str]) -> int:
    """Run the cases and print the table. Returns the exit status."""
    parser = argparse.ArgumentParser(prog="stress_files", description=(__doc__ or "").splitlines()[0])
    parser.add_argument("--cases", type=int, default=100_000)
    parser.add_argument("--seed", type=int, default=0)
    parser.add_argument("--first", type=int, default=0, help="number of each reader's first case")
    parser.add_argument("--readers", default=",".join(READERS), help=f"some of {', '.join(READERS)}")
    parser.add_argument("--jobs", type=int, default=os.cpu_count() or 1)
    parser.add_argument("--memory", type=int, default=1024, help="maximum MiB of memory of a case")
    parser.add_argument("--seconds", type=float, default=20.0, help="maximum CPU seconds of a case")
    parser.add_argument("--keep", type=Path, help="folder for the files of failures")
    parser.add_argument("--json", action="store_true")
    options = parser.parse_args(arguments)
    names = options.readers.split(",")
    if unknown := [name for name in names if name not in READERS]:
        print(f"stress_files: error: no reader {unknown[0]!r}, expected some of {', '.join(READERS)}", file=sys.stderr)
        return 2
    limits: dict[str, Any] = {"jobs": options.jobs, "memory": options.memory, "seconds": options.seconds}
    tallies = stress(names, options.cases, seed=options.seed, first=options.first, **limits)
    failed = sum(len(tally.failures) for tally in tallies.values())
    if options.json:
        print(json.dumps({name: vars(tally) for name, tally in tallies.items()}, indent=2))
    else:
        print(table(tallies))
    for name, tally in tallies.items():
        kinds = Counter(trouble.split(":")[0] + trouble.split(":")[-1][:60] for _, trouble in tally.failures)
        for case, trouble in tally.failures[:20]:
            kept = f", kept in {keep(options.keep, name, case, options.seed)}" if options.keep else ""
            print(f"{name} {case}: {trouble}{kept}", file=sys.stderr)
        if len(tally.failures) > 20:
            print(f"{name}: {len(tally.failures)} failures, the commonest: {kinds.most_common(5)}", file=sys.stderr)
    return int(failed > 0)
