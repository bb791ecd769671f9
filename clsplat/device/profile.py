# SPDX-License-Identifier: Apache-2.0
"""Costs of the stages: kernels, milliseconds, launches and bytes, recorded while `clsplat bench` asks for them."""

from __future__ import annotations

import time
from collections.abc import Callable, Iterator
from contextlib import contextmanager
from dataclasses import astuple, dataclass, field
from functools import wraps
from typing import Any, Concatenate, ParamSpec, Protocol, TypeVar

import pyopencl as cl

P = ParamSpec("P")
R = TypeVar("R")

OUTSIDE = "transfers"
"""The stage of what is put on the queue outside every stage: camera, background."""


@dataclass
class StageRecord:
    """kernels: device milliseconds by kernel, copies and fills among them; ms: their sum; wall_ms: from an idle device
    to an idle device, so launches and the host's part are in it; bytes: of the arrays that the launches were given."""

    kernels: dict[str, float] = field(default_factory=dict)
    ms: float = 0.0
    wall_ms: float = 0.0
    launches: int = 0
    bytes: int = 0


@dataclass
class Calls:
    """Counts of what a device's queue was given, from its opening on.

    launches: kernels; fills, writes, reads: of buffers, where the host does not wait; blocking_writes, blocking_reads:
    those that it waits for.
    """

    launches: int = 0
    fills: int = 0
    writes: int = 0
    reads: int = 0
    blocking_writes: int = 0
    blocking_reads: int = 0

    def since(self, earlier: Calls) -> Calls:
        """The counts less those of a copy that was made earlier."""
        return Calls(*(now - then for now, then in zip(astuple(self), astuple(earlier), strict=True)))

    @property
    def total(self) -> int:
        """All of them."""
        return sum(astuple(self))

    def add(self, more: Calls) -> None:
        """Count what a tape has, which never waits."""
        self.launches += more.launches
        self.fills += more.fills
        self.reads += more.reads


class Recorder:
    """A device has one. Off unless inside `recording`; then every launch and transfer is noted under its stage."""

    def __init__(self, queue: cl.CommandQueue) -> None:
        self._queue = queue
        self.on = False
        self._wait = False
        self._stack: list[str] = []
        self._stages: dict[str, StageRecord] = {}
        self._events: list[tuple[str, str, Any]] = []

    @contextmanager
    def recording(self, *, wait: bool) -> Iterator[dict[str, StageRecord]]:
        """The stages of what is done inside, filled in at the end.

        wait: finish the queue around each stage for `wall_ms`; without it the device runs ahead as it always does, and
        the kernels' times are the events'. They are 0 where the queue was made without profiling, or the driver lies.
        """
        stages: dict[str, StageRecord] = {}
        self.on, self._wait, self._stages, self._events = True, wait, stages, []
        try:
            yield stages
            self._queue.finish()
            for stage, kernel, event in self._events:
                times, taken = stages[stage].kernels, _milliseconds(event)
                times[kernel] = times.get(kernel, 0.0) + taken
                stages[stage].ms += taken
        finally:
            self.on, self._stages, self._events = False, {}, []

    def add(self, name: str, event: Any, nbytes: int) -> None:
        """Note a launch or transfer; only while `on`."""
        stage = self._stack[0] if self._stack else OUTSIDE
        record = self._stages.setdefault(stage, StageRecord())
        record.launches += 1
        record.bytes += nbytes
        self._events.append((stage, name, event))

    @contextmanager
    def stage(self, name: str) -> Iterator[None]:
        """Inside, work is that of stage `name`, unless a stage is already going on."""
        outermost = not self._stack
        self._stack.append(name)
        timed = outermost and self._wait
        if timed:
            self._queue.finish()
        start = time.perf_counter()
        try:
            yield
            if timed:
                self._queue.finish()
                record = self._stages.setdefault(name, StageRecord())
                record.wall_ms += 1e3 * (time.perf_counter() - start)
        finally:
            self._stack.pop()


class Recorded(Protocol):
    """A device, which has a recorder."""

    recorder: Recorder


D = TypeVar("D", bound=Recorded)


def stage(name: str) -> Callable[[Callable[Concatenate[D, P], R]], Callable[Concatenate[D, P], R]]:
    """Marks a function whose first argument is the device as a stage of the pipeline."""

    def decorate(function: Callable[Concatenate[D, P], R]) -> Callable[Concatenate[D, P], R]:
        @wraps(function)
        def call(device: D, /, *args: P.args, **kwargs: P.kwargs) -> R:
            if not device.recorder.on:
                return function(device, *args, **kwargs)
            with device.recorder.stage(name):
                return function(device, *args, **kwargs)

        return call

    return decorate


def _milliseconds(event: Any) -> float:
    try:
        return 1e-6 * float(event.profile.end - event.profile.start)
    except cl.Error:  # a queue without profiling
        return 0.0
