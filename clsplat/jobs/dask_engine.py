# SPDX-License-Identifier: Apache-2.0
"""The engine that runs attempts on the workers of a Dask cluster. Only commands and outcomes go through Dask."""

from __future__ import annotations

import inspect
import queue
import secrets
import threading
import time
from collections.abc import Callable, Iterator
from contextlib import contextmanager, suppress
from dataclasses import asdict, dataclass, replace
from importlib import import_module
from typing import Any

from clsplat.errors import ClsplatError
from clsplat.jobs.attempt_process import AttemptProcess
from clsplat.jobs.dask_cluster import dask_client, warning_of_no_workers
from clsplat.jobs.task import Attempt, Outcome
from clsplat.process import MAX_SIGNAL_WAIT_SECONDS

GPU_RESOURCE = "GPU"
"""Name of the Dask resource that a worker with a GPU declares: `dask worker --resources GPU=1`."""
WORKERS_SECONDS = 1.0
"""Seconds between looks at the scheduler's list of workers."""
STOP_SECONDS = 90.0
"""Seconds that the workers have to end their attempts. Attempts kill their commands before this time is over."""
OUTCOME_SECONDS = 30.0
"""Seconds that a worker has to send the outcome of an ended attempt."""

_attempts_here: dict[str, AttemptProcess] = {}
"""In a worker: its running attempts, by the key of their Dask task."""
_ended_here: set[str] = set()
"""In a worker: keys of the attempts that were ended, also before they began."""
_changing_here = threading.Lock()
"""In a worker: held while an attempt begins, or is ended."""


def run_on_worker(key: str, document: dict[str, Any]) -> dict[str, Any]:
    """Run an attempt in a worker. Returns the outcome as a JSON object.

    key: key of the Dask task. document: the attempt as a JSON object, which workers of other versions can read too.
    """
    name = str(document["name"])
    try:
        attempt = Attempt(**document)
    except TypeError:  # a field that this version does not have
        return asdict(Outcome(name, "unfit", reason=f"has another version of clsplat than {document.get('version')}"))
    with _changing_here:
        if key in _ended_here:
            return asdict(Outcome(name, "lost", reason="ended it before it began"))
        process = _attempts_here[key] = AttemptProcess(attempt)
    try:
        return asdict(process.wait())
    finally:
        del _attempts_here[key]


def by_value() -> Callable[[str, dict[str, Any]], dict[str, Any]]:
    """A function that imports and calls `run_on_worker`.

    Dask sends a nested function by value. So a scheduler needs no clsplat, and a worker that has another version of it
    answers with an error instead of leaving the cluster.
    """

    def call(key: str, document: dict[str, Any]) -> dict[str, Any]:
        outcome: dict[str, Any] = import_module("clsplat.jobs.dask_engine").run_on_worker(key, document)
        return outcome

    return call


def end_on_worker(keys: list[str], *, kill: bool = False) -> list[str]:
    """In a worker: ask attempts to end, without waiting, or kill them. Attempts that have not begun never begin.

    keys: keys of the attempts' Dask tasks. Returns the keys of the attempts that still run here.
    """
    with _changing_here:
        _ended_here.update(keys)
        running = {key: process for key in keys if (process := _attempts_here.get(key)) is not None}
    for process in running.values():
        (process.kill if kill else process.ask_to_end)()
    return list(running)


@dataclass(frozen=True)
class _Sent:
    """An attempt on a worker. worker: the worker's address. future: the Dask future of the outcome."""

    name: str
    worker: str
    future: Any


class DaskEngine:
    """Runs one attempt at a time on each worker of a cluster. Has the methods of `Engine`.

    If some workers declare the resource GPU_RESOURCE, only these are used, and each attempt takes one.
    scheduler: address of the scheduler, for messages.
    """

    def __init__(self, client: Any, scheduler: str) -> None:
        self._client, self._scheduler = client, scheduler
        self._sent: dict[str, _Sent] = {}
        self._ended: queue.SimpleQueue[str] = queue.SimpleQueue()
        self._left_out: set[str] = set()
        self._workers: dict[str, bool] = {}  # those that get attempts, and whether they declare a GPU
        self._present: set[str] = set()  # all workers of the cluster
        takes = inspect.signature(client.scheduler_info).parameters
        # from 2025.4 on, distributed returns only 5 workers by default
        self._all_workers = {"n_workers": -1} if "n_workers" in takes else {}
        self._looked_at = float("-inf")

    def free(self) -> int:
        """Number of attempts that can be started now."""
        self._look()
        return len(self._idle())

    def start(self, attempt: Attempt) -> None:
        """Start an attempt on an idle worker."""
        worker = self._idle()[0]
        key = f"clsplat-{attempt.name}-{secrets.token_hex(6)}"
        with self._reaching():
            future = self._client.submit(
                by_value(),
                key,
                attempt.document(),
                key=key,
                workers=[worker],
                resources={GPU_RESOURCE: 1} if self._workers[worker] else None,
                pure=False,
            )
        self._sent[key] = _Sent(attempt.name, worker, future)
        future.add_done_callback(lambda _: self._ended.put(key))

    def wait(self, seconds: float) -> list[Outcome]:
        """Wait at most `seconds` for outcomes, and return them. Raises ClsplatError if the scheduler is lost."""
        keys: list[str] = []
        with suppress(queue.Empty):
            keys.append(self._ended.get(timeout=max(min(seconds, MAX_SIGNAL_WAIT_SECONDS), 0.001)))
            while True:
                keys.append(self._ended.get_nowait())
        outcomes = [self._outcome(self._sent.pop(key)) for key in keys if key in self._sent]
        self._look()
        for key, sent in list(self._sent.items()):
            if sent.worker not in self._present and not sent.future.done():
                del self._sent[key]
                with self._reaching():
                    sent.future.cancel()
                outcomes.append(Outcome(sent.name, "lost", reason="it left the cluster", worker=sent.worker))
        return outcomes

    def leave_out(self, worker: str) -> bool:
        """Start no more attempts on an unfit worker. Returns False if no other worker is left."""
        self._left_out.add(worker)
        return bool(set(self._workers) - self._left_out)

    def stop(self) -> None:
        """End all attempts, and return when their processes have ended. A second Ctrl-C kills them."""
        if not self._sent or self._client.status != "running":
            return
        try:
            self._end_all(STOP_SECONDS)
        except KeyboardInterrupt:
            self._end_all(10.0, kill=True)
            raise

    def _end_all(self, seconds: float, *, kill: bool = False) -> None:
        workers = sorted({sent.worker for sent in self._sent.values()})
        keys, until = list(self._sent), time.monotonic() + seconds
        with suppress(OSError, RuntimeError, TimeoutError):
            answers = self._client.run(end_on_worker, keys, kill=kill, workers=workers, on_error="ignore")
            for key, sent in list(self._sent.items()):
                if key not in answers.get(sent.worker, [key]):  # has not begun, or has ended
                    del self._sent[key]
                    sent.future.cancel()
        with suppress(ClsplatError):
            while self._sent and time.monotonic() < until:
                self.wait(MAX_SIGNAL_WAIT_SECONDS)

    def _idle(self) -> list[str]:
        """Addresses of the workers that can start an attempt."""
        busy = {sent.worker for sent in self._sent.values()}
        return [worker for worker in self._workers if worker not in busy and worker not in self._left_out]

    def _look(self) -> None:
        """Read the list of workers, if the last look is at least WORKERS_SECONDS ago. Raises ClsplatError."""
        now = time.monotonic()
        if now - self._looked_at < WORKERS_SECONDS:
            return
        with self._reaching():
            infos = self._client.scheduler_info(**self._all_workers)["workers"]
        self._present = set(infos)
        gpus = {address: info.get("resources", {}).get(GPU_RESOURCE, 0) >= 1 for address, info in infos.items()}
        self._workers = {address: gpu for address, gpu in gpus.items() if gpu or not any(gpus.values())}
        self._looked_at = now
        if self._workers and not self._sent and self._left_out.issuperset(self._workers):
            raise ClsplatError(
                f"--scheduler {self._scheduler}: has no workers but those that are left out; the same command goes on "
                "with others, or when that is mended"
            )

    def _outcome(self, sent: _Sent) -> Outcome:
        """Read the outcome of an attempt that has ended on its worker, or whose worker Dask has given up."""
        from distributed import CancelledError

        try:
            return replace(Outcome(**sent.future.result(timeout=OUTCOME_SECONDS)), worker=sent.worker)
        except (ImportError, AttributeError, TypeError) as error:
            reason = f"has no clsplat of this version: {error}"
            return Outcome(sent.name, "unfit", reason=reason, worker=sent.worker)
        except CancelledError:
            raise self._lost() from None
        except TimeoutError:
            reason = f"has not sent the outcome within {OUTCOME_SECONDS:.0f} s"
            return Outcome(sent.name, "lost", reason=reason, worker=sent.worker)
        except Exception as error:  # noqa: BLE001  # an error of Dask's or the worker's: the attempt is repeated
            reason = " ".join(str(error).split()) or type(error).__name__
            return Outcome(sent.name, "lost", reason=reason, worker=sent.worker)

    @contextmanager
    def _reaching(self) -> Iterator[None]:
        """Context manager that raises ClsplatError if the scheduler does not answer."""
        try:
            if self._client.status != "running":
                raise self._lost()
            yield
        except (OSError, RuntimeError, TimeoutError):
            raise self._lost() from None

    def _lost(self) -> ClsplatError:
        return ClsplatError(
            f"--scheduler {self._scheduler}: the scheduler was lost; what is done stays, and the same command goes on "
            "when a scheduler runs again"
        )


@contextmanager
def dask_engine(scheduler: str) -> Iterator[DaskEngine]:
    """Context manager that yields the engine of an existing cluster. Raises InputError as `dask_client`.

    scheduler: address of the scheduler.
    """
    with dask_client(scheduler) as client, warning_of_no_workers(client, scheduler, "tasks"):
        yield DaskEngine(client, scheduler)
