# SPDX-License-Identifier: Apache-2.0
"""Worker processes, in which a driver may crash or hang without harm to this process; their messages and timeouts."""

from __future__ import annotations

import atexit
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
from types import FrameType
from typing import Any

from clsplat.errors import DriverError, InputError, switched_on
from clsplat.process import MAX_SIGNAL_WAIT_SECONDS, Interrupted, apart, endings, module_command

CHILD_MESSAGE_PREFIX = "clsplat-child "
"""Prefix of the lines in which a worker process sends messages, to distinguish them from lines that a driver prints."""
DRIVER_TIMEOUT_SECONDS = 120.0
"""Seconds without a message after which a driver counts as hung. The slowest known driver takes 60 seconds to build a
kernel."""
DRIVER_TIMEOUT_VARIABLE = "CLSPLAT_DRIVER_TIMEOUT"
TRUST_DRIVER_VARIABLE = "CLSPLAT_TRUST_DRIVER"
_SIGKILL, _SIGTERM = -9, -15
"""Exit statuses of processes that SIGKILL and SIGTERM ended, as numbers: Windows' Python has no `signal.SIGKILL`."""


class TrialInterrupted(Interrupted):
    """Error in a thread that waits for a worker process, because Ctrl-C or a signal asks this program to end."""


class WorkerEndedError(Exception):
    """Raised if a worker process ends before it answers.

    text: the end of a sentence whose subject is the process, such as "was ended by signal 6".
    hung: True if the process was ended because it did not answer in time.
    status: exit status of the process; negative for a signal.
    crashed: True if a driver has ended or blocked the process.
    killed: True if SIGKILL has ended the process, as happens if memory runs out.
    """

    def __init__(self, text: str, status: int = 0, *, hung: bool = False) -> None:
        super().__init__(text)
        self.hung = hung
        # after an exception in Python the status is 1 or 2; SIGTERM and SIGKILL come from outside
        self.crashed = hung or status not in (0, 1, 2, _SIGTERM, _SIGKILL)
        self.killed = status == _SIGKILL


def driver_timeout() -> float:
    """Return the seconds after which a driver counts as hung: CLSPLAT_DRIVER_TIMEOUT, or else DRIVER_TIMEOUT_SECONDS.
    Raises InputError if the variable is invalid."""
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
    """Send `values` to the parent process, as a line of JSON after a line break, as a driver may have printed text."""
    print(f"\n{CHILD_MESSAGE_PREFIX}{json.dumps(values)}", flush=True)


def end_with_parent() -> None:
    """End this process when its parent ends, even if a driver hangs. The process must not read its standard input."""

    def wait() -> None:
        while os.read(0, 1 << 10):
            pass
        os._exit(1)

    threading.Thread(target=wait, daemon=True).start()


@contextmanager
def ending_at_once() -> Iterator[None]:
    """Inside the block, signals that ask this process to end raise TrialInterrupted.

    The previous handler of the signal runs first; it may just record the signal. Outside the main thread the block has
    no effect, as other threads get no signals.
    """
    if threading.current_thread() is not threading.main_thread():
        yield
        return

    def interrupt(number: int, frame: FrameType | None) -> None:
        with suppress(KeyboardInterrupt):
            before[number](number, frame)
        raise TrialInterrupted(number)

    numbers = (signal.SIGINT, *endings())
    before = {int(number): handler for number in numbers if callable(handler := signal.getsignal(number))}
    for number in before:
        signal.signal(number, interrupt)
    try:
        yield
    finally:
        for number, handler in before.items():
            if signal.getsignal(number) is interrupt:  # the previous handler may have installed another handler
                signal.signal(number, handler)


_alive: weakref.WeakSet[WorkerProcess] = weakref.WeakSet()


@atexit.register
def abandon() -> None:
    """End all worker processes at once. A thread that waits for an answer of a worker gets TrialInterrupted."""
    for child in list(_alive):
        child.close()


class WorkerProcess:
    """A child process that answers in lines of JSON. Ctrl-C does not reach it. It ends with its parent or by `close`.

    Raises DriverError if the process cannot be started.
    """

    def __init__(self, command: Sequence[str]) -> None:
        self._closed = False
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
        self._lines: queue.Queue[str | None] = queue.Queue()
        self._errors: list[str] = []
        self._readers = [threading.Thread(target=read, daemon=True) for read in (self._read, self._read_errors)]
        for reader in self._readers:
            reader.start()
        _alive.add(self)

    def _read(self) -> None:
        assert self._process.stdout is not None
        for line in self._process.stdout:
            if line.startswith(CHILD_MESSAGE_PREFIX):
                self._lines.put(line[len(CHILD_MESSAGE_PREFIX) :])
        self._lines.put(None)

    def _read_errors(self) -> None:
        assert self._process.stderr is not None
        self._errors.extend(line.strip() for line in self._process.stderr)

    def send(self, message: object) -> None:
        """Send a message as a line of JSON. If the process has ended, the next `receive` raises the error."""
        assert self._process.stdin is not None
        with suppress(OSError):
            self._process.stdin.write(json.dumps(message) + "\n")
            self._process.stdin.flush()

    def receive(self, seconds: float, doing: str = "") -> dict[str, Any]:
        """Wait for the next message of the process and return it. After `seconds` without a message, kill the process.

        doing: the current work of the process, for the text of an error.
        Raises TrialInterrupted or WorkerEndedError.
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
                text = f"did not answer within {seconds:g} s" + (f" in {doing}" if doing else "")
                raise WorkerEndedError(text, hung=True) from None
        if self._closed:
            raise TrialInterrupted(signal.SIGINT)
        if line is None:
            status = self._process.wait()
            how = f"was ended by signal {-status}" if status < 0 else f"ended with status {status}"
            raise WorkerEndedError(how + (f" in {doing}" if doing else "") + self._last_words(), status)
        message: dict[str, Any] = json.loads(line)
        return message

    def _last_words(self) -> str:
        """Return the most informative line of the process's standard error, in brackets; "" if there is no line."""
        self._readers[1].join(timeout=5)
        words = [line for line in self._errors if line]
        said = next((line for line in words if "ERROR" in line or "Assertion" in line), words[-1] if words else "")
        return f" ({said[:300]})" if said else ""

    def close(self) -> None:
        """End the process. A thread that waits for an answer gets TrialInterrupted."""
        self._closed = True
        _alive.discard(self)
        self._process.kill()
        with suppress(subprocess.TimeoutExpired):  # a process that hangs in a system call cannot be killed
            self._process.wait(timeout=5)
        for reader in self._readers:
            reader.join(timeout=5)
        assert self._process.stdin is not None
        with suppress(OSError, ValueError):  # the process may have ended, or another thread closed the pipe
            self._process.stdin.close()


_NO_PYTHON_ADVICE = (
    "expected the path of a Python that can try the driver in a separate process; "
    f"{TRUST_DRIVER_VARIABLE}=1 skips the trial"
)


def python_module(module: str, *words: str) -> list[str]:
    """Return the result of `clsplat.process.module_command`.

    Raises DriverError if Python does not know the path of its executable.
    """
    if not sys.executable:  # it is empty in a program that embeds Python
        raise DriverError(f"sys.executable is empty, {_NO_PYTHON_ADVICE}")
    return module_command(module, *words)
