# SPDX-License-Identifier: Apache-2.0
"""Kills `clsplat render` at random moments, finishes with --skip-existing, and compares with an undisturbed run.

    tools/stress/run render_kills -o OUT --kills 10 -- MODEL --cameras SCENE --path turntable --count 120

What follows -- are arguments of `clsplat render` without -o. OUT/whole and OUT/killed are made and must not exist.
After every kill each frame that is there has to be whole, and in the end all have to be the same, byte for byte, with
nothing beside them. Exit status 0 if so, else 1.
"""

from __future__ import annotations

import json
import os
import random
import signal
import subprocess
import sys
import time
from collections.abc import Sequence
from pathlib import Path

from measuring import plain_parser
from rendered import contents


def main(argv: Sequence[str]) -> int:
    """Run it; prints what it found as JSON."""
    parser = plain_parser(__doc__)
    parser.add_argument("-o", "--output", type=Path, required=True, help="folder for the two sequences")
    parser.add_argument("--kills", type=int, default=10, help="default 10")
    parser.add_argument("--seed", type=int, default=0, help="of the moments, default 0")
    parser.add_argument("--extension", default="exr", help="of the files, default exr")
    parser.add_argument("render", nargs="+", help="arguments of clsplat render")
    arguments = parser.parse_args(argv)

    whole, killed = arguments.output / "whole", arguments.output / "killed"
    for folder in (whole, killed):
        if folder.exists():
            parser.error(f"{folder} is there already")
    killed.mkdir(parents=True)
    all_of_it, rest = (command(arguments.render, folder, arguments.extension) for folder in (whole, killed))
    start = time.monotonic()
    subprocess.run(all_of_it, check=True, stdout=subprocess.DEVNULL)
    seconds = time.monotonic() - start
    wanted = contents(whole)
    ends = sorted(path.stat().st_mtime for path in whole.iterdir())
    pace = (ends[-1] - ends[0]) / max(len(ends) - 1, 1)
    chance = random.Random(arguments.seed)
    kills, troubles = [], []
    for _ in range(arguments.kills):
        more = chance.randint(0, len(wanted) // (arguments.kills + 1))
        # a little more than the time of a frame, so that a kill may come at any point of it
        delay = chance.uniform(0, 1.5 * pace)
        kills.append(kill(rest, killed, more, delay))
        troubles += [name for name, data in contents(killed).items() if name[0] != "." and wanted.get(name) != data]
    finished = subprocess.run(rest, check=False, stdout=subprocess.DEVNULL)
    same = contents(killed) == wanted and finished.returncode == 0
    result = {
        "frames": len(wanted),
        "seconds": round(seconds, 2),
        "frames_after_each_kill": kills,
        "damaged": troubles,
        "same": same,
    }
    print(json.dumps(result, indent=2))
    return 0 if same and not troubles else 1


def command(render: Sequence[str], folder: Path, extension: str) -> list[str]:
    """The command line for a sequence in the folder."""
    output = str(folder / f"frame.####.{extension}")
    return [sys.executable, "-m", "clsplat", "render", *render, "-o", output, "--skip-existing"]


def kill(line: Sequence[str], folder: Path, more: int, delay: float) -> int:
    """Start the command, kill it `delay` seconds after `more` further frames are there; returns the number of frames
    there."""
    before = count(folder)
    process = subprocess.Popen(line, stdout=subprocess.DEVNULL, start_new_session=True)
    while process.poll() is None and count(folder) < before + more:
        time.sleep(0.002)
    if more == 0:
        while process.poll() is None and count(folder, hidden=True) == before:  # until it writes its first
            time.sleep(0.002)
    time.sleep(delay)
    if process.poll() is None:
        os.killpg(process.pid, signal.SIGKILL)
    process.wait()
    return count(folder)


def count(folder: Path, *, hidden: bool = False) -> int:
    """Frames in the folder, with those that are being written if hidden."""
    return sum(hidden or path.name[0] != "." for path in folder.iterdir())
