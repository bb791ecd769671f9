# SPDX-License-Identifier: Apache-2.0
"""Python processes of this package that a driver may abort or hang, and what their end was."""

from __future__ import annotations

import json
import os
import queue
import signal
import subprocess
import sys
import threading
import time
import weakref
from collections.abc import Iterator, Sequence
from contextlib import contextmanager, suppress
from pathlib import Path
from types import FrameType
from typing import IO, Any

from clsplat.errors import DriverError, InputError, switched_on
from clsplat.process import Interrupted, apart, endings

MARK = "clsplat-child "
"""Beginning of a line that is meant for the parent; drivers print lines of their own."""
PATIENCE = 120.0
"""Seconds without a word after which a driver counts as hung: the slowest that works builds a kernel in 60."""
TIMEOUT = "CLSPLAT_DRIVER_TIMEOUT"
REGARDLESS = "CLSPLAT_TRUST_DRIVER"
KILL = 9
"""SIGKILL, which Windows has no name for."""
LONGEST_WAIT = 0.5
"""Seconds, so that a signal is seen to on systems where it does not end a wait."""


class TrialInterrupted(Interrupted):
    """This process was asked to end while it waited for a driver's trial."""


def patience() -> float:
    """Seconds after which a driver counts as hung: CLSPLAT_DRIVER_TIMEOUT, else PATIENCE. Raises InputError."""
    text = os.environ.get(TIMEOUT, "")
    if not text:
        return PATIENCE
    try:
        seconds = float(text)
    except ValueError:
        seconds = 0.0
    if not 0 < seconds < 1e6:
        raise InputError(f"{TIMEOUT}={text}: expected seconds, such as 300")
    return seconds


def regardless() -> bool:
    """True if CLSPLAT_TRUST_DRIVER=1 leaves out every test and trial of a driver. Raises InputError."""
    return switched_on(REGARDLESS)


def tell(**values: object) -> None:
    """Send a message from the child to its parent, on a line of its own whatever a driver has printed."""
    print(f"\n{MARK}{json.dumps(values)}", flush=True)


def end_with_parent() -> None:
    """End when the parent has gone, even where a driver hangs: for a child that is told nothing."""

    def wait() -> None:
        while os.read(0, 1 << 10):
            pass
        os._exit(1)

    threading.Thread(target=wait, daemon=True).start()


@contextmanager
def ending_at_once() -> Iterator[None]:
    """Inside, a signal that asks this process to end raises TrialInterrupted, after its own handler, which may only
    take note of it. No effect in other threads than the main one: they get no signals."""
    if threading.current_thread() is not threading.main_thread():
        yield
        return

    def interrupt(number: int, frame: FrameType | None) -> None:
        with suppress(KeyboardInterrupt):
            before[number](number, frame)
        raise TrialInterrupted(number)

    handlers = {number: signal.getsignal(number) for number in (signal.SIGINT, *endings())}
    before = {int(number): handler for number, handler in handlers.items() if callable(handler)}
    for number in before:
        signal.signal(number, interrupt)
    try:
        yield
    finally:
        for number, handler in before.items():
            if signal.getsignal(number) is interrupt:  # a handler may have put another one in its own place
                signal.signal(number, handler)


_alive: weakref.WeakSet[Child] = weakref.WeakSet()


def abandon() -> None:
    """End all of them at once. A thread that waits for one gets TrialInterrupted."""
    for child in list(_alive):
        child.abandon()


class Child:
    """A process that answers in lines of JSON. Ctrl-C does not reach it: it ends with its parent, or by `close`.

    Raises DriverError where it cannot be started.
    """

    def __init__(self, command: Sequence[str]) -> None:
        self._abandoned = False
        try:
            self._process = subprocess.Popen(
                list(command),
                stdin=subprocess.PIPE,
                stdout=subprocess.PIPE,
                stderr=subprocess.PIPE,
                text=True,
                encoding="utf-8",
                errors="replace",
                env={**os.environ, "PYTHONIOENCODING": "utf-8", REGARDLESS: "1"},
                **apart(),
            )
        except OSError as error:
            raise DriverError(f"{command[0]}: {error.strerror}, {_NO_PYTHON}") from None
        _alive.add(self)
        self._lines: queue.Queue[str | None] = queue.Queue()
        self._errors: list[str] = []
        assert self._process.stdout is not None
        assert self._process.stderr is not None
        self._readers = [
            threading.Thread(target=self._read, args=(self._process.stdout,), daemon=True),
            threading.Thread(target=self._read_errors, args=(self._process.stderr,), daemon=True),
        ]
        for reader in self._readers:
            reader.start()

    def _read(self, stream: IO[str]) -> None:
        for line in stream:
            if line.startswith(MARK):
                self._lines.put(line[len(MARK) :])
        self._lines.put(None)

    def _read_errors(self, stream: IO[str]) -> None:
        for line in stream:
            self._errors.append(line.strip())

    def send(self, message: object) -> None:
        """A line for the child; nothing where it has ended, which `receive` finds."""
        assert self._process.stdin is not None
        with suppress(OSError):
            self._process.stdin.write(json.dumps(message) + "\n")
            self._process.stdin.flush()

    def receive(self, seconds: float) -> dict[str, Any] | None:
        """The next message; None where the process has ended. Raises TrialInterrupted; and after `seconds` without a
        message ends the process and raises TimeoutError."""
        until = time.monotonic() + seconds
        while True:
            try:
                line = self._lines.get(timeout=max(min(LONGEST_WAIT, until - time.monotonic()), 0.0))
                break
            except queue.Empty:
                if time.monotonic() < until:
                    continue
                self._process.kill()
                raise TimeoutError(f"did not come back within {seconds:g} s") from None
        if self._abandoned:
            raise TrialInterrupted(signal.SIGINT)
        if line is None:
            return None
        message: dict[str, Any] = json.loads(line)
        return message

    def ending(self, where: str = "") -> str:
        """The end of the process in words, for a sentence that begins with it: its status, where it was, if that is
        known, and its last words."""
        status = self._process.wait()
        self._readers[1].join(timeout=5)
        words = [line for line in self._errors if line]
        said = next((line for line in words if "ERROR" in line or "Assertion" in line), words[-1] if words else "")
        how = f"was ended by signal {-status}" if status < 0 else f"ended with status {status}"
        return how + (f" in {where}" if where else "") + (f" ({said[:300]})" if said else "")

    @property
    def crashed(self) -> bool:
        """True if the process that has ended was taken down, as drivers do: not by an error of Python's, which has
        status 1 or 2, and not by the system, which kills what takes too much memory."""
        return self._process.wait() not in (0, 1, 2, *(-number for number in (signal.SIGTERM, KILL)))

    @property
    def killed(self) -> bool:
        """True if the system has ended it, as it does where memory is short."""
        return self._process.wait() == -KILL

    def abandon(self) -> None:
        """End the process without waiting for that; a thread that waits for an answer gets TrialInterrupted."""
        self._abandoned = True
        self._process.kill()

    def close(self) -> None:
        """End the process."""
        _alive.discard(self)
        self._process.kill()
        with suppress(subprocess.TimeoutExpired):  # one that hangs in the system cannot even be killed
            self._process.wait(timeout=5)
        for reader in self._readers:
            reader.join(timeout=5)
        assert self._process.stdin is not None
        with suppress(OSError):  # closing writes what the process never read
            self._process.stdin.close()


_NO_PYTHON = (
    "expected the Python that this process runs in, for a process of its own in which a driver is tried; "
    f"{REGARDLESS}=1 goes on without"
)


def python_module(module: str, *words: str) -> list[str]:
    """The command that runs a module of this package: this package, and nothing of the folder that we are in, as
    `python -m` would take modules from there. Raises DriverError where Python does not know its own file."""
    if not sys.executable:  # another program may have Python built in
        raise DriverError(f"sys.executable is empty, {_NO_PYTHON}")
    root = str(Path(__file__).resolve().parents[2])
    code = (
        f"import sys; sys.path[:] = [part for part in sys.path if part]; root = {root!r}; "
        "sys.path[:0] = [] if root in sys.path else [root]; "
        f"import runpy; runpy.run_module({module!r}, run_name='__main__', alter_sys=True)"
    )
    return [sys.executable, "-c", code, *words]
