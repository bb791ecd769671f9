# SPDX-License-Identifier: Apache-2.0
"""Python worker processes of this package, which a driver may abort or hang, and the reasons why they ended."""

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
from clsplat.process import MAX_SIGNAL_WAIT_SECONDS, Interrupted, apart, endings

CHILD_MESSAGE_PREFIX = "clsplat-child "
"""Prefix of a line that is a message to the parent. Lines that drivers print do not have it."""
DRIVER_TIMEOUT_SECONDS = 120.0
"""Seconds without a message after which a driver counts as hung. The slowest working driver takes 60 to build a
kernel."""
DRIVER_TIMEOUT_VARIABLE = "CLSPLAT_DRIVER_TIMEOUT"
TRUST_DRIVER_VARIABLE = "CLSPLAT_TRUST_DRIVER"
SIGKILL_NUMBER = 9
"""SIGKILL, which Windows does not define."""


class TrialInterrupted(Interrupted):
    """This process was asked to end while it waited for a driver's trial."""


def driver_timeout() -> float:
    """Seconds after which a driver counts as hung: CLSPLAT_DRIVER_TIMEOUT, else DRIVER_TIMEOUT_SECONDS. Raises
    InputError."""
    text = os.environ.get(DRIVER_TIMEOUT_VARIABLE, "")
    if not text:
        return DRIVER_TIMEOUT_SECONDS
    try:
        seconds = float(text)
    except ValueError:
        seconds = 0.0
    if not 0 < seconds < 1e6:
        raise InputError(f"{DRIVER_TIMEOUT_VARIABLE}={text}: expected seconds, such as 300")
    return seconds


def regardless() -> bool:
    """True if CLSPLAT_TRUST_DRIVER=1 disables the self-test and all trials of kernels. Raises InputError."""
    return switched_on(TRUST_DRIVER_VARIABLE)


def tell(**values: object) -> None:
    """Send a message from this process to its parent, on a line of its own even if a driver has printed something."""
    print(f"\n{CHILD_MESSAGE_PREFIX}{json.dumps(values)}", flush=True)


def end_with_parent() -> None:
    """End this process when the parent ends, even if a driver hangs. It is for a process that reads no messages."""

    def wait() -> None:
        while os.read(0, 1 << 10):
            pass
        os._exit(1)

    threading.Thread(target=wait, daemon=True).start()


@contextmanager
def ending_at_once() -> Iterator[None]:
    """Raise TrialInterrupted in the block on a signal that asks this process to end.

    The signal's own handler, which may only record the signal, runs first. Outside the main thread the block has no
    effect, as other threads get no signals.
    """
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
            if signal.getsignal(number) is interrupt:  # a handler may have installed another one
                signal.signal(number, handler)


_alive: weakref.WeakSet[WorkerProcess] = weakref.WeakSet()


def abandon() -> None:
    """End all worker processes at once. A thread that waits for one gets TrialInterrupted."""
    for child in list(_alive):
        child.abandon()


class WorkerProcess:
    """A process that answers in lines of JSON. Ctrl-C does not reach it: it ends with its parent, or by `close`.

    Raises DriverError if it cannot be started.
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
                env={**os.environ, "PYTHONIOENCODING": "utf-8", TRUST_DRIVER_VARIABLE: "1"},
                **apart(),
            )
        except OSError as error:
            raise DriverError(f"{command[0]}: {error.strerror}, {_NO_PYTHON_ADVICE}") from None
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
            if line.startswith(CHILD_MESSAGE_PREFIX):
                self._lines.put(line[len(CHILD_MESSAGE_PREFIX) :])
        self._lines.put(None)

    def _read_errors(self, stream: IO[str]) -> None:
        for line in stream:
            self._errors.append(line.strip())

    def send(self, message: object) -> None:
        """Send a line to the process. If it has ended, nothing is sent, and `receive` reports the end."""
        assert self._process.stdin is not None
        with suppress(OSError):
            self._process.stdin.write(json.dumps(message) + "\n")
            self._process.stdin.flush()

    def receive(self, seconds: float) -> dict[str, Any] | None:
        """The next message; None if the process has ended.

        Raises TrialInterrupted. After `seconds` without a message it ends the process and raises TimeoutError.
        """
        until = time.monotonic() + seconds
        while True:
            try:
                line = self._lines.get(timeout=max(min(MAX_SIGNAL_WAIT_SECONDS, until - time.monotonic()), 0.0))
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
        """The end of a sentence about how the process ended: its status, `where` if given, and its last output."""
        status = self._process.wait()
        self._readers[1].join(timeout=5)
        words = [line for line in self._errors if line]
        said = next((line for line in words if "ERROR" in line or "Assertion" in line), words[-1] if words else "")
        how = f"was ended by signal {-status}" if status < 0 else f"ended with status {status}"
        return how + (f" in {where}" if where else "") + (f" ({said[:300]})" if said else "")

    @property
    def crashed(self) -> bool:
        """True if the process crashed, which only a driver can cause.

        False after a Python error, which has status 1 or 2, and if the system killed the process for lack of memory.
        """
        return self._process.wait() not in (0, 1, 2, *(-number for number in (signal.SIGTERM, SIGKILL_NUMBER)))

    @property
    def killed(self) -> bool:
        """True if the system killed the process, as it does when memory runs out."""
        return self._process.wait() == -SIGKILL_NUMBER

    def abandon(self) -> None:
        """End the process without waiting; a thread that waits for an answer gets TrialInterrupted."""
        self._abandoned = True
        self._process.kill()

    def close(self) -> None:
        """End the process."""
        _alive.discard(self)
        self._process.kill()
        with suppress(subprocess.TimeoutExpired):  # a process that hangs in a system call cannot be killed
            self._process.wait(timeout=5)
        for reader in self._readers:
            reader.join(timeout=5)
        assert self._process.stdin is not None
        with suppress(OSError):  # closing writes buffered text that the process never read
            self._process.stdin.close()


_NO_PYTHON_ADVICE = (
    "expected the Python that this process runs in, for a process of its own in which a driver is tried; "
    f"{TRUST_DRIVER_VARIABLE}=1 goes on without"
)


def python_module(module: str, *words: str) -> list[str]:
    """The command that runs a module of this package.

    It imports nothing from the current folder, unlike `python -m`. Raises DriverError if Python does not know its own
    executable.
    """
    if not sys.executable:  # another program may embed Python
        raise DriverError(f"sys.executable is empty, {_NO_PYTHON_ADVICE}")
    root = str(Path(__file__).resolve().parents[3])
    code = (
        f"import sys; sys.path[:] = [part for part in sys.path if part]; root = {root!r}; "
        "sys.path[:0] = [] if root in sys.path else [root]; "
        f"import runpy; runpy.run_module({module!r}, run_name='__main__', alter_sys=True)"
    )
    return [sys.executable, "-c", code, *words]
