# SPDX-License-Identifier: Apache-2.0
"""Start, wait for and end the process of an attempt (`clsplat.jobs.attempt`)."""

from __future__ import annotations

import json
import os
import signal
import socket
import subprocess
import sys
from contextlib import suppress

from clsplat.jobs.task import Attempt, Outcome
from clsplat.process import apart, module_command


class AttemptProcess:
    """A running attempt. A Ctrl-C on the terminal does not reach it; `ask_to_end` ends it with a checkpoint."""

    def __init__(self, attempt: Attempt) -> None:
        self.attempt = attempt
        self._process = subprocess.Popen(
            module_command("clsplat.jobs.attempt"),
            stdin=subprocess.PIPE,
            stdout=subprocess.PIPE,
            stderr=subprocess.STDOUT,
            **apart(),
        )
        assert self._process.stdin is not None
        with suppress(OSError):  # the process has ended, which `wait` reports
            self._process.stdin.write(json.dumps(attempt.document()).encode() + b"\n")
            self._process.stdin.flush()

    def wait(self) -> Outcome:
        """Wait for the end, and return the outcome. "lost" means that the process was killed."""
        assert self._process.stdout is not None
        with self._process.stdout:
            lines = self._process.stdout.read().decode("utf-8", errors="replace").splitlines()
        status = self._process.wait()
        self.ask_to_end()
        with suppress(ValueError, TypeError, IndexError):
            return Outcome(**json.loads(lines[-1]))
        reason = lines[-1] if lines else f"the process was ended with status {status}"
        return Outcome(self.attempt.name, "lost", status, reason, socket.gethostname())

    def ask_to_end(self) -> None:
        """Ask the command to end, as by SIGTERM. Does not wait."""
        assert self._process.stdin is not None
        with suppress(OSError):
            self._process.stdin.close()

    def kill(self) -> None:
        """Kill the attempt and its command."""
        with suppress(OSError):
            if sys.platform == "win32":
                self._process.kill()
            else:
                os.killpg(self._process.pid, signal.SIGKILL)
