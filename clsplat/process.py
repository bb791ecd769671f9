# SPDX-License-Identifier: Apache-2.0
"""Differences between systems in how processes are started and asked to end."""

from __future__ import annotations

import errno
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
