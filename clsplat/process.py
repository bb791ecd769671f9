# SPDX-License-Identifier: Apache-2.0
"""Differences between systems in how processes are started and asked to end."""

from __future__ import annotations

import errno
import os
import signal
import subprocess
import sys
from typing import Any


def apart() -> dict[str, Any]:
    """Arguments of `subprocess.Popen` for a process that a Ctrl-C on this terminal does not reach."""
    if sys.platform == "win32":
        return {"creationflags": subprocess.CREATE_NEW_PROCESS_GROUP}
    return {"start_new_session": True}


def endings() -> tuple[signal.Signals, ...]:
    """The signals beside Ctrl-C by which managers of jobs ask a process to end. On Windows nobody sends SIGTERM: there
    it is Ctrl-Break."""
    return tuple(getattr(signal, name) for name in ("SIGTERM", "SIGBREAK") if hasattr(signal, name))


def reader_has_gone(error: OSError, *, windows: bool = sys.platform == "win32") -> bool:
    """True if a write failed as what reads our output has ended, as `| head` does. Windows says "invalid argument", and
    as of any stream names no file."""
    return isinstance(error, BrokenPipeError) or (windows and error.errno == errno.EINVAL and error.filename is None)


def try_lock(file: int) -> bool:
    """Lock an open file until it is closed; False where another process has it locked. Does nothing where the file
    system knows no locks."""
    try:
        if sys.platform == "win32":
            import msvcrt

            os.lseek(file, 0, os.SEEK_SET)
            msvcrt.locking(file, msvcrt.LK_NBLCK, 1)
        else:
            import fcntl

            fcntl.flock(file, fcntl.LOCK_EX | fcntl.LOCK_NB)
    except OSError as error:
        return error.errno not in (errno.EAGAIN, errno.EACCES)
    return True
