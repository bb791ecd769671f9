# SPDX-License-Identifier: Apache-2.0
"""The engine that runs attempts in processes of this machine."""

from __future__ import annotations

import queue
import threading
import time
from contextlib import suppress

from clsplat.jobs.attempt_process import AttemptProcess
from clsplat.jobs.task import Attempt, Outcome
from clsplat.process import MAX_SIGNAL_WAIT_SECONDS


class LocalEngine:
    """Runs up to `workers` attempts at once, each in a process of this machine. Has the methods of `Engine`."""

    def __init__(self, workers: int = 1) -> None:
        if workers < 1:
            raise ValueError(f"workers {workers}: expected at least 1")
        self.workers = workers
        self._running: dict[str, AttemptProcess] = {}
        self._outcomes: queue.SimpleQueue[Outcome] = queue.SimpleQueue()

    def free(self) -> int:
        """Number of attempts that can be started now."""
        return self.workers - len(self._running)

    def start(self, attempt: Attempt) -> None:
        """Start an attempt."""
        process = self._running[attempt.name] = AttemptProcess(attempt)
        threading.Thread(target=lambda: self._outcomes.put(process.wait()), name="clsplat-attempt", daemon=True).start()

    def wait(self, seconds: float) -> list[Outcome]:
        """Wait at most `seconds` for outcomes, and return them."""
        outcomes: list[Outcome] = []
        with suppress(queue.Empty):
            outcomes.append(self._outcomes.get(timeout=max(min(seconds, MAX_SIGNAL_WAIT_SECONDS), 0.001)))
            while True:
                outcomes.append(self._outcomes.get_nowait())
        for outcome in outcomes:
            del self._running[outcome.name]
        return outcomes

    def leave_out(self, worker: str) -> bool:  # noqa: ARG002  # an argument of every engine
        """Return False: this machine is the only worker."""
        return False

    def stop(self) -> None:
        """End all attempts, and return when their processes have ended. A second Ctrl-C kills them."""
        for process in self._running.values():
            process.ask_to_end()
        try:
            while self._running:
                self.wait(MAX_SIGNAL_WAIT_SECONDS)
        except KeyboardInterrupt:
            for process in self._running.values():
                process.kill()
            until = time.monotonic() + 10
            while self._running and time.monotonic() < until:
                self.wait(MAX_SIGNAL_WAIT_SECONDS)
            raise
