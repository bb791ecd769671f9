# SPDX-License-Identifier: Apache-2.0
"""Kill `clsplat render` at random times, finish with --skip-existing, and compare with an undisturbed call.

    tools/stress/run render_kills -o OUT --kills 10 -- MODEL --cameras SCENE --path turntable --count 120

The arguments after -- are those of `clsplat render`, without -o. The folders OUT/whole and OUT/killed are created, and
must not exist. After every kill, each existing frame must be complete. In the end all frames must have the same bytes
as undisturbed ones, and there must be no other files. The exit status is 0 if so, otherwise 1.
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
    """Run the test, and print its result as JSON. Returns the exit status."""
    parser = plain_parser(__doc__)
    parser.add_argument("-o", "--output", type=Path, required=True, help="folder for the two sequences")
    parser.add_argument("--kills", type=int, default=10, help="number of kills, default 10")
    parser.add_argument("--seed", type=int, default=0, help="seed of the random times, default 0")
    parser.add_argument("--extension", default="exr", help="extension of the files, default exr")
    parser.add_argument("render", nargs="+", help="arguments of clsplat render")
    arguments = parser.parse_args(argv)

    whole, killed = arguments.output / "whole", arguments.output / "killed"
    for folder in (whole, killed):
        if folder.exists():
            parser.error(f"{folder}: exists, expected a new folder")
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
        # up to 1.5 times the time of a frame, so that a kill may come at any point of a frame
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
    """The command line that renders the frames into the folder."""
    output = str(folder / f"frame.####.{extension}")
    return [sys.executable, "-m", "clsplat", "render", *render, "-o", output, "--skip-existing"]


def kill(line: Sequence[str], folder: Path, more: int, delay: float) -> int:
    """Start the command, and kill it `delay` seconds after it has completed `more` frames.

    Returns the number of frames in the folder.
    """
    before = count(folder)
    process = subprocess.Popen(line, stdout=subprocess.DEVNULL, start_new_session=True)
    while process.poll() is None and count(folder) < before + more:
        time.sleep(0.002)
    if more == 0:
        while process.poll() is None and count(folder, hidden=True) == before:  # until it begins to write
            time.sleep(0.002)
    time.sleep(delay)
    if process.poll() is None:
        os.killpg(process.pid, signal.SIGKILL)
    process.wait()
    return count(folder)


def count(folder: Path, *, hidden: bool = False) -> int:
    """Number of frames in the folder. hidden: also count frames that are being written."""
    return sum(hidden or path.name[0] != "." for path in folder.iterdir())
