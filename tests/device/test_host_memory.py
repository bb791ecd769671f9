# SPDX-License-Identifier: Apache-2.0
"""Memory that is handed out again: to whom, when, and how much of it waits."""

from __future__ import annotations

import gc
import threading
from collections.abc import Iterator

import numpy as np
import pytest

from clsplat.device import host_memory
from clsplat.device.buffers import hosted
from clsplat.device.context import Device
from clsplat.device.host_memory import ALIGNED, LEAST, MOST, host_bytes


@pytest.fixture(autouse=True)
def _none_waits() -> Iterator[None]:
    host_memory._idle.clear()
    yield
    host_memory._idle.clear()


@pytest.mark.parametrize("count", [0, 1, 4095, LEAST - 1, LEAST, LEAST + 1, 5 * LEAST])
def test_sizes_and_beginnings(count: int) -> None:
    memory = host_bytes(count)
    assert (memory.shape, memory.dtype) == ((count,), np.uint8)
    assert memory.flags.writeable
    assert count == 0 or memory.ctypes.data % ALIGNED == 0


def test_the_same_memory_once_the_last_array_over_it_is_gone() -> None:
    first = host_bytes(LEAST)
    place, part = first.ctypes.data, first[8:16].view(np.float32)
    del first
    second = host_bytes(LEAST)
    assert second.ctypes.data != place  # `part` stands on it
    part[:] = 1
    del part
    assert host_bytes(LEAST - 7).ctypes.data == place
    assert second.ctypes.data != place


def test_other_sizes_are_other_memory() -> None:
    first = host_bytes(2 * LEAST)
    place = first.ctypes.data
    del first
    assert host_bytes(LEAST).ctypes.data != place
    assert host_bytes(2 * LEAST).ctypes.data == place


def test_no_more_waits_than_the_limit_and_the_oldest_goes() -> None:
    quarter = MOST // 4 - ALIGNED
    held = [host_bytes(quarter) for _ in range(4)] + [host_bytes(2 * quarter)]
    assert not host_memory._idle
    while held:
        held.pop(0)
    assert sum(map(len, host_memory._idle)) <= MOST
    assert len(host_memory._idle[-1]) > 2 * quarter
    too_large = host_bytes(MOST + 1)
    del too_large
    assert all(len(raw) <= MOST for raw in host_memory._idle)


def test_an_array_that_ends_while_memory_is_looked_for_changes_nothing() -> None:
    """As the collector may end one within any statement: what was found would be in another place then."""
    memory = host_bytes(LEAST)
    with host_memory._lock:
        del memory
    assert not host_memory._idle
    memory = host_bytes(LEAST)
    del memory
    assert len(host_memory._idle) == 1


def test_memory_that_is_asked_for_while_some_is_looked_for_is_new() -> None:
    """As a finalizer may ask for it within any statement: it does not wait for its own thread."""
    memory = host_bytes(LEAST)
    del memory
    with host_memory._lock:
        assert len(host_bytes(LEAST)) == LEAST
        assert len(host_memory._idle) == 1


def test_threads() -> None:
    wrong = []

    def work(value: int) -> None:
        for _ in range(200):
            memory = host_bytes(LEAST)
            memory[:] = value
            wrong.extend([value] * int((memory != value).any()))

    threads = [threading.Thread(target=work, args=(value,)) for value in range(4)]
    for thread in threads:
        thread.start()
    for thread in threads:
        thread.join()
    assert not wrong


def test_an_array_of_a_device_keeps_its_memory(device: Device) -> None:
    one = hosted(device, (LEAST,))
    one.array.fill(1.0)
    values = one.get()
    del one
    gc.collect()
    others = [hosted(device, (LEAST,)) for _ in range(2)]
    for other in others:
        other.array.fill(2.0)
        assert (other.get() == 2).all()
    assert (values == 1).all()
