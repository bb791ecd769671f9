# SPDX-License-Identifier: Apache-2.0
"""Locks and claims of files by marker files: the process that creates the marker owns the file beside it.

For run folders, `clsplat.runs.locks` uses locks of the operating system.
docs/decisions/0040-three-libraries-not-taken.md compares the two.
"""

from __future__ import annotations

import os
import secrets
import time
from collections.abc import Iterable, Iterator
from contextlib import contextmanager, suppress
from pathlib import Path

from clsplat.files.atomic import (
    ABANDONED_FILE_SECONDS,
    TEMPORARY_NAME,
    is_abandoned,
    is_older,
    machine_mark,
    remove,
    temporary_name,
)
from clsplat.files.names import ON_WINDOWS

EMPTY_CLAIM_SECONDS = 20
"""Age in seconds at which a claim with an empty marker file counts as abandoned."""
CLAIM_SUFFIX = ".clsplat-claim"
"""End of the name of a claim's marker file, which is .NAME.clsplat-claim beside the file NAME."""
WRITTEN_BY = ": is being written by "
"""Part of the error message of a command whose folder another process writes, between the folder and the process."""
_PROCESS_TOKEN = secrets.token_hex(4)
"""Random digits that distinguish this process from others with the same process id, earlier or on another machine."""


@contextmanager
def briefly_locked(path: Path, seconds: float = 5.0) -> Iterator[None]:
    """Context manager that locks a file against other threads and processes. The file need not exist.

    The marker is FILE.lock beside the file. A lock of the operating system, as in `clsplat.runs.locks`, would not keep
    the threads of one process apart, and network file systems may not support it. A marker older than `seconds` counts
    as left by a killed process, and is removed. After twice `seconds` the caller goes on without the lock. Raises
    OSError if the folder cannot be written.
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
            with suppress(OSError):  # another process may have removed the marker, and made its own
                if lock.read_bytes() == token:
                    remove(lock)


def claim(target: Path) -> Path | None:
    """Claim the file `target`, which this process is going to write.

    Returns the marker file, which `give_back` removes; None if another process has the claim. The caller has to update
    the marker's modification time regularly. Other processes take over a claim whose marker is ABANDONED_FILE_SECONDS
    old, or whose process has ended. Raises OSError if the folder cannot be written.
    """
    path = _claim_of(target)
    for _ in range(2):
        if _take(path, _own_token()):
            return path
        try:
            judged = _read(path)
            if not _is_given_up(path, judged[0]) or not _remove_judged(path, judged, temporary_name(target)):
                return None
        except (FileNotFoundError, PermissionError):  # another process has just removed or taken over the claim
            continue
    return None


def is_claimed(target: Path) -> bool:
    """True if a process holds a claim of `target` that is not abandoned. A missing marker is no claim.

    Raises OSError if the marker cannot be read.
    """
    with suppress(FileNotFoundError):
        path = _claim_of(target)
        return not _is_given_up(path, _read(path)[0])
    return False


def is_own_marker(marker: Path) -> bool:
    """True if this process made the marker of a claim. False if another has taken the claim over. Raises OSError."""
    return marker.read_bytes() == _own_token()


def _claim_of(target: Path) -> Path:
    return target.with_name(f".{target.name}{CLAIM_SUFFIX}")


def _own_token() -> bytes:
    return f"{machine_mark()}{os.getpid():08x}{_PROCESS_TOKEN}".encode()


def _read(marker: Path) -> tuple[bytes, int]:
    """The content of a marker, and its modification time in nanoseconds."""
    with marker.open("rb") as file:
        return file.read(), os.fstat(file.fileno()).st_mtime_ns


def _remove_judged(marker: Path, judged: tuple[bytes, int], unique: Path) -> bool:
    """Remove an abandoned marker. Returns False if it has changed since, because another process holds the claim.

    The marker is first renamed: of two processes only one renames it, and what it holds then is what it removes.

    judged: the result of `_read` by which the marker was found abandoned. unique: new name in the same folder.
    """
    marker.rename(unique)
    try:
        if _read(unique) == judged:
            return True
        try:
            os.link(unique, marker)
        except FileExistsError:
            pass
        except OSError:  # a file system without hard links
            _take(marker, unique.read_bytes())
        return False
    finally:
        remove(unique)


def _is_given_up(claimed: Path, content: bytes) -> bool:
    """True if a claim is abandoned. content: the marker's content, read before its age is looked at."""
    if is_older(claimed, ABANDONED_FILE_SECONDS):
        return True
    token = content.decode("ascii", errors="replace")
    if not token:  # the marker is being written now, or its process was killed while it wrote
        return is_older(claimed, EMPTY_CLAIM_SECONDS)
    # the marker is from this process, or (in a container) from an earlier process with the same id
    if token[:12] == f"{machine_mark()}{os.getpid():08x}":
        return token[12:] != _PROCESS_TOKEN
    return is_abandoned(claimed, token)


def give_back(claimed: Path) -> None:
    """Remove the marker of a claim, so that others may claim the target. Another process's marker stays."""
    with suppress(FileNotFoundError):
        if is_own_marker(claimed):
            remove(claimed)


def _take(lock: Path, token: bytes) -> bool:
    try:
        file = lock.open("xb", buffering=0)
    except FileExistsError:
        return False
    except PermissionError:  # Windows reports this for a file that is being removed
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
    """Temporary files and claims beside the files `targets`, left by processes that have ended.

    A process on another machine counts as ended if its file has not changed for ABANDONED_FILE_SECONDS.
    """
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
                if _is_given_up(path, _read(path)[0]):
                    result.append(path)
    return sorted(result)


def remove_abandoned(targets: Iterable[Path]) -> None:
    """Remove the files that `abandoned` finds, but no claim that another process takes over at the same time."""
    for path in abandoned(targets):
        with suppress(OSError):
            if not path.name.endswith(CLAIM_SUFFIX):
                path.unlink()
                continue
            judged = _read(path)
            if _is_given_up(path, judged[0]):
                target = path.with_name(path.name.removeprefix(".").removesuffix(CLAIM_SUFFIX))
                _remove_judged(path, judged, temporary_name(target))
