# SPDX-License-Identifier: Apache-2.0
"""The client of a Dask cluster, which exists already or is started on this machine. Needs `distributed`."""

from __future__ import annotations

import logging
import signal
import threading
import time
from collections.abc import Iterator
from contextlib import contextmanager
from typing import Any

from clsplat.errors import InputError, warn

LOCAL_WORKER_THREADS = 2
"""Number of threads of a local worker: one frame is encoded while the next is rendered."""
SCHEDULER_TIMEOUT_SECONDS = 20
"""Seconds within which a scheduler has to answer."""
NO_WORKERS_WARNING_SECONDS = 10.0
"""Seconds between warnings while a scheduler has no workers."""
_LOGGING_PARTS = ("client", "comm", "core", "nanny", "scheduler", "utils", "worker")
"""Parts of Dask with loggers of their own."""


def dask_setup(_: Any) -> None:
    """Ignore Ctrl-C in a worker on this machine: the job reacts to it. Dask calls this when a worker starts."""
    signal.signal(signal.SIGINT, signal.SIG_IGN)


@contextmanager
def dask_client(scheduler: str | None, workers: int | None = None) -> Iterator[Any]:
    """Context manager that yields the `distributed.Client` of a cluster.

    scheduler: address of the scheduler of an existing cluster; None starts a cluster on this machine.
    workers: number of processes of a cluster on this machine; None lets Dask choose it.
    Raises InputError if `distributed` is not installed, or no scheduler answers.
    """
    try:
        import dask
        import distributed
    except ImportError:
        flag = "--scheduler" if scheduler else "--workers"
        raise InputError(
            f"{flag}: needs the package distributed, install it with: pip install 'clsplat[farm]'"
        ) from None
    # silence Dask, which logs every lost worker in many lines; errors that matter are raised
    for name in ("distributed", *(f"distributed.{part}" for part in _LOGGING_PARTS)):
        logging.getLogger(name).setLevel(logging.CRITICAL)
    if scheduler is not None:
        try:
            client = distributed.Client(scheduler, timeout=SCHEDULER_TIMEOUT_SECONDS, set_as_default=False)
        except (OSError, ValueError, RuntimeError) as error:
            reason = str(error).partition("\n")[0] or type(error).__name__
            raise InputError(f"--scheduler {scheduler}: no scheduler answers there: {reason}") from None
        with client:
            yield client
        return
    with (
        dask.config.set({"distributed.worker.daemon": True, "distributed.worker.multiprocessing-method": "spawn"}),
        distributed.LocalCluster(
            n_workers=workers,
            threads_per_worker=LOCAL_WORKER_THREADS,
            processes=True,
            memory_limit=None,  # by default Dask would kill workers with a large model
            dashboard_address=None,
            preload=[__name__],
            silence_logs=logging.CRITICAL,
        ) as cluster,
        distributed.Client(cluster, set_as_default=False) as client,
    ):
        yield client


@contextmanager
def warning_of_no_workers(client: Any, scheduler: str | None, waiting: str) -> Iterator[None]:
    """Context manager that warns at once, and then at intervals, while the scheduler has no workers.

    scheduler: its address; None for a local cluster, which causes no warnings.
    waiting: word for the tasks that wait for workers, such as "frames".
    """
    if scheduler is None:
        yield
        return
    stop = threading.Event()

    def watch() -> None:
        since: float | None = None
        while not stop.is_set():
            try:
                there = bool(client.nthreads())
            except (OSError, RuntimeError, TimeoutError):  # whoever waits for results reports a lost scheduler
                return
            now = time.monotonic()
            since = None if there else since or now
            if since is not None and not stop.is_set():
                waited = f", for {now - since:.0f} s now" if now - since >= 1 else ""
                warn(
                    f"--scheduler {scheduler}: has no workers{waited}; {waiting} wait until one connects; start one "
                    f"with: dask worker {scheduler}"
                )
            stop.wait(NO_WORKERS_WARNING_SECONDS)

    watcher = threading.Thread(target=watch, name="clsplat-farm", daemon=True)
    watcher.start()
    try:
        yield
    finally:
        stop.set()
        watcher.join(NO_WORKERS_WARNING_SECONDS)
