# SPDX-License-Identifier: Apache-2.0
"""Signals that end a process (Ctrl-C, SIGTERM, SIGHUP), child processes, and standard streams that are closed.

Worker processes of drivers, and their time limits: `device/drivers/worker_process.py`.
"""

from __future__ import annotations

import errno
import os
import signal
import subprocess
import sys
import threading
from collections.abc import Callable, Iterable, Iterator
from contextlib import AbstractContextManager, contextmanager
from pathlib import Path
from types import FrameType
from typing import Any

MAX_SIGNAL_WAIT_SECONDS = 0.5
"""Longest wait of the main thread in seconds. On some systems a signal does not end a wait, so its handler runs only
after the wait."""


def apart() -> dict[str, Any]:
    """Arguments of `subprocess.Popen` for a process that a Ctrl-C on this terminal does not reach."""
    if sys.platform == "win32":
        return {"creationflags": subprocess.CREATE_NEW_PROCESS_GROUP}
    return {"start_new_session": True}


def module_command(module: str, *words: str) -> list[str]:
    """The command that runs a module of this package with the arguments `words`.

    Unlike `python -m`, the command imports nothing from the current folder.
    """
    root = str(Path(__file__).resolve().parents[1])
    code = (
        f"import sys; sys.path[:] = [part for part in sys.path if part]; root = {root!r}; "
        "sys.path[:0] = [] if root in sys.path else [root]; "
        f"import runpy; runpy.run_module({module!r}, run_name='__main__', alter_sys=True)"
    )
    return [sys.executable, "-c", code, *words]


def endings() -> tuple[signal.Signals, ...]:
    """Signals other than Ctrl-C that ask a process to end: from job managers, and from a terminal that closes.

    On Windows, processes are ended by Ctrl-Break instead of SIGTERM. Ignored signals, as under nohup, are left out.
    """
    names = ("SIGTERM", "SIGHUP", "SIGBREAK")
    numbers = [getattr(signal, name) for name in names if hasattr(signal, name)]
    return tuple(number for number in numbers if signal.getsignal(number) != signal.SIG_IGN)


class Interrupted(KeyboardInterrupt):
    """Exception on Ctrl-C, or on another signal that asks the process to end. number: the signal's number."""

    def __init__(self, number: int = signal.SIGINT) -> None:
        super().__init__()
        self.number = number


def status_of(error: KeyboardInterrupt) -> int:
    """The exit status that shells report for an interrupted process: 130 for Ctrl-C."""
    return 128 + (error.number if isinstance(error, Interrupted) else signal.SIGINT)


def interrupt(number: int, _frame: FrameType | None) -> None:
    """A signal handler that raises Interrupted."""
    raise Interrupted(number)


@contextmanager
def handled(numbers: Iterable[int], handler: Callable[[int, FrameType | None], object]) -> Iterator[dict[int, Any]]:
    """Context in which `handler` handles the signals `numbers`. Yields the previous handlers.

    Outside the main thread it does nothing, since Python handles signals only there.
    """
    if threading.current_thread() is not threading.main_thread():
        numbers = ()
    before = {number: signal.signal(number, handler) or signal.SIG_DFL for number in numbers}
    try:
        yield before
    finally:
        for number, previous in before.items():
            signal.signal(number, previous)


def terminable() -> AbstractContextManager[object]:
    """Context in which a signal that asks the process to end acts like Ctrl-C: temporary files are removed, and child
    processes end."""
    return handled(endings(), interrupt)


@contextmanager
def undisturbed() -> Iterator[None]:
    """Context in which signals that ask the process to end are delayed. At its end, the first of them is raised.

    In the main thread, handlers that a library installs meanwhile are removed at the end. In threads that a library
    starts meanwhile, and in the programs that these threads run, the signals stay blocked.
    """
    came: list[int] = []

    def note(number: int, _frame: FrameType | None) -> None:
        came.append(number)

    try:
        with handled((signal.SIGINT, *endings()), note) as before:
            numbers = before or (signal.SIGINT, *endings())
            mask = signal.pthread_sigmask(signal.SIG_BLOCK, numbers) if sys.platform != "win32" else None
            try:
                yield
            finally:
                for number in before:
                    signal.signal(number, note)
                if sys.platform != "win32" and mask is not None:
                    signal.pthread_sigmask(signal.SIG_SETMASK, mask)  # pending signals arrive now
    finally:
        if came:
            signal.raise_signal(came[0])


def fill_closed_streams() -> None:
    """Open a null device for standard input, output or error if the process was started without it (`>&-`).

    Otherwise the next opened file gets the number of the closed stream, and a library's prints go into that file.
    """
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
            stream = open(os.devnull, "r" if number == 0 else "w", encoding="utf-8")  # noqa: SIM115  # stays open
            setattr(sys, name, stream)


def reader_has_gone(error: OSError, *, windows: bool = sys.platform == "win32") -> bool:
    """True if a write to standard output failed because the program that reads it has ended, as with `| head`.

    In this case Windows reports an invalid argument, without a file name.
    """
    return isinstance(error, BrokenPipeError) or (windows and error.errno == errno.EINVAL and error.filename is None)
