# SPDX-License-Identifier: Apache-2.0
"""One writer for a folder: a lock that the system holds, so that a process that is killed does not leave it behind."""

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
from clsplat.files import parse_json

NAME = ".clsplat-lock"
"""The file in the folder that is locked, as long as a process writes there. It names the process."""
_FAR = 1 << 30
"""Place of the byte that is locked. On Windows no other process may read a locked byte: this one is behind all that the
file holds."""
_TAKEN = (errno.EAGAIN, errno.EACCES, errno.EDEADLK)
_NO_LOCKS = (errno.ENOLCK, errno.ENOSYS, errno.EOPNOTSUPP, errno.ENOTSUP, errno.EINVAL, errno.EIO)
_held: dict[str, int] = {}
"""Folders that this process has locked, and how often."""


@contextmanager
def locked(folder: Path, verb: str) -> Iterator[None]:
    """Be the only process that writes to a folder, which has to exist; inside, the same process may do so again.

    Raises InputError that names the process that has it, OSError where no file can be made there. On a file system
    without locks there is a warning, and no other process is kept out.
    """
    key = os.path.realpath(folder)
    if key in _held:
        _held[key] += 1
        try:
            yield
        finally:
            _held[key] -= 1
        return
    path = Path(key) / NAME
    file = _take(path, folder)
    _held[key] = 1
    try:
        _sign(file, verb)
        yield
    finally:
        del _held[key]
        _give_back(file, path)


def _take(path: Path, folder: Path) -> IO[bytes]:
    """The file, open and locked."""
    while True:
        file = open(os.open(path, os.O_RDWR | os.O_CREAT, 0o666), "r+b", buffering=0)  # noqa: SIM115  # given back
        try:
            try_lock(file)
        except OSError as error:
            if error.errno in _TAKEN:
                who = _who(file)
                file.close()
                raise InputError(
                    f"{folder}: is being written by {who}; wait until that has ended, or choose another folder"
                ) from None
            if error.errno not in _NO_LOCKS:
                file.close()
                raise
            why = error.strerror or str(error)
            warn(f"{folder}: is on a file system without locks ({why}), others may write there too")
            return file
        with suppress(OSError):
            if os.path.samestat(os.fstat(file.fileno()), path.stat()):
                return file
        file.close()  # the one before has just removed it: once more


def try_lock(file: IO[bytes]) -> None:
    """Lock the file, or raise OSError."""
    file.seek(_FAR)
    if sys.platform == "win32":
        import msvcrt

        msvcrt.locking(file.fileno(), msvcrt.LK_NBLCK, 1)
    else:
        os.lockf(file.fileno(), os.F_TLOCK, 1)


def _sign(file: IO[bytes], verb: str) -> None:
    """Write which process this is; failing to, as on a full disk, is no reason to stop."""
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
    except (OSError, ValueError, KeyError, TypeError):  # it has not signed yet
        return "another process"


def _give_back(file: IO[bytes], path: Path) -> None:
    with suppress(OSError):
        if sys.platform == "win32":  # there an open file cannot be removed
            import msvcrt

            file.seek(_FAR)
            msvcrt.locking(file.fileno(), msvcrt.LK_UNLCK, 1)
            file.close()
        path.unlink()
    file.close()
