# SPDX-License-Identifier: Apache-2.0
"""Costs of the stages: kernels, milliseconds, launches and bytes; recorded only on request, for `clsplat bench`."""

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

TRANSFERS_STAGE = "transfers"
"""Name under which work outside all stages is recorded, such as copies of the camera and the background."""


@dataclass
class StageRecord:
    """The costs of one stage.

    kernels: milliseconds on the device, for each kernel, copy and fill by name.
    ms: sum of `kernels`.
    wall_ms: elapsed milliseconds, including launches and work on the host. The device is idle before and after.
    bytes: bytes of the arrays that were passed to kernels.
    """

    kernels: dict[str, float] = field(default_factory=dict)
    ms: float = 0.0
    wall_ms: float = 0.0
    launches: int = 0
    bytes: int = 0


@dataclass
class Calls:
    """Numbers of calls on a device's queue since the device was opened.

    launches: kernel launches.
    fills, writes, reads: buffer operations that do not block the host.
    blocking_writes, blocking_reads: buffer operations that block the host.
    """

    launches: int = 0
    fills: int = 0
    writes: int = 0
    reads: int = 0
    blocking_writes: int = 0
    blocking_reads: int = 0

    def since(self, earlier: Calls) -> Calls:
        """Return the numbers of calls since `earlier`, a copy of the counts."""
        return Calls(*(now - then for now, then in zip(astuple(self), astuple(earlier), strict=True)))

    @property
    def total(self) -> int:
        """Number of all calls together."""
        return sum(astuple(self))

    def add(self, more: Calls) -> None:
        """Add the counts of a replayed command buffer, which contains no blocking calls."""
        self.launches += more.launches
        self.fills += more.fills
        self.reads += more.reads


class Recorder:
    """Recorder of a device's launches and transfers, by stage. It is on only inside a `recording` block."""

    def __init__(self, queue: cl.CommandQueue) -> None:
        self._queue = queue
        self.on = False
        self._wait = False
        self._stack: list[str] = []
        self._stages: dict[str, StageRecord] = {}
        self._events: list[tuple[str, str, Any]] = []

    @contextmanager
    def recording(self, *, wait: bool) -> Iterator[dict[str, StageRecord]]:
        """Record the work in the block. Yields the records by stage, which are filled in at the end of the block.

        wait: True waits for the device before and after each stage, to measure `wall_ms`.
        The times of kernels come from OpenCL's events, and are 0 if the queue was made without profiling.
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
        """Record a launch or transfer by its name, OpenCL event and bytes. Call this only while `on` is True."""
        stage = self._stack[0] if self._stack else TRANSFERS_STAGE
        record = self._stages.setdefault(stage, StageRecord())
        record.launches += 1
        record.bytes += nbytes
        self._events.append((stage, name, event))

    @contextmanager
    def stage(self, name: str) -> Iterator[None]:
        """Assign the work in the block to stage `name`, unless the block is inside another stage."""
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
    """An object with a recorder, such as a `Device`."""

    recorder: Recorder


D = TypeVar("D", bound=Recorded)


UPDATED_ARRAYS_BY_KERNEL: dict[str, int] = {}
"""Number of arrays that a kernel both reads and writes, by the kernel's name. They are its last array arguments, and
their bytes count twice."""


def stage(name: str, **updated: int) -> Callable[[Callable[Concatenate[D, P], R]], Callable[Concatenate[D, P], R]]:
    """Mark a function, whose first argument is the device, as a stage of the pipeline.

    updated: for kernels that the function launches, by name: the number of arrays that the kernel reads and writes.
    """

    def decorate(function: Callable[Concatenate[D, P], R]) -> Callable[Concatenate[D, P], R]:
        UPDATED_ARRAYS_BY_KERNEL.update(updated)

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
        event.wait()  # it may be of another queue than the one that has finished
        return 1e-6 * float(event.profile.end - event.profile.start)
    except cl.Error:  # OpenCL has no times for a queue made without profiling
        return 0.0
