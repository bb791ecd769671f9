# SPDX-License-Identifier: Apache-2.0
"""Arrays in device memory, each a buffer with a shape and a dtype; and workspaces, which keep scratch arrays by name.

To debug reads of uninitialised memory, CLSPLAT_POISON=1 fills every array with NaN (2143289344 as an integer) when it
is allocated or taken from a workspace. CLSPLAT_POISON=0xff800000, or another 32-bit number, fills it with that number.
"""

from __future__ import annotations

import os
from collections.abc import Callable
from contextlib import suppress
from dataclasses import dataclass
from functools import partial
from math import prod
from typing import Any, TypeVar
from weakref import WeakKeyDictionary

import numpy as np
import pyopencl as cl
from numpy.typing import DTypeLike, NDArray

from clsplat.device.command_buffer import CHECK_TAPES, CommandBuffer, asked
from clsplat.device.context import Device
from clsplat.device.host_allocator import host_bytes
from clsplat.errors import CapacityError, InputError, amount

R = TypeVar("R")

_inner = getattr(cl, "_cl", None)
_begin_write = getattr(_inner, "_enqueue_write_buffer", cl.enqueue_copy)
_begin_read = getattr(
    _inner, "_enqueue_read_buffer", lambda queue, buffer, host, **how: cl.enqueue_copy(queue, host, buffer, **how)
)
_begin_fill = getattr(_inner, "_enqueue_fill_buffer", cl.enqueue_fill_buffer)
"""pyopencl's inner functions that start writes, reads and fills. They are quicker than `enqueue_copy` and
`enqueue_fill_buffer`, which first query the buffers and the queue, but not every version of pyopencl has them."""


@dataclass(frozen=True, eq=False)
class DeviceArray:
    """A C-contiguous array on a device, at the start of `buffer`, which may be larger than the array."""

    device: Device
    buffer: cl.Buffer
    shape: tuple[int, ...]
    dtype: np.dtype[Any]

    @property
    def size(self) -> int:
        """Number of elements."""
        return prod(self.shape)

    @property
    def nbytes(self) -> int:
        """Number of bytes of the array's elements."""
        return self.size * self.dtype.itemsize

    def get(self) -> NDArray[Any]:
        """Return a copy of this array on the host. Waits for the device."""
        host = np.empty(self.shape, self.dtype)
        self.read_into(host)
        return host

    def set(self, values: NDArray[Any]) -> None:
        """Copy the host array `values` to this array, and wait. Raises ValueError if the shape or dtype differs."""
        self._check(values)
        self._write(values, 0)

    def send(self, values: NDArray[Any]) -> None:
        """Copy the host array `values` to this array without waiting.

        `values` must not change until the host has waited for the device. Raises ValueError if its shape or
        dtype differs, or it is not C-contiguous.
        """
        self._check(values)
        if values.size:
            self.device.calls.writes += 1
            try:
                event = _begin_write(self.device.queue, self.buffer, values, is_blocking=False)
            except cl.Error as error:
                raise self.device.failed(_WRITING, error) from None
            self._note("write", event)
            self.device.under_way.append(event)  # keeps the event alive: deleting it would wait for the copy

    def _check(self, values: NDArray[Any]) -> None:
        if values.shape != self.shape or values.dtype != self.dtype:
            raise ValueError(
                f"values: got {values.dtype} of shape {values.shape}, expected {self.dtype} of shape {self.shape}"
            )

    def fill(self, value: float) -> None:
        """Set every element to `value`."""
        if self.size:
            self.device.calls.fills += 1
            pattern = np.asarray(value, self.dtype)
            fill = partial(_begin_fill, self.device.queue, self.buffer, pattern, 0, self.nbytes)
            try:
                self._note("fill", fill())
            except cl.Error as error:
                raise self.device.failed(_WRITING, error) from None
            for commands in self.device.command_buffers:
                commands.add_fill(fill, self.buffer.int_ptr, pattern.tobytes(), self.nbytes)

    def _note(self, name: str, event: cl.Event, nbytes: int | None = None) -> None:
        if self.device.recorder.on:
            self.device.recorder.add(name, event, self.nbytes if nbytes is None else nbytes)

    def read_into(self, host: NDArray[Any]) -> None:
        """Copy this array to `host`, a C-contiguous array of the same shape and dtype, and wait for the device."""
        self._read(host, 0)

    def begin_get(self, into: NDArray[Any] | None = None) -> Callable[[], NDArray[Any]]:
        """Start a copy to the host, which runs after all work that is on the queue now.

        into: host array of the same shape to copy to, for example from `pinned`; None allocates one.
        Returns a function that waits for this copy only and returns the host array.
        """
        host = np.empty(self.shape, self.dtype) if into is None else into
        copying = partial(self._copied, _READING, host, self.buffer, is_blocking=False)
        self.device.calls.reads += 1
        event = copying()
        self._note("read", event)

        queue, buffer = self.device.queue, self.buffer

        def again() -> None:
            nonlocal event
            try:
                event = _begin_read(queue, buffer, host, is_blocking=False)
            except cl.Error as error:
                raise self.device.failed(_READING, error) from None

        def finish() -> NDArray[Any]:
            try:
                event.wait()
            except cl.Error as error:
                raise self.device.failed(_READING, error) from None
            return host

        for commands in self.device.command_buffers:
            commands.add_read(again, self.buffer.int_ptr, self.nbytes)
        return finish

    def get_rows(self, start: int, stop: int) -> NDArray[Any]:
        """Return a host copy of the rows [start, stop), and wait for the device. `start` needs no alignment."""
        host = np.empty((stop - start, *self.shape[1:]), self.dtype)
        self._read(host, start)
        return host

    def set_rows(self, start: int, values: NDArray[Any]) -> None:
        """Copy the host array `values` to the rows from `start` on, and wait. `start` needs no alignment."""
        self._write(values, start)

    def _read(self, host: NDArray[Any], start: int) -> None:
        """Fill the host array `host` with this array's rows from `start` on, and wait for the device."""
        if host.size:
            self.device.calls.blocking_reads += 1
            event = self._copied(_READING, host, self.buffer, src_offset=self._at(start), is_blocking=True)
            self._note("read", event, host.nbytes)
            self.device.under_way.clear()  # the queue is in order, so that all earlier work is done

    def _write(self, values: NDArray[Any], start: int) -> None:
        """Copy the host array `values` to the rows from `start` on, and wait for the device."""
        if values.size:
            self.device.calls.blocking_writes += 1
            host = np.ascontiguousarray(values, self.dtype)
            event = self._copied(_WRITING, self.buffer, host, dst_offset=self._at(start), is_blocking=True)
            self._note("write", event, host.nbytes)
            self.device.under_way.clear()

    def _copied(self, work: str, *ends: Any, **how: Any) -> cl.Event:
        """Put a copy on the queue, and return its event. Raises DriverError or CapacityError if the copy or an earlier
        kernel fails.

        work: what the copy does, for the message of an error.
        ends, how: arguments of `cl.enqueue_copy` after the queue.
        """
        try:
            return cl.enqueue_copy(self.device.queue, *ends, **how)
        except cl.Error as error:
            raise self.device.failed(work, error) from None

    def _at(self, row: int) -> int:
        """Return the byte offset of a row in the array. An array without dimensions has only row 0."""
        return row * (self.nbytes // self.shape[0]) if row else 0

    def rows(self, start: int, stop: int) -> DeviceArray:
        """A view of the rows [start, stop). `start` must be a multiple of `Device.row_alignment`."""
        if (start, stop) == (0, self.shape[0]):
            return self
        width = self.nbytes // max(self.shape[0], 1)
        buffer = self.buffer.get_sub_region(start * width, max((stop - start) * width, 1)) if width else self.buffer
        return DeviceArray(self.device, buffer, (stop - start, *self.shape[1:]), self.dtype)

    def reshaped(self, *shape: int) -> DeviceArray:
        """Return an array of the given shape in the same memory, with at most as many elements as this array."""
        return DeviceArray(self.device, self.buffer, shape, self.dtype)


_READING, _WRITING = "reading its memory", "writing to its memory"


def _poison() -> NDArray[np.uint32] | None:
    """Return the 32-bit number that CLSPLAT_POISON fills new memory with; None if it is not set. Raises InputError."""
    value = os.environ.get("CLSPLAT_POISON", "")
    if value in ("", "0"):
        return None
    try:
        return np.array(0x7FC00000 if value == "1" else int(value, 0), np.uint32)
    except (ValueError, OverflowError):
        raise InputError(f"CLSPLAT_POISON={value}: expected 1, or a 32-bit number such as 0xff800000") from None


def _fill_bytes(device: Device, buffer: cl.Buffer, word: NDArray[np.uint32], nbytes: int) -> None:
    """Fill the first `nbytes` bytes of a buffer with the 32-bit `word`.

    If `nbytes` is not a multiple of 4, the bytes after the last whole word get the lowest byte of `word`.
    """
    whole = nbytes // 4 * 4
    if whole:
        cl.enqueue_fill_buffer(device.queue, buffer, word, 0, whole)
    if nbytes > whole:
        cl.enqueue_fill_buffer(device.queue, buffer, np.uint8(word & 0xFF), whole, nbytes - whole)


class _Buffer(cl.Buffer):  # type: ignore[misc]  # no types of its own
    """An OpenCL buffer that allows weak references, so that the memory account learns when the buffer is freed."""


def allocate(device: Device, shape: tuple[int, ...], dtype: DTypeLike, capacity: int = 0) -> DeviceArray:
    """Allocate an uninitialised array of this shape, in a buffer for at least `capacity` elements.

    Raises CapacityError if the buffer would exceed the device's limit for one buffer, the limit for all buffers
    together (`Device.memory`), or the device's free memory.
    """
    kind = np.dtype(dtype)
    elements = max(prod(shape), capacity, 1)
    nbytes = elements * kind.itemsize
    limit = device.max_allocation
    if nbytes > limit:
        raise CapacityError(
            f"a buffer of {amount(nbytes)} is needed, but {device.name} allows at most {amount(limit)}: "
            "use a smaller resolution or fewer Gaussians (--density.max-gaussians)"
        )
    device.memory.check(nbytes)
    try:
        buffer = _Buffer(device.context, cl.mem_flags.READ_WRITE, nbytes)
    except cl.MemoryError:
        raise device.used_up(f"a buffer of {amount(nbytes)}") from None
    device.memory.add(buffer, nbytes)
    if (word := _poison()) is not None:
        _fill_bytes(device, buffer, word, nbytes)
    return DeviceArray(device, buffer, shape, kind)


def upload(device: Device, values: NDArray[Any]) -> DeviceArray:
    """Allocate an array on the device and copy the host array `values` to it."""
    array = allocate(device, values.shape, values.dtype)
    array.set(values)
    return array


def shared(device: Device, values: NDArray[Any]) -> DeviceArray:
    """Return a device array that uses the memory of `values`, a C-contiguous host array. Nothing is copied.

    The device must share the host's memory. `values` must not change as long as the result exists.
    """
    buffer = cl.Buffer(device.context, cl.mem_flags.READ_ONLY | cl.mem_flags.USE_HOST_PTR, hostbuf=values)
    return DeviceArray(device, buffer, values.shape, values.dtype)


def from_host(device: Device, values: NDArray[Any]) -> DeviceArray:
    """A device array that holds the host array's values, for kernels that only read it.

    A C-contiguous array is not copied if the device shares the host's memory. Otherwise it is copied without waiting.
    The host array must not change as long as the result exists.
    """
    host = np.ascontiguousarray(values).reshape(values.shape)
    if device.shares_memory and host.size:
        return shared(device, host)
    array = allocate(device, host.shape, host.dtype)
    array.send(host)
    return array


@dataclass(frozen=True, eq=False)
class Hosted:
    """An array that kernels write, and a host array that `get` fills with its values. On a device that shares the
    host's memory, both arrays are in the same memory."""

    array: DeviceArray
    host: NDArray[Any]

    def get(self) -> NDArray[Any]:
        """Wait for the device, and return the host array itself. It is valid until a kernel writes to `array` again."""
        if not self.host.size:
            return self.host
        if not self.array.device.shares_memory:
            self.array.read_into(self.host)
            return self.host
        device, array = self.array.device, self.array
        flags = cl.map_flags.READ
        mapped, _ = cl.enqueue_map_buffer(
            device.queue, array.buffer, flags, 0, array.shape, array.dtype, is_blocking=True
        )
        mapped.base.release(device.queue)
        device.calls.blocking_reads += 1
        device.under_way.clear()
        return self.host


def hosted(
    device: Device, shape: tuple[int, ...], dtype: DTypeLike = np.float32, *, in_pinned_memory: bool = False
) -> Hosted:
    """Allocate an array of this shape on the device and on the host. Raises CapacityError like `allocate`.

    in_pinned_memory: True for a host array in pinned memory, if the device does not share the host's memory and there
        is enough of it.
    """
    kind = np.dtype(dtype)
    nbytes = prod(shape) * kind.itemsize
    if not device.shares_memory or not nbytes:
        array = allocate(device, shape, kind)
        if in_pinned_memory and nbytes:
            with suppress(CapacityError):
                return Hosted(array, pinned(device, shape, kind))
        return Hosted(array, np.empty(shape, kind))
    memory = host_bytes(-(-nbytes // 4) * 4)
    if (word := _poison()) is not None:
        memory.view(np.uint32)[:] = word
    host = memory[:nbytes].view(kind).reshape(shape)
    flags = cl.mem_flags.READ_WRITE | cl.mem_flags.USE_HOST_PTR
    return Hosted(DeviceArray(device, cl.Buffer(device.context, flags, hostbuf=host), shape, kind), host)


def pinned(device: Device, shape: tuple[int, ...], dtype: DTypeLike) -> NDArray[Any]:
    """Allocate a host array in pinned memory, from and to which a device can copy while the host works.

    A copy from or to unpinned memory may make the host wait, even if the call is non-blocking.

    Raises CapacityError if there is no pinned memory available.
    """
    nbytes = prod(shape) * np.dtype(dtype).itemsize
    flags = cl.map_flags.READ | cl.map_flags.WRITE
    try:
        buffer = cl.Buffer(device.context, cl.mem_flags.READ_WRITE | cl.mem_flags.ALLOC_HOST_PTR, nbytes)
        host, _ = cl.enqueue_map_buffer(device.queue, buffer, flags, 0, shape, dtype, is_blocking=True)
    except cl.Error as error:
        raise CapacityError(f"{device.name}: no pinned memory available ({error})") from None
    return host  # type: ignore[no-any-return]  # the array keeps the mapping alive, and the mapping keeps the buffer


MAX_COMMAND_BUFFERS_PER_OBJECT = 256
"""Maximum number of command buffers that a workspace keeps for one object (`of` in `Workspace.replayed`): enough for
photographs of a few sizes. When there are this many, the next one replaces them all."""


class Workspace:
    """Scratch arrays on a device, kept by name, and command buffers that use them.

    A call of `array` with a name reuses the buffer of the last call with this name. A buffer that is too small is
    replaced by a buffer of 1.5 times the required size, or of exactly the required size if `tight` is True. When a
    buffer is replaced, all command buffers are dropped.
    """

    def __init__(self, device: Device) -> None:
        self._device = device
        self.tight = device.memory.limit is not None
        self._poison = _poison()
        self._use = asked()
        self._arrays: dict[str, DeviceArray] = {}
        self._latest: dict[str, tuple[DeviceArray, DTypeLike]] = {}
        self._command_buffers: WeakKeyDictionary[object, dict[tuple[object, ...], tuple[Any, CommandBuffer]]] = (
            WeakKeyDictionary()
        )
        self._renewed = 0

    def replayed(
        self,
        of: object,
        key: tuple[object, ...],
        make: Callable[[], R],
        numbers: tuple[float, ...] = (),
        given: tuple[DeviceArray, ...] = (),
        before: Callable[[], None] | None = None,
    ) -> R:
        """Return the result of `make`. The first call with a key calls `make` and records the commands that it puts on
        the queue. Later calls with this key replay these commands and return the first call's result.

        of: an object whose arrays `make` uses, in addition to the workspace's. When this object is deleted, its command
        buffers are dropped.
        key: all other inputs of `make`. For equal keys `make` must give the same result and the same commands.
        numbers: inputs that may differ between calls: the `LaunchParameter` arguments of the kernels, in order.
        given: arrays that may differ between calls with the same key, if their shapes and types are the same.
        before: function to call before a replay, for work on the host that `make` does when it is called.

        If `make` itself calls `replayed`, the inner call records nothing, as the outer call records all commands.
        """
        device = self._device
        if self._poison is not None or self._use == "0" or device.command_buffers or not device.replays:
            return make()
        command_buffers = self._command_buffers.get(of)
        known = None if command_buffers is None else command_buffers.get(key)
        if known is not None and self._use != CHECK_TAPES:
            if before is not None:
                before()
            known[1].set(numbers, [array.buffer for array in given])
            device.replay(known[1])
            return known[0]  # type: ignore[no-any-return]  # the result of this key's `make`
        renewed = self._renewed
        result, commands = device.record(make, [array.buffer for array in given])
        if commands is None or self._renewed != renewed:
            return result
        if known is not None:
            known[1].check(commands, numbers)
            for read in known[1].reads:  # fills the first call's host arrays, as its result is returned
                read()
            return known[0]  # type: ignore[no-any-return]  # as above
        command_buffers = self._command_buffers.setdefault(of, {})
        if len(command_buffers) >= MAX_COMMAND_BUFFERS_PER_OBJECT:
            command_buffers.clear()
        command_buffers[key] = result, commands
        return result

    def array(
        self, name: str, shape: tuple[int, ...], dtype: DTypeLike = np.float32, *, kept: bool = False
    ) -> DeviceArray:
        """Return the scratch array of this name. Its contents are undefined until they are written.

        kept: True keeps the contents of the array. The last call for this name must have had the same shape.
        """
        latest = self._latest.get(name)
        if latest is not None and latest[0].shape == shape and latest[1] is dtype and self._poison is None:
            return latest[0]
        kind = np.dtype(dtype)
        elements = prod(shape)
        held = self._arrays.get(name)
        if held is None or held.buffer.size < elements * kind.itemsize:
            roomy = held is not None and not self.tight
            spare = min(elements * 3 // 2, self._device.max_allocation // kind.itemsize) if roomy else 0
            if held is not None:
                self._forget_command_buffers()
            held = self._arrays.pop(name, None)
            latest = self._latest.pop(name, None)
            del held, latest  # frees the old buffer before the new one is allocated, as memory may not suffice for both
            held = self._arrays[name] = allocate(self._device, (elements,), kind, max(elements, spare))
        if self._poison is not None and not kept:
            _fill_bytes(self._device, held.buffer, self._poison, elements * kind.itemsize)
        array = DeviceArray(self._device, held.buffer, shape, kind)
        self._latest[name] = array, dtype
        return array

    def clear(self) -> None:
        """Release every buffer, and drop all command buffers."""
        self._arrays.clear()
        self._latest.clear()
        self._forget_command_buffers()

    def _forget_command_buffers(self) -> None:
        """Drop all command buffers. A command buffer that is being recorded will be dropped when it is complete."""
        self._command_buffers.clear()
        self._renewed += 1
