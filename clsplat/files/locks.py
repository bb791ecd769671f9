# SPDX-License-Identifier: Apache-2.0
"""Locks and claims: files that say which process is at work on another file."""

from __future__ import annotations

import os
import secrets
import time
from collections.abc import Iterable, Iterator
from contextlib import contextmanager, suppress
from pathlib import Path

from clsplat.files.atomic import ABANDONED_FILE_SECONDS, TEMPORARY_NAME, is_abandoned, machine_mark, remove
from clsplat.files.names import ON_WINDOWS

EMPTY_CLAIM_SECONDS = 20
"""Seconds after which a claim in which nothing stands is taken over."""
CLAIM_SUFFIX = ".clsplat-claim"
_PROCESS_TOKEN = secrets.token_hex(4)
"""Mark that tells this process from one of the same number, before it or on another machine."""


@contextmanager
def locked(path: Path, seconds: float = 5.0) -> Iterator[None]:
    """Inside, no other process is inside with this file, which need not be there: FILE.lock beside it says so.

    It is no lock of the system's, unlike `locks.locked`: those do not keep a process's own threads apart, and homes on
    a network, where this is used, may have none. A lock older than `seconds` is of a process that was killed, and is
    taken away. After waiting for twice as long a process goes on without. Raises OSError where the folder cannot be
    written.
    """
    lock, token = path.with_name(f"{path.name}.lock"), secrets.token_bytes(8)
    until = time.monotonic() + 2 * seconds
    while not (ours := _take(lock, token)) and time.monotonic() < until:
        with suppress(OSError):
            if time.time() - lock.stat().st_mtime > seconds:
                lock.unlink()
        time.sleep(0.005)
    try:
        yield
    finally:
        if ours:
            with suppress(OSError):  # it may have been taken away, and another's be there
                if lock.read_bytes() == token:
                    remove(lock)


def claim(target: Path) -> Path | None:
    """A file beside `target` that tells other processes that this one makes it, for `give_back`; None where another has
    claimed it. It has to be touched now and then: one that has not been for ABANDONED_FILE_SECONDS seconds is taken
    over, as is that of a process that has ended. Raises OSError where the folder cannot be written."""
    path = _claim_of(target)
    for _ in range(2):
        if _take(path, f"{machine_mark()}{os.getpid():08x}{_PROCESS_TOKEN}".encode()):
            return path
        try:
            if not _is_given_up(path):
                return None
            path.unlink()
        except (FileNotFoundError, PermissionError):  # given back, or taken over
            continue
    return None


def _claim_of(target: Path) -> Path:
    return target.with_name(f".{target.name}{CLAIM_SUFFIX}")


def _is_given_up(claimed: Path) -> bool:
    age = time.time() - claimed.stat().st_mtime
    if age > ABANDONED_FILE_SECONDS:
        return True
    token = claimed.read_text(encoding="ascii", errors="replace")
    if not token:  # it is just being written, or its process was killed as it did
        return age > EMPTY_CLAIM_SECONDS
    if (
        token[:12] == f"{machine_mark()}{os.getpid():08x}"
    ):  # a process before this one, of the same number, as in containers
        return token[12:] != _PROCESS_TOKEN
    return is_abandoned(claimed, token)


def give_back(claimed: Path) -> None:
    """Let others make what was claimed."""
    with suppress(FileNotFoundError):
        remove(claimed)


def _take(lock: Path, token: bytes) -> bool:
    try:
        file = lock.open("xb", buffering=0)
    except FileExistsError:
        return False
    except PermissionError:  # Windows says so of a file that is being removed
        if not ON_WINDOWS:
            raise
        return False
    try:
        with file:
            file.write(token)
    except OSError:
        lock.unlink()
        raise
    return True


def abandoned(targets: Iterable[Path]) -> list[Path]:
    """The temporary files and claims that writers of these files have left: their process has ended, or they are of
    another machine and have not been written to for ABANDONED_FILE_SECONDS seconds."""
    names: dict[Path, set[str]] = {}
    for target in targets:
        real = Path(os.path.realpath(target))
        names.setdefault(real.parent, set()).add(real.name)
    result = []
    for folder, wanted in names.items():
        with suppress(OSError):
            for entry in os.scandir(folder):
                match = TEMPORARY_NAME.fullmatch(entry.name)
                if match and match[1] in wanted and is_abandoned(path := Path(entry.path), match[2]):
                    result.append(path)
        for name in wanted:
            path = _claim_of(folder / name)
            with suppress(OSError):
                if _is_given_up(path):
                    result.append(path)
    return sorted(result)
