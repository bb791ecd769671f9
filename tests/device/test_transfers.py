# SPDX-License-Identifier: Apache-2.0
"""Copies that the host does not wait for, memory that host and device share, and the counts of both."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
import pytest
from calls import refuses
from numpy.typing import NDArray

from clsplat.device.buffers import DeviceArray, Workspace, allocate, shared, upload
from clsplat.device.context import Device
from clsplat.device.profile import Calls
from clsplat.stages.sort import radix_sort

MANY = 1 << 20


def busy(device: Device) -> DeviceArray:
    """The result of work that is still going on, on a device that runs beside the host."""
    rng = np.random.default_rng(0)
    keys = upload(device, rng.integers(0, 2**32, 1 << 17, dtype=np.uint32))
    for _ in range(3):
        keys, _ = radix_sort(device, Workspace(device), "busy", keys, 32)
    return keys


def test_a_copy_that_nothing_waits_for_keeps_its_array(device: Device) -> None:
    arrays, base = [allocate(device, (MANY,), np.float32) for _ in range(4)], busy(device)
    before = replace(device.calls)
    for number, array in enumerate(arrays):
        array.send(np.full(MANY, number, np.float32))  # which goes out of sight here
        np.full(MANY, -1.0, np.float32)  # and its memory would be another's
    assert device.calls.since(before) == Calls(writes=4)
    assert len(device.under_way) >= 4
    for number, array in enumerate(arrays):
        assert (array.get() == number).all()
    assert not device.under_way, "the queue is in order"
    assert (np.diff(base.get().astype(np.int64)) >= 0).all()


def test_what_is_sent_has_to_fit(default_device: Device) -> None:
    array = allocate(default_device, (4, 2), np.float32)
    for values in (np.zeros((2, 4), np.float32), np.zeros((4, 2))):
        refuses("expected float32", array.send, values, error=ValueError)


def test_a_read_waits_for_what_was_before_it(device: Device) -> None:
    array = upload(device, np.arange(1000, dtype=np.float32))
    before = replace(device.calls)
    finish = array.begin_get()
    array.fill(0.0)
    base = busy(device)
    np.testing.assert_array_equal(finish(), np.arange(1000))
    assert (array.get() == 0).all()
    calls = device.calls.since(before)
    assert (calls.reads, calls.blocking_reads, calls.blocking_writes) == (1, 1, 1)
    assert calls.fills >= 1
    assert base.shape == (1 << 17,)


@pytest.mark.parametrize("values", [np.arange(77, dtype=np.uint8), np.arange(12, dtype=np.float32).reshape(3, 4)])
def test_memory_that_is_shared(device: Device, values: NDArray[np.generic]) -> None:
    used = device.memory.used
    array = shared(device, values)
    assert device.memory.used == used, "it is the host's"
    np.testing.assert_array_equal(array.get(), values)
