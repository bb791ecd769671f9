# SPDX-License-Identifier: Apache-2.0
"""Start many `clsplat thumbnail` at once on an empty cache of kernels, and interrupt some of them in their first build.

    tools/stress/run cache [--processes 40] [--interrupted 10] [--seed 0] [--device DEVICE]

All processes share a new folder of caches, like the processes of a farm that share a home folder. Interrupted processes
get in turn Ctrl-C for their whole process group, SIGTERM and SIGKILL, at random times during the first builds. All
others must write the same picture as a process that runs alone. Then one more process must write it with the cache that
is left. The exit status is 0 if all these pictures are right, otherwise 1. The result is printed as JSON.
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
"""Maximum seconds until all processes have ended, even on a busy machine."""


def main(argv: Sequence[str]) -> int:
    """Run the processes, and print the result as JSON. Returns the exit status."""
    parser = plain_parser(__doc__)
    parser.add_argument("--processes", type=int, default=40, help="number of processes, default 40")
    parser.add_argument("--interrupted", type=int, default=10, help="number of interrupted processes, default 10")
    parser.add_argument("--seed", type=int, default=0, help="seed of the random times, default 0")
    parser.add_argument("--device", help="a device as listed by clsplat devices")
    arguments = parser.parse_args(argv)
    with tempfile.TemporaryDirectory(prefix="clsplat-cache-") as folder:
        result = stress(
            Path(folder), arguments.processes, arguments.interrupted, arguments.device, random.Random(arguments.seed)
        )
    print(json.dumps(result, indent=2))
    return 0 if result["right"] == result["left_alone"] and result["one_more"] == "right" else 1


def environment(cache: Path) -> dict[str, str]:
    """Environment of this process, with empty caches for the user, the drivers and clsplat."""
    cache.mkdir()
    values = {**os.environ, "XDG_CACHE_HOME": str(cache)}
    for name in ("POCL_CACHE_DIR", "CLSPLAT_BINARIES"):
        values.pop(name, None)
    return values


class Started:
    """A running `clsplat thumbnail`."""

    def __init__(self, model: Path, picture: Path, values: dict[str, str], device: str | None) -> None:
        self.picture, self.said = picture, picture.with_suffix(".txt")
        line = [sys.executable, "-m", "clsplat", "thumbnail", str(model), "-o", str(picture), "--size", "64"]
        line += ["--device", device] if device else []
        with self.said.open("wb") as said:
            self.process = subprocess.Popen(line, stdout=said, stderr=said, env=values, start_new_session=True)

    def interrupt(self, number: int) -> None:
        """Send a signal. Ctrl-C goes to the whole process group, as from a terminal."""
        if self.process.poll() is None:
            send = os.killpg if number == signal.SIGINT else os.kill
            send(self.process.pid, number)

    def end(self, wanted: bytes | None, until: float) -> str:
        """Wait until the time `until`. Returns `right`, or a description of the fault.

        wanted: bytes of the picture; None accepts any picture.
        """
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
    """Start all processes, interrupt some, and wait for the others. Returns how they ended."""
    model = folder / "model.ply"
    synthetic(300, 64, 64).gaussians.save(model)
    alone, start = environment(folder / "alone"), time.monotonic()
    first = Started(model, folder / "alone.png", alone, device)
    if (end := first.end(None, start + DEADLINE)) != "right":
        raise SystemExit(f"clsplat thumbnail, run alone: {end}, expected a picture")
    wanted, seconds = first.picture.read_bytes(), time.monotonic() - start

    shared, start = environment(folder / "shared"), time.monotonic()
    started = [Started(model, folder / f"{index:03d}.png", shared, device) for index in range(processes)]
    chosen = chance.sample(range(processes), interrupted)
    while not any(path.is_file() for path in Path(shared["XDG_CACHE_HOME"]).rglob("*")):
        time.sleep(0.01)
    # The processes share the cores. Signals come within a fifth of the time that all processes need.
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
