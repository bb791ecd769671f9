# SPDX-License-Identifier: Apache-2.0
"""Exclusive write lock of a run folder. The operating system holds it, so a killed process leaves no stale lock.

Locks by marker files are in `clsplat.files.locks`.
"""

from __future__ import annotations

import errno
import json
import os
import socket
import sys
import time
from collections.abc import Iterator
from contextlib import contextmanager, suppress
from pathlib import Path
from typing import IO

from clsplat.errors import InputError, warn
from clsplat.files.documents import parse_json
from clsplat.files.locks import WRITTEN_BY

LOCK_FILE_NAME = ".clsplat-lock"
"""Name of the lock file in a run's folder. Its content names the process that writes there."""
_LOCKED_BYTE_OFFSET = 1 << 30
"""Offset of the locked byte. Windows forbids other processes to read a locked byte, so it lies beyond the file's
content."""
_LOCK_HELD_ERRNOS = (errno.EAGAIN, errno.EACCES, errno.EDEADLK)
"""Error numbers of the system if another process holds the lock."""
_NO_LOCKING_ERRNOS = (errno.ENOLCK, errno.ENOSYS, errno.EOPNOTSUPP, errno.ENOTSUP, errno.EINVAL, errno.EIO)
"""Error numbers of the system if the file system does not support locks."""
_held: dict[str, int] = {}
"""Number of times that this process has taken the lock of each folder and not yet released it."""


@contextmanager
def locked(folder: Path, verb: str) -> Iterator[None]:
    """Hold the exclusive write lock of an existing folder. A process that holds the lock may take it again.

    verb: verb of clsplat, such as "train", to name this process in the error of others.

    Raises InputError, which names the process that holds the lock, and OSError if no file can be created there.
    On a file system without locks, it warns and holds no lock.
    """
    key = os.path.realpath(folder)
    if key in _held:
        _held[key] += 1
        try:
            yield
        finally:
            _held[key] -= 1
        return
    path = Path(key) / LOCK_FILE_NAME
    file = _take(path, folder)
    _held[key] = 1
    try:
        _sign(file, verb)
        yield
    finally:
        del _held[key]
        _give_back(file, path)


def _take(path: Path, folder: Path) -> IO[bytes]:
    """Open the lock file `path` of `folder`, and lock it. Raises InputError if another process holds the lock."""
    while True:
        file = open(os.open(path, os.O_RDWR | os.O_CREAT, 0o666), "r+b", buffering=0)  # noqa: SIM115  # `_give_back` closes the file
        try:
            try_lock(file)
        except OSError as error:
            if error.errno in _LOCK_HELD_ERRNOS:
                who = _who(file)
                file.close()
                raise InputError(
                    f"{folder}{WRITTEN_BY}{who}; wait until that process has ended, or choose another folder"
                ) from None
            if error.errno not in _NO_LOCKING_ERRNOS:
                file.close()
                raise
            why = error.strerror or str(error)
            warn(f"{folder}: is on a file system without locks ({why}), so other processes may write there too")
            return file
        with suppress(OSError):
            if os.path.samestat(os.fstat(file.fileno()), path.stat()):
                return file
        file.close()  # the previous holder has just removed this file, so open a new one


def try_lock(file: IO[bytes]) -> None:
    """Lock the file without waiting. Raises OSError if another process holds the lock, or locks are not supported."""
    file.seek(_LOCKED_BYTE_OFFSET)
    if sys.platform == "win32":
        import msvcrt

        msvcrt.locking(file.fileno(), msvcrt.LK_NBLCK, 1)
    else:
        os.lockf(file.fileno(), os.F_TLOCK, 1)


def _sign(file: IO[bytes], verb: str) -> None:
    """Write the identity of this process into the locked file. A failure, such as a full disk, is ignored."""
    text = json.dumps({"pid": os.getpid(), "host": socket.gethostname(), "verb": verb, "since": time.time()})
    with suppress(OSError):
        file.seek(0)
        file.truncate()
        file.write(text.encode())


def _who(file: IO[bytes]) -> str:
    try:
        file.seek(0)
        record = parse_json(file.read(1 << 12))
        here = "" if record["host"] == socket.gethostname() else f" on {record['host']}"
        return f"clsplat {record['verb']} (process {record['pid']}{here})"
    except (OSError, ValueError, KeyError, TypeError):  # the holder has not written its identity yet
        return "another process"


def _give_back(file: IO[bytes], path: Path) -> None:
    with suppress(OSError):
        if sys.platform == "win32":  # Windows cannot remove an open file
            import msvcrt

            file.seek(_LOCKED_BYTE_OFFSET)
            msvcrt.locking(file.fileno(), msvcrt.LK_UNLCK, 1)
            file.close()
        path.unlink()
    file.close()
