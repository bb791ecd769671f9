# SPDX-License-Identifier: Apache-2.0
"""Commands that count in a file, for tests of jobs. Two that count at the same time are found out.

    python counting.py FOLDER NAME STEPS [--seconds SECONDS] [--at-once STEPS]

Each step adds a line to FOLDER/NAME.count. FOLDER/NAME.done at the end has the SHA-256 of the lines. A second process
that counts in FOLDER/NAME.count fails.
"""

from __future__ import annotations

import argparse
import hashlib
import os
import sys
import time
from pathlib import Path
from typing import TYPE_CHECKING

if TYPE_CHECKING:
    from clsplat.jobs.task import JobTask


def counting_task(
    folder: Path, name: str, steps: int, *, after: tuple[str, ...] = (), seconds: float = 0.0, at_once: int = 0
) -> JobTask:
    """A task of `steps` steps, each of which takes `seconds`.

    at_once: number of steps after which the command fails, 0 for none.
    """
    from clsplat.jobs.task import JobTask  # here, as the command needs no clsplat

    words = [sys.executable, __file__, str(folder), name, str(steps), "--seconds", str(seconds)]
    return JobTask(
        name,
        (*words, "--at-once", str(at_once)),
        lambda: (folder / f"{name}.done").exists() and counted(folder, name) >= steps,
        after,
        lambda: counted(folder, name),
        steps,
    )


def counted(folder: Path, name: str) -> int:
    """Number of steps that a task has counted."""
    try:
        return (folder / f"{name}.count").read_text().count("\n")
    except OSError:
        return 0


def main() -> int:
    """Count on from where the file ends."""
    parser = argparse.ArgumentParser()
    parser.add_argument("folder", type=Path)
    parser.add_argument("name")
    parser.add_argument("steps", type=int)
    parser.add_argument("--seconds", type=float, default=0.0)
    parser.add_argument("--at-once", type=int, default=0)
    arguments = parser.parse_args()
    (arguments.folder / f"{arguments.name}.pid").write_text(str(os.getpid()))
    path = arguments.folder / f"{arguments.name}.count"
    with path.open("a+") as file:
        if sys.platform != "win32":
            import fcntl

            fcntl.flock(file, fcntl.LOCK_EX | fcntl.LOCK_NB)
        file.seek(0)
        begun = file.read().count("\n")
        for step in range(begun, arguments.steps):
            if arguments.at_once and step - begun == arguments.at_once:
                return 3
            time.sleep(arguments.seconds)
            file.write(f"{step}\n")
            file.flush()
    (arguments.folder / f"{arguments.name}.done").write_text(hashlib.sha256(path.read_bytes()).hexdigest())
    return 0


if __name__ == "__main__":
    sys.exit(main())
