# SPDX-License-Identifier: Apache-2.0
"""A task, one attempt at it, the attempt's outcome, and the interface of engines, which run attempts."""

from __future__ import annotations

import os
import re
import secrets
from collections.abc import Callable, Sequence
from contextlib import suppress
from dataclasses import asdict, dataclass, field
from pathlib import Path
from typing import Any, Literal, Protocol

from clsplat.files.atomic import remove, replace, temporary_name
from clsplat.version import package_version

MARK_FILE_NAME = "mark"
"""Name of a file of random digits in the jobs folder, by which workers know that they see the dispatcher's folder."""
ATTEMPT_PREFIX = "--- "
"""Beginning of the line of a log with which an attempt begins."""
LOG_END_BYTES = 1 << 12
"""Number of bytes at the end of a log in which `last_line` looks for a line."""
_TASK_NAME = re.compile(r"[A-Za-z0-9_-][A-Za-z0-9_.-]*")


@dataclass(frozen=True)
class JobTask:
    """A command that can be repeated: it returns at once if its result exists, and goes on after an interruption.

    Only the dispatcher calls the functions. They read files, because another process may have done the work.

    name: name of the task, of letters, digits, "_", "-" and "."; its log is NAME.log.
    command: the command with its arguments and absolute paths. A first word "clsplat" means the worker's own clsplat.
    after: names of the tasks that have to be done first.
    is_done: returns True if the task's result exists.
    progress: returns the number of steps done, from 0 to `total`.
    total: number of steps of the task.
    """

    name: str
    command: tuple[str, ...]
    is_done: Callable[[], bool]
    after: tuple[str, ...] = ()
    progress: Callable[[], int] = field(default=lambda: 0)
    total: int = 1


@dataclass(frozen=True)
class Attempt:
    """One run of a task's command, as it is sent to a worker.

    name, command: as in `JobTask`.
    folder: absolute path of the folder of claims and logs.
    needs: absolute paths of files and folders that the worker has to see.
    mark: content of the file MARK_FILE_NAME in `folder`.
    version: version of clsplat that the worker must have.
    """

    name: str
    command: tuple[str, ...]
    folder: str
    needs: tuple[str, ...]
    mark: str
    version: str = package_version()

    def document(self) -> dict[str, Any]:
        """The attempt as a JSON object."""
        return asdict(self)


@dataclass(frozen=True)
class Outcome:
    """How an attempt ended.

    name: name of the task.
    kind: "ended": the command ended. "claimed": another process has the task's claim.
      "unfit": the worker cannot run tasks. "lost": the worker ended, or no longer answers.
    status: exit status of the command; negative for a signal.
    reason: why the worker is unfit or lost.
    worker: the worker, as a user knows it.
    """

    name: str
    kind: Literal["ended", "claimed", "unfit", "lost"]
    status: int = 0
    reason: str = ""
    worker: str = ""


class Engine(Protocol):
    """Runs attempts at the same time. Only one thread calls the methods."""

    def free(self) -> int:
        """Number of attempts that can be started now."""

    def start(self, attempt: Attempt) -> None:
        """Start an attempt, while `free` is at least 1."""

    def wait(self, seconds: float) -> list[Outcome]:
        """Wait at most `seconds` for outcomes. Returns those that have come, or an empty list.

        Raises ClsplatError if the engine cannot go on.
        """

    def leave_out(self, worker: str) -> bool:
        """Start no more attempts on an unfit worker. Returns False if no other worker is left."""

    def stop(self) -> None:
        """End all attempts, and return when their processes have ended."""


def check_tasks(tasks: Sequence[JobTask]) -> None:
    """Raise ValueError if names are unfit or not unique, or if tasks wait for each other or for unknown ones."""
    tasks_by_name = {task.name: task for task in tasks}
    if len(tasks_by_name) != len(tasks):
        raise ValueError("tasks: two have the same name, expected different names")
    left = {}
    for task in tasks:
        if not _TASK_NAME.fullmatch(task.name) or task.name == MARK_FILE_NAME:
            raise ValueError(f"task {task.name!r}: expected a name of letters, digits, '_', '-' and '.'")
        if unknown := set(task.after) - set(tasks_by_name):
            raise ValueError(f"task {task.name}: is after {min(unknown)}, which is not a task")
        left[task.name] = len(set(task.after))
    followers = followers_of(tasks)
    ready = [name for name, count in left.items() if count == 0]
    done = 0
    while ready:
        done += 1
        for follower in followers[ready.pop()]:
            left[follower] -= 1
            if left[follower] == 0:
                ready.append(follower)
    if done < len(tasks):
        waiting = min(name for name, count in left.items() if count)
        raise ValueError(f"task {waiting}: waits for a task that waits for itself, expected tasks in an order")


def followers_of(tasks: Sequence[JobTask]) -> dict[str, list[str]]:
    """The names of the tasks that come directly after each task, by the task's name."""
    followers: dict[str, list[str]] = {task.name: [] for task in tasks}
    for task in tasks:
        for before in set(task.after):
            followers[before].append(task.name)
    return followers


def mark_of(folder: Path) -> str:
    """The content of the folder's file MARK_FILE_NAME, which is written first if it is missing. Raises OSError."""
    path = folder / MARK_FILE_NAME
    if not path.exists():
        temporary = temporary_name(path)
        try:
            temporary.write_bytes(secrets.token_hex(16).encode())
            _link_if_missing(temporary, path)
        finally:
            remove(temporary)
    return path.read_text(encoding="ascii", errors="replace")


def _link_if_missing(source: Path, path: Path) -> None:
    """Make `path` a hard link to `source`, unless another dispatcher has made a file there."""
    try:
        os.link(source, path)
    except FileExistsError:
        pass
    except OSError:  # a file system without hard links
        if not path.exists():
            replace(source, path)


def log_path(folder: str | Path, name: str) -> Path:
    """Path of a task's log."""
    return Path(folder) / f"{name}.log"


def last_line(log: Path) -> str:
    """The last line of a log that is not empty, without the prefix of clsplat's errors; empty if there is none."""
    with suppress(OSError), log.open("rb") as file:
        file.seek(max(log.stat().st_size - LOG_END_BYTES, 0))
        lines = file.read().decode("utf-8", errors="replace").splitlines()
        return next((line.strip() for line in reversed(lines) if line.strip()), "").removeprefix("clsplat: error: ")
    return ""
