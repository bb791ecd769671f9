# SPDX-License-Identifier: Apache-2.0
"""Schedulers and workers of Dask as processes of this machine, started by its command line, on a loopback address."""

from __future__ import annotations

import os
import signal
import socket
import subprocess
import sys
import time
from collections.abc import Iterator
from contextlib import contextmanager, suppress
from pathlib import Path


class DaskProcesses:
    """A scheduler and its workers. `close` kills them all.

    folder: folder of logs and of the workers' own files.
    """

    def __init__(self, folder: Path) -> None:
        self.folder = folder
        self.processes: dict[str, subprocess.Popen[bytes]] = {}
        with socket.socket() as free:
            free.bind(("127.0.0.1", 0))
            self.port = free.getsockname()[1]
        self.address = f"tcp://127.0.0.1:{self.port}"

    def start_scheduler(self) -> None:
        """Start a scheduler at `address`, and wait until it answers."""
        self._start("scheduler", "scheduler", "--host", "127.0.0.1", "--port", str(self.port), "--no-dashboard")
        until = time.monotonic() + 60
        while time.monotonic() < until:
            with suppress(OSError), socket.create_connection(("127.0.0.1", self.port), 1):
                return
            time.sleep(0.05)
        raise AssertionError((self.folder / "scheduler.txt").read_text())

    def start_worker(self, name: str, *words: str, environment: dict[str, str] | None = None) -> int:
        """Start a worker of one thread. Returns its process id. words: further arguments of `dask worker`."""
        words = ("--nthreads", "1", "--no-nanny", "--no-dashboard", "--name", name, *words)
        words = (self.address, "--local-directory", str(self.folder), "--host", "127.0.0.1", *words)
        return self._start(name, "worker", *words, environment=environment)

    def _start(self, name: str, *words: str, environment: dict[str, str] | None = None) -> int:
        with (self.folder / f"{name}.txt").open("ab") as log:
            process = subprocess.Popen(
                [sys.executable, "-m", "dask", *words],
                stdin=subprocess.DEVNULL,
                stdout=log,
                stderr=log,
                start_new_session=True,
                cwd=self.folder,  # `python -m` imports from there first
                env={**os.environ, **(environment or {})},
            )
        self.processes[name] = process
        return process.pid

    def runs(self, name: str) -> bool:
        """True if the process runs."""
        return name in self.processes and self.processes[name].poll() is None

    def kill(self, name: str) -> None:
        """Kill a process with SIGKILL."""
        self.processes[name].send_signal(signal.SIGKILL)
        self.processes.pop(name).wait()

    def close(self) -> None:
        """Kill all processes."""
        for name in list(self.processes):
            self.kill(name)


@contextmanager
def dask_processes(folder: Path, *workers: str) -> Iterator[DaskProcesses]:
    """Context manager that yields a running scheduler with these workers, and kills them at the end."""
    processes = DaskProcesses(folder)
    try:
        processes.start_scheduler()
        for name in workers:
            processes.start_worker(name)
        yield processes
    finally:
        processes.close()
