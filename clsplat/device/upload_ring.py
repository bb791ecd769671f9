# SPDX-License-Identifier: Apache-2.0
"""Uploads from pinned memory on a second queue, while the device works on earlier arrays."""

from __future__ import annotations

from dataclasses import dataclass
from typing import Any

import numpy as np
import pyopencl as cl
from numpy.typing import NDArray

from clsplat.device.buffers import DeviceArray, allocate, pinned
from clsplat.device.context import Device

UPLOAD_RING_SLOTS = 3
"""Number of slots of a ring: one each for the array in use, the array that is used next, and the array that is being
uploaded."""


@dataclass(eq=False)
class _Slot:
    """Memory for an array on the device, and pinned memory of the same size on the host.

    key: the caller's key of the uploaded array (`UploadRing.begin`).
    held: the uploaded array, in the memory of `array`.
    arrived: event of the copy to the device.
    used: event after the last launch that uses the uploaded array; None until this event is on the queue.
    """

    array: DeviceArray
    host: NDArray[np.uint8]
    key: object = None
    held: DeviceArray | None = None
    arrived: cl.Event | None = None
    used: cl.Event | None = None


class UploadRing:
    """Device memory for UPLOAD_RING_SLOTS arrays of at most `nbytes` bytes each, which are uploaded before kernels need
    them. A new array replaces the least recently used one. Raises CapacityError if there is not enough memory."""

    def __init__(self, device: Device, nbytes: int) -> None:
        self._device, self._second, self.nbytes = device, device.beside(), nbytes
        arrays = [allocate(device, (nbytes,), np.uint8) for _ in range(UPLOAD_RING_SLOTS)]
        hosts = [pinned(device, (nbytes,), np.uint8) for _ in range(UPLOAD_RING_SLOTS)]
        self._slots = [_Slot(*pair) for pair in zip(arrays, hosts, strict=True)]
        """The slots, in order of their last use; the least recently used is first."""

    def begin(self, key: object, values: NDArray[Any]) -> None:
        """Start to upload the host array `values`. `take` with the same key returns the copy on the device.

        Does nothing if the array is larger than a slot, or an array with this key is in the ring.
        """
        if values.nbytes > self.nbytes or any(slot.key == key for slot in self._slots):
            return
        done = self._device.mark()
        for slot in self._slots:
            if slot.held is not None and slot.used is None:
                slot.used = done
        slot = self._slots[0]
        self._touch(slot)
        if slot.arrived is not None:
            slot.arrived.wait()  # the earlier upload from this pinned memory may not be complete
        host = slot.host[: values.nbytes].view(values.dtype).reshape(values.shape)
        host[...] = values
        slot.held, slot.key = DeviceArray(self._device, slot.array.buffer, values.shape, values.dtype), key
        before = None if slot.used is None else [slot.used]
        queue = self._second.queue
        slot.arrived = cl.enqueue_copy(queue, slot.array.buffer, host, is_blocking=False, wait_for=before)
        slot.used = None
        queue.flush()
        self._device.calls.writes += 1

    def take(self, key: object) -> DeviceArray | None:
        """Return the uploaded array with this key, for later launches; None if it is not in the ring.

        The array is valid until UPLOAD_RING_SLOTS - 1 other arrays have been uploaded or taken.
        """
        for slot in self._slots:
            if slot.key == key and slot.arrived is not None:
                self._device.follow(slot.arrived)
                slot.used = None
                self._touch(slot)
                return slot.held
        return None

    def _touch(self, slot: _Slot) -> None:
        self._slots.remove(slot)
        self._slots.append(slot)

    @property
    def taken(self) -> int:
        """Bytes of device memory that the ring's arrays take."""
        return UPLOAD_RING_SLOTS * self.nbytes
