# SPDX-License-Identifier: Apache-2.0
"""Arrays that go up ahead of the work on them: their contents, what stays, and what does not fit."""

from __future__ import annotations

import numpy as np
import pyopencl as cl

from clsplat.device.buffers import DeviceArray, allocate
from clsplat.device.context import Device
from clsplat.device.upload_ring import UPLOAD_RING_SLOTS, UploadRing


def pattern(number: int, shape: tuple[int, ...] = (40, 30, 3)) -> np.ndarray:
    return np.random.default_rng(number).integers(0, 256, shape, np.uint8)


def test_what_was_sent_is_there(device: Device) -> None:
    uploads = UploadRing(device, pattern(0).nbytes)
    for number in range(4 * UPLOAD_RING_SLOTS):
        uploads.begin(number, pattern(number))
        array = uploads.take(number)
        assert array is not None
        np.testing.assert_array_equal(array.get(), pattern(number))
    assert uploads.take(0) is None


def test_what_was_taken_stays_for_two_more(device: Device) -> None:
    """So that the work that is under way and that behind it can be made again, whichever slot they have: here the first
    is taken when it was sent long ago."""
    uploads = UploadRing(device, pattern(0).nbytes)
    for number in range(UPLOAD_RING_SLOTS):
        uploads.begin(number, pattern(number))
    first = uploads.take(0)
    assert first is not None
    for number in (10, 11):
        uploads.begin(number, pattern(number))
        assert uploads.take(number) is not None
    np.testing.assert_array_equal(first.get(), pattern(0))


def test_the_device_reads_before_it_is_overwritten(device: Device) -> None:
    """Copies on the queue of what is launched, each of what was sent for it, while the next ones go up."""
    uploads, copies = UploadRing(device, pattern(0).nbytes), []
    for number in range(20):
        array = uploads.take(number)
        if array is None:
            uploads.begin(number, pattern(number))
            array = uploads.take(number)
        assert array is not None
        copies.append(copied(device, array))
        uploads.begin(number + 1, pattern(number + 1))
    for number, copy in enumerate(copies):
        np.testing.assert_array_equal(copy.get(), pattern(number))


def copied(device: Device, array: DeviceArray) -> DeviceArray:
    copy = allocate(device, array.shape, array.dtype)
    cl.enqueue_copy(device.queue, copy.buffer, array.buffer, byte_count=array.nbytes)
    return copy


def test_other_sizes_and_kinds(device: Device) -> None:
    uploads = UploadRing(device, 4 * 40 * 30)
    floats = np.linspace(0, 1, 40 * 30, dtype=np.float32).reshape(40, 30)
    uploads.begin("floats", floats)
    uploads.begin("small", pattern(1, (7, 5, 4)))
    uploads.begin("large", pattern(2, (41, 30, 4)))
    for key, wanted in (("floats", floats), ("small", pattern(1, (7, 5, 4)))):
        array = uploads.take(key)
        assert array is not None
        np.testing.assert_array_equal(array.get(), wanted)
    assert uploads.take("large") is None
