# SPDX-License-Identifier: Apache-2.0
"""Tapes of what was put on a device's queue, to be put there again without the Python that led to it.

CLSPLAT_TAPES=0 makes each launch as ever. With CLSPLAT_TAPES=check each is made as ever too, where a tape is there, and
held against that: an argument that differs and was not declared as `Anew` is an error.
"""

from __future__ import annotations

import os
from collections.abc import Callable, Iterable, Sequence
from functools import partial
from typing import TYPE_CHECKING, Any

import numpy as np
import pyopencl as cl

from clsplat.device.profile import Calls
from clsplat.errors import InputError

if TYPE_CHECKING:
    from clsplat.device.program import Kernel

VARIABLE = "CLSPLAT_TAPES"
CHECK = "check"


class Anew(float):
    """A number of a launch that each replay gives anew."""


class AnewWord(int):
    """The same of 32 bits without a sign."""


def asked() -> str:
    """The use of tapes: 1, 0 or CHECK. Raises InputError."""
    value = os.environ.get(VARIABLE) or "1"
    if value not in ("0", "1", CHECK):
        raise InputError(f"{VARIABLE}={value}: expected 1, 0 or {CHECK}")
    return value


def typed(value: Any) -> Any:
    """An argument of a kernel with a type of its own: whole numbers have 32 bits without a sign, others are floats."""
    if isinstance(value, int):
        return np.uint32(value)
    return np.float32(value) if isinstance(value, float) else value


def described(value: Any) -> object:
    """The part of an argument in which two are alike if a kernel gets the same from both."""
    value = typed(value)
    if isinstance(value, cl.MemoryObjectHolder):
        return value.int_ptr
    return value.size if isinstance(value, cl.LocalMemory) else (value.dtype.str, value.tobytes())


class Tape:
    """Launches, fills and copies to the host, in order.

    entries: functions that put them on the queue, each with its kernel, if it is a launch; calls: the counts of them;
    anew: what sets an argument that is given anew, and its place; reads: the entries that copy to the host. A launch
    has a kernel object of its own, whose other arguments stay set, and leaves it to other tapes: the wrapper takes 0.2
    ms and more to make one. That keeps no buffer alive: whoever has the tape lets go of it where a buffer may go.
    """

    def __init__(self) -> None:
        self.entries: list[tuple[Kernel | None, Callable[[], Any]]] = []
        self.calls = Calls()
        self.anew: list[tuple[Callable[[int, Any], None], int]] = []
        self.reads: list[Callable[[], Any]] = []
        self._owned: list[tuple[Kernel, cl.Kernel]] = []
        self._described: list[tuple[object, ...]] = []
        self._numbers: list[float] = []

    def __del__(self) -> None:
        for kernel, own in self._owned:
            kernel.spare.append(own)

    def add_fill(self, fill: Callable[[], Any], *description: object) -> None:
        """Append a fill."""
        self.entries.append((None, fill))
        self._described.append(("a fill", *description))

    def add_read(self, read: Callable[[], Any], *description: object) -> None:
        """Append a copy to the host."""
        self.entries.append((None, read))
        self.reads.append(read)
        self._described.append(("a copy to the host", *description))

    def add_launch(
        self,
        queue: cl.CommandQueue,
        kernel: Kernel,
        size: tuple[int, ...],
        local: tuple[int, ...] | None,
        values: Sequence[Any],
    ) -> None:
        """Append a launch that has just been made."""
        own = kernel.spare.pop() if kernel.spare else cl.Kernel(kernel.program, kernel.name)
        self._owned.append((kernel, own))
        description = []
        for index, value in enumerate(values):
            own.set_arg(index, typed(value))
            if given := isinstance(value, (Anew, AnewWord)):
                set_bytes = getattr(own, "_set_arg_buf", own.set_arg)  # a tenth of the time: it asks for no type
                self.anew.append((set_bytes, index))
                self._numbers.append(value)
            description.append(None if given else described(value))
        self.entries.append((kernel, partial(cl.enqueue_nd_range_kernel, queue, own, size, local)))
        self._described.append((kernel.name, kernel.variant, size, local, *description))

    def set(self, numbers: Iterable[float]) -> None:
        """Set the numbers that are given anew."""
        for (set_bytes, index), number in zip(self.anew, numbers, strict=True):
            set_bytes(index, typed(number))

    def check(self, fresh: Tape, numbers: Sequence[float]) -> None:
        """Raise AssertionError if a replay with these numbers would put something else on the queue than `fresh`."""
        assert len(self._described) == len(fresh._described), "a tape is longer or shorter than what was made now"
        for one, other in zip(self._described, fresh._described, strict=True):
            assert len(one) == len(other), f"{one[0]} on a tape has another number of arguments than now"
            differing = [place for place, pair in enumerate(zip(one, other, strict=True)) if pair[0] != pair[1]]
            assert not differing, f"{one[0]} on a tape has other arguments than now: {[p - 4 for p in differing]}"
        given, made = ([described(number) for number in each] for each in (numbers, fresh._numbers))
        assert given == made, f"numbers given to a tape are {list(numbers)}, launched {fresh._numbers}"

    def is_all_of(self, calls: Calls) -> bool:
        """Keep the counts of what the queue was given meanwhile. False if some of that is not on the tape: a write, or
        what the host has waited for."""
        self.calls = calls
        return len(self.entries) == calls.launches + calls.fills + calls.reads == calls.total
