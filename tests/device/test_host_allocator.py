# SPDX-License-Identifier: Apache-2.0
"""Memory that is handed out again: to whom, when, and how much of it waits."""

from __future__ import annotations

import gc
import threading
from collections.abc import Iterator

import numpy as np
import pytest

from clsplat.device import host_allocator
from clsplat.device.buffers import hosted
from clsplat.device.context import Device
from clsplat.device.host_allocator import HOST_ALIGNMENT_BYTES, MAX_IDLE_BYTES, MIN_RECYCLED_BYTES, host_bytes


@pytest.fixture(autouse=True)
def _none_waits() -> Iterator[None]:
    host_allocator._idle.clear()
    yield
    host_allocator._idle.clear()


@pytest.mark.parametrize(
    "count", [0, 1, 4095, MIN_RECYCLED_BYTES - 1, MIN_RECYCLED_BYTES, MIN_RECYCLED_BYTES + 1, 5 * MIN_RECYCLED_BYTES]
)
def test_sizes_and_beginnings(count: int) -> None:
    memory = host_bytes(count)
    assert (memory.shape, memory.dtype) == ((count,), np.uint8)
    assert memory.flags.writeable
    assert count == 0 or memory.ctypes.data % HOST_ALIGNMENT_BYTES == 0


def test_the_same_memory_once_the_last_array_over_it_is_gone() -> None:
    first = host_bytes(MIN_RECYCLED_BYTES)
    place, part = first.ctypes.data, first[8:16].view(np.float32)
    del first
    second = host_bytes(MIN_RECYCLED_BYTES)
    assert second.ctypes.data != place  # `part` stands on it
    part[:] = 1
    del part
    assert host_bytes(MIN_RECYCLED_BYTES - 7).ctypes.data == place
    assert second.ctypes.data != place


def test_other_sizes_are_other_memory() -> None:
    first = host_bytes(2 * MIN_RECYCLED_BYTES)
    place = first.ctypes.data
    del first
    assert host_bytes(MIN_RECYCLED_BYTES).ctypes.data != place
    assert host_bytes(2 * MIN_RECYCLED_BYTES).ctypes.data == place


def test_no_more_waits_than_the_limit_and_the_oldest_goes() -> None:
    quarter = MAX_IDLE_BYTES // 4 - HOST_ALIGNMENT_BYTES
    held = [host_bytes(quarter) for _ in range(4)] + [host_bytes(2 * quarter)]
    assert not host_allocator._idle
    while held:
        held.pop(0)
    assert sum(map(len, host_allocator._idle)) <= MAX_IDLE_BYTES
    assert len(host_allocator._idle[-1]) > 2 * quarter
    too_large = host_bytes(MAX_IDLE_BYTES + 1)
    del too_large
    assert all(len(raw) <= MAX_IDLE_BYTES for raw in host_allocator._idle)


def test_an_array_that_ends_while_memory_is_looked_for_changes_nothing() -> None:
    """As the collector may end one within any statement: what was found would be in another place then."""
    memory = host_bytes(MIN_RECYCLED_BYTES)
    with host_allocator._lock:
        del memory
    assert not host_allocator._idle
    memory = host_bytes(MIN_RECYCLED_BYTES)
    del memory
    assert len(host_allocator._idle) == 1


def test_memory_that_is_asked_for_while_some_is_looked_for_is_new() -> None:
    """As a finalizer may ask for it within any statement: it does not wait for its own thread."""
    memory = host_bytes(MIN_RECYCLED_BYTES)
    del memory
    with host_allocator._lock:
        assert len(host_bytes(MIN_RECYCLED_BYTES)) == MIN_RECYCLED_BYTES
        assert len(host_allocator._idle) == 1


def test_threads() -> None:
    wrong = []

    def work(value: int) -> None:
        for _ in range(200):
            memory = host_bytes(MIN_RECYCLED_BYTES)
            memory[:] = value
            wrong.extend([value] * int((memory != value).any()))

    threads = [threading.Thread(target=work, args=(value,)) for value in range(4)]
    for thread in threads:
        thread.start()
    for thread in threads:
        thread.join()
    assert not wrong


def test_an_array_of_a_device_keeps_its_memory(device: Device) -> None:
    one = hosted(device, (MIN_RECYCLED_BYTES,))
    one.array.fill(1.0)
    values = one.get()
    del one
    gc.collect()
    others = [hosted(device, (MIN_RECYCLED_BYTES,)) for _ in range(2)]
    for other in others:
        other.array.fill(2.0)
        assert (other.get() == 2).all()
    assert (values == 1).all()
