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


def fill_closed_streams() -> None:
    """Give a process that was started without standard input, output or error (`>&-`) a null device in its place: else
    the next file that is opened takes the number, and what any library prints goes into it."""
    for number, name in enumerate(("stdin", "stdout", "stderr")):
        try:
            os.fstat(number)
        except OSError:
            opened = os.open(os.devnull, os.O_RDONLY if number == 0 else os.O_WRONLY)
            if opened != number:
                os.dup2(opened, number)
                os.close(opened)
            os.set_inheritable(number, True)
        if getattr(sys, name) is None:
            stream = open(os.devnull, "r" if number == 0 else "w", encoding="utf-8")  # noqa: SIM115  # for good
            setattr(sys, name, stream)


def reader_has_gone(error: OSError, *, windows: bool = sys.platform == "win32") -> bool:
    """True if a write failed as what reads our output has ended, as `| head` does. Windows says "invalid argument", and
    as of any stream names no file."""
    return isinstance(error, BrokenPipeError) or (windows and error.errno == errno.EINVAL and error.filename is None)
