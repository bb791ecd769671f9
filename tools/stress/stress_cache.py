# SPDX-License-Identifier: Apache-2.0
"""Starts many `clsplat thumbnail` at once on an empty cache of kernels, and interrupts some of them in their first
build.

    tools/stress/run cache [--processes 40] [--interrupted 10] [--seed 0] [--device DEVICE]

All share one folder of caches, which is made for it, as the processes of a farm share a home. An interrupted one gets,
by turns, a Ctrl-C that reaches its whole group, SIGTERM or SIGKILL, at a random moment of the first builds. Each of the
others has to write the picture that a process alone writes; then one more does, on what is left of the cache. Exit
status 1 if one of them does not, else 0. The result is JSON.
"""

from __future__ import annotations

import json
import os
import random
import signal
import subprocess
import sys
import tempfile
import time
from collections import Counter
from collections.abc import Sequence
from pathlib import Path
from typing import Any

from measuring import plain_parser

from clsplat.bench.workload import synthetic

SIGNALS = (signal.SIGINT, signal.SIGTERM, signal.SIGKILL)
DEADLINE = 1200.0
"""Seconds that all of them may take together, however busy the machine is."""


def main(argv: Sequence[str]) -> int:
    """Run it; prints what it found as JSON."""
    parser = plain_parser(__doc__)
    parser.add_argument("--processes", type=int, default=40, help="default 40")
    parser.add_argument("--interrupted", type=int, default=10, help="of them, default 10")
    parser.add_argument("--seed", type=int, default=0, help="of the moments, default 0")
    parser.add_argument("--device", help="as clsplat devices lists them")
    arguments = parser.parse_args(argv)
    with tempfile.TemporaryDirectory(prefix="clsplat-cache-") as folder:
        result = stress(
            Path(folder), arguments.processes, arguments.interrupted, arguments.device, random.Random(arguments.seed)
        )
    print(json.dumps(result, indent=2))
    return 0 if result["right"] == result["left_alone"] and result["one_more"] == "right" else 1


def environment(cache: Path) -> dict[str, str]:
    """This one's, with an empty cache of the user's, of drivers and of ours."""
    cache.mkdir()
    values = {**os.environ, "XDG_CACHE_HOME": str(cache)}
    for name in ("POCL_CACHE_DIR", "CLSPLAT_BINARIES"):
        values.pop(name, None)
    return values


class Started:
    """A `clsplat thumbnail` that is under way."""

    def __init__(self, model: Path, picture: Path, values: dict[str, str], device: str | None) -> None:
        self.picture, self.said = picture, picture.with_suffix(".txt")
        line = [sys.executable, "-m", "clsplat", "thumbnail", str(model), "-o", str(picture), "--size", "64"]
        line += ["--device", device] if device else []
        with self.said.open("wb") as said:
            self.process = subprocess.Popen(line, stdout=said, stderr=said, env=values, start_new_session=True)

    def interrupt(self, number: int) -> None:
        """Send a signal: Ctrl-C to all of its group, as a terminal does."""
        if self.process.poll() is None:
            send = os.killpg if number == signal.SIGINT else os.kill
            send(self.process.pid, number)

    def end(self, wanted: bytes | None, until: float) -> str:
        """`right`, or what is wrong."""
        try:
            status = self.process.wait(max(until - time.monotonic(), 1.0))
        except subprocess.TimeoutExpired:
            self.process.kill()
            return "did not end"
        if status:
            words = self.said.read_text(errors="replace").strip().splitlines()
            return f"status {status}: {words[-1][:400] if words else ''}"
        if wanted is not None and self.picture.read_bytes() != wanted:
            return "another picture"
        return "right"


def stress(folder: Path, processes: int, interrupted: int, device: str | None, chance: random.Random) -> dict[str, Any]:
    """Start them all, interrupt some, and wait for the rest; how they ended."""
    model = folder / "model.ply"
    synthetic(300, 64, 64).gaussians.save(model)
    alone, start = environment(folder / "alone"), time.monotonic()
    first = Started(model, folder / "alone.png", alone, device)
    if (end := first.end(None, start + DEADLINE)) != "right":
        raise SystemExit(f"a process alone ends so: {end}")
    wanted, seconds = first.picture.read_bytes(), time.monotonic() - start

    shared, start = environment(folder / "shared"), time.monotonic()
    started = [Started(model, folder / f"{index:03d}.png", shared, device) for index in range(processes)]
    chosen = chance.sample(range(processes), interrupted)
    while not any(path.is_file() for path in Path(shared["XDG_CACHE_HOME"]).rglob("*")):
        time.sleep(0.01)
    # all share the processors, so that the builds of each take a good part of as many times those of one
    share = 0.2 * seconds * processes / (os.cpu_count() or 1)
    moments = sorted(chance.uniform(0, share) for _ in chosen)
    begin = time.monotonic()
    under_way = 0
    for turn, (index, moment) in enumerate(zip(chosen, moments, strict=True)):
        time.sleep(max(begin + moment - time.monotonic(), 0.0))
        under_way += started[index].process.poll() is None
        started[index].interrupt(SIGNALS[turn % len(SIGNALS)])
    ends = [one.end(wanted, start + DEADLINE) for index, one in enumerate(started) if index not in chosen]
    for index in chosen:
        started[index].process.wait()
    took = time.monotonic() - start
    more = Started(model, folder / "more.png", shared, device).end(wanted, time.monotonic() + DEADLINE)
    return {
        "processes": processes,
        "interrupted": interrupted,
        "of_them_under_way": under_way,
        "left_alone": len(ends),
        "right": ends.count("right"),
        "one_more": more,
        "ends": dict(Counter(end for end in ends if end != "right")),
        "seconds_alone": round(seconds, 1),
        "seconds": round(took, 1),
    }
