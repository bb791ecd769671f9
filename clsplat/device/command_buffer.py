# SPDX-License-Identifier: Apache-2.0
"""Command buffers: launches, fills and copies, recorded once. A replay puts them on a device's queue again, without the
Python code that prepared them.

CLSPLAT_TAPES=0 disables replays. CLSPLAT_TAPES=check runs the Python code every time, and compares each launch with the
recorded launch. If an argument differs that was not passed as `LaunchParameter`, AssertionError is raised.
"""

from __future__ import annotations

import os
from collections.abc import Callable, Iterable, Sequence
from functools import partial
from struct import Struct
from typing import TYPE_CHECKING, Any

import numpy as np
import pyopencl as cl

from clsplat.device.profile import Calls
from clsplat.errors import InputError

if TYPE_CHECKING:
    from clsplat.device.program import Kernel

TAPES_VARIABLE = "CLSPLAT_TAPES"
CHECK_TAPES = "check"


class LaunchParameter(float):
    """A float argument of a launch, which may be different in each replay."""


class LaunchParameterWord(int):
    """An unsigned 32-bit argument of a launch, which may be different in each replay."""


def asked() -> str:
    """Return the value of CLSPLAT_TAPES: "1" (the default), "0" or "check". Raises InputError for other values."""
    value = os.environ.get(TAPES_VARIABLE) or "1"
    if value not in ("0", "1", CHECK_TAPES):
        raise InputError(f"{TAPES_VARIABLE}={value}: expected 1, 0 or {CHECK_TAPES}")
    return value


def typed(value: Any) -> Any:
    """Return a kernel argument with an explicit type: an int as uint32, a float as float32, anything else unchanged."""
    if isinstance(value, int):
        return np.uint32(value)
    return np.float32(value) if isinstance(value, float) else value


def described(value: Any) -> object:
    """Return an object by which kernel arguments are compared: two arguments with the same value give equal objects."""
    value = typed(value)
    if isinstance(value, cl.MemoryObjectHolder):
        return value.int_ptr
    return value.size if isinstance(value, cl.LocalMemory) else (value.dtype.str, value.tobytes())


class CommandBuffer:
    """Launches, fills and copies to the host, in order.

    entries: for each command a function that puts it on the queue, and its kernel if it is a launch.
    calls: how many commands of each kind were recorded.
    setters: for each launch parameter, the function that sets an argument of its kernel, and the argument's index.
    reads: the functions of `entries` that copy to the host.
    given: buffers in the recorded launches that a replay may replace by other buffers.

    Each launch has its own kernel object, in which the arguments that never change stay set. When a command buffer is
    dropped, its kernel objects are kept for later command buffers, because pyopencl takes at least 0.2 ms to make one.
    A command buffer keeps no array alive: its owner must drop it before one of its arrays is freed.
    """

    def __init__(self, given: Sequence[cl.Buffer] = ()) -> None:
        self.entries: list[tuple[Kernel | None, Callable[[], Any]]] = []
        self.calls = Calls()
        self.setters: list[tuple[Callable[[int, Any], None], int]] = []
        self.reads: list[Callable[[], Any]] = []
        self._owned: list[tuple[Kernel, cl.Kernel]] = []
        self._described: list[tuple[object, ...]] = []
        self._numbers: list[float] = []
        self._format, self._set = Struct("="), b""
        """Struct format of the values of all launch parameters, and these values packed in it, as last set."""
        self._given = {buffer.int_ptr: number for number, buffer in enumerate(given)}
        self._places: list[tuple[Callable[[int, Any], None], int, int]] = []
        """For each argument that is one of the `given` buffers: the function that sets it, its index, and the buffer's
        index in `given`."""

    def __del__(self) -> None:
        for kernel, own in self._owned:
            kernel.spare.append(own)

    def add_fill(self, fill: Callable[[], Any], *description: object) -> None:
        """Append `fill`, which fills a buffer. description: the buffer, the value and the size, for `check`."""
        self.entries.append((None, fill))
        self._described.append(("a fill", *description))

    def add_read(self, read: Callable[[], Any], *description: object) -> None:
        """Append `read`, which copies a buffer to the host. description: the buffer and the size, for `check`."""
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
        """Append a launch that was just put on the queue, given its global size, group size and argument values."""
        own = kernel.spare.pop() if kernel.spare else cl.Kernel(kernel.program, kernel.name)
        self._owned.append((kernel, own))
        description: list[object] = []
        for index, value in enumerate(values):
            own.set_arg(index, typed(value))
            if isinstance(value, (LaunchParameter, LaunchParameterWord)):
                set_bytes = getattr(own, "_set_arg_buf", own.set_arg)  # faster than set_arg, as it does not check types
                self.setters.append((set_bytes, index))
                self._numbers.append(value)
                description.append(None)
            elif isinstance(value, cl.MemoryObjectHolder) and value.int_ptr in self._given:
                self._places.append((own.set_arg, index, self._given[value.int_ptr]))
                description.append(("given", self._given[value.int_ptr]))
            else:
                description.append(described(value))
        self.entries.append((kernel, partial(cl.enqueue_nd_range_kernel, queue, own, size, local)))
        self._described.append((kernel.name, kernel.variant, size, local, *description))

    def set(self, numbers: Iterable[float], given: Sequence[cl.Buffer] = ()) -> None:
        """Set the arguments that are different in each replay. Call it before the replay.

        numbers: values of the launch parameters, in order of the recorded launches.
        given: buffers for this replay, in the order of `given` in the constructor.
        """
        values, old = self._format.pack(*numbers), self._set
        if values != old:
            for place, (set_bytes, index) in enumerate(self.setters):
                if (value := values[4 * place : 4 * place + 4]) != old[4 * place : 4 * place + 4]:
                    set_bytes(index, value)
            self._set = values
        for set_buffer, index, place in self._places:
            set_buffer(index, given[place])

    def check(self, fresh: CommandBuffer, numbers: Sequence[float]) -> None:
        """Raise AssertionError if a replay with these numbers would not repeat `fresh`, which was just recorded."""
        assert len(self._described) == len(fresh._described), "a replay would have the wrong number of commands"
        for one, other in zip(self._described, fresh._described, strict=True):
            assert len(one) == len(other), f"{one[0]}: a replay would pass {len(one)} arguments, expected {len(other)}"
            differing = [place for place, pair in enumerate(zip(one, other, strict=True)) if pair[0] != pair[1]]
            assert not differing, (
                f"{one[0]}: a replay would pass wrong values of the arguments with index {[p - 4 for p in differing]}"
            )
        given, made = ([described(number) for number in each] for each in (numbers, fresh._numbers))
        assert given == made, (
            f"numbers: the replay was given {list(numbers)}, expected the launches' parameters {fresh._numbers}"
        )

    def is_all_of(self, calls: Calls) -> bool:
        """End the recording. Returns True if all calls were recorded: neither a write nor a blocking call was made.

        calls: counts of the calls on the queue since the recording began.
        """
        self.calls = calls
        self._format = Struct("=" + "".join("f" if isinstance(number, float) else "I" for number in self._numbers))
        self._set = self._format.pack(*self._numbers)
        return len(self.entries) == calls.launches + calls.fills + calls.reads == calls.total
