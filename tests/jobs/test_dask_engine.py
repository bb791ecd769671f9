# SPDX-License-Identifier: Apache-2.0
"""The Dask engine with a stub of a cluster: workers that come and go, outcomes that do not come, and ended attempts."""

from __future__ import annotations

from collections.abc import Callable
from pathlib import Path
from typing import Any

import pytest

from clsplat.jobs import dask_engine
from clsplat.jobs.dask_engine import DaskEngine
from clsplat.jobs.task import Attempt, Outcome

GPU_WORKER = {"resources": {dask_engine.GPU_RESOURCE: 1}}


class StubFuture:
    """Future of an attempt. `end` sets the outcome, or the exception, with which the attempt ends."""

    def __init__(self) -> None:
        self.outcome: Outcome | Exception | None = None
        self.cancelled, self.timeouts = False, list[float]()
        self._callbacks: list[Callable[[StubFuture], None]] = []

    def add_done_callback(self, call: Callable[[StubFuture], None]) -> None:
        self._callbacks.append(call)

    def done(self) -> bool:
        return self.outcome is not None

    def end(self, outcome: Outcome | Exception) -> None:
        self.outcome = outcome
        for call in self._callbacks:
            call(self)

    def cancel(self) -> None:
        self.cancelled = True

    def result(self, timeout: float) -> dict[str, Any]:
        self.timeouts.append(timeout)
        if isinstance(self.outcome, Outcome):
            return vars(self.outcome)
        assert self.outcome is not None
        raise self.outcome


class StubClient:
    """Client of a cluster whose workers run nothing. running: keys of the attempts that have begun."""

    status = "running"

    def __init__(self, *workers: str) -> None:
        self.workers: dict[str, dict[str, Any]] = {worker: {} for worker in workers}
        self.futures: dict[str, StubFuture] = {}
        self.running: list[str] = []

    def scheduler_info(self, n_workers: int = 5) -> dict[str, Any]:
        names = list(self.workers)[: n_workers if n_workers >= 0 else None]
        return {"workers": {name: self.workers[name] for name in names}}

    def submit(self, *_: object, key: str, **__: object) -> StubFuture:
        return self.futures.setdefault(key, StubFuture())

    def run(self, _: object, keys: list[str], *, workers: list[str], **__: object) -> dict[str, list[str]]:
        for key in self.running:
            self.futures[key].end(Outcome("a", "ended", 143))
        return {worker: [key for key in keys if key in self.running] for worker in workers}


@pytest.fixture(autouse=True)
def _quick(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(dask_engine, "WORKERS_SECONDS", 0.0)


def attempt(name: str) -> Attempt:
    return Attempt(name, ("clsplat",), "/jobs", (), "0")


def test_a_gpu_worker_that_joins() -> None:
    """Attempts on CPU workers go on, and only the new worker gets others. An attempt is lost when its worker leaves."""
    client = StubClient("tcp://a", "tcp://b")
    engine = DaskEngine(client, "tcp://s")
    assert engine.free() == 2
    engine.start(attempt("a"))
    client.workers["tcp://gpu"] = GPU_WORKER
    assert engine.free() == 1 and engine._idle() == ["tcp://gpu"]
    assert engine.wait(0) == []
    del client.workers["tcp://a"]
    assert engine.wait(0) == [Outcome("a", "lost", reason="it left the cluster", worker="tcp://a")]


def test_more_workers_than_dask_lists_by_default() -> None:
    assert DaskEngine(StubClient(*map(str, range(7))), "tcp://s").free() == 7


@pytest.mark.needs("distributed")
def test_an_outcome_that_does_not_come() -> None:
    """The attempt is repeated. Without a limit of time, the dispatcher would wait for ever."""
    client = StubClient("tcp://a")
    engine = DaskEngine(client, "tcp://s")
    assert engine.free() == 1
    engine.start(attempt("a"))
    (future,) = client.futures.values()
    future.end(TimeoutError())
    reason = "has not sent the outcome within 30 s"
    assert engine.wait(0) == [Outcome("a", "lost", reason=reason, worker="tcp://a")]
    assert future.timeouts == [dask_engine.OUTCOME_SECONDS]


@pytest.mark.needs("distributed")
def test_the_end_of_attempts_that_have_not_begun() -> None:
    """They are cancelled, and not waited for; an attempt that runs is."""
    client = StubClient("tcp://a", "tcp://b")
    engine = DaskEngine(client, "tcp://s")
    assert engine.free() == 2
    engine.start(attempt("a"))
    engine.start(attempt("b"))
    begun, queued = client.futures
    client.running = [begun]
    engine.stop()
    assert not client.futures[begun].cancelled and client.futures[queued].cancelled
    assert engine._sent == {}


def test_an_ended_attempt_never_begins(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    """As the worker may receive the end of an attempt before the attempt."""
    monkeypatch.setattr(dask_engine, "_ended_here", set())
    monkeypatch.setattr(dask_engine, "AttemptProcess", None)  # a call fails
    assert dask_engine.end_on_worker(["k"]) == []
    outcome = Outcome(**dask_engine.run_on_worker("k", attempt("a").document()))
    assert outcome == Outcome("a", "lost", reason="ended it before it began")
