# SPDX-License-Identifier: Apache-2.0
"""Launches chunk_records.cl: copies of chunks between the host's records and the slots of a pool on the device."""

from __future__ import annotations

from collections.abc import Callable, Mapping
from math import prod
from typing import Any

import numpy as np
from numpy.typing import NDArray

from clsplat.device.buffers import DeviceArray, Hosted, Workspace, hosted
from clsplat.device.context import Device
from clsplat.device.launch import launch_items
from clsplat.device.profile import stage

_VECTOR = 4
"""Number of words of 4 bytes that a work-item of copy_chunks copies."""


@stage("chunk_records")
def copy_chunks(
    device: Device,
    slots: DeviceArray,
    crossing: DeviceArray,
    record: np.dtype[Any],
    arrays: Mapping[str, DeviceArray],
    caught: DeviceArray | None = None,
    *,
    to_records: bool,
) -> None:
    """Copy chunks between records and the pool's arrays, field by field.

    slots: (k,) uint32, the pool's slot of each record.
    crossing: (k * (words of a record + 1),) uint32, the records, and then the value of `caught` of each chunk.
    record: type of a record (`chunks.store.record_type`).
    arrays: the pool's arrays by field, (slots x CHUNK_ROWS, ...) float32.
    caught: (slots,) uint32, the last step up to which the chunk in each slot has been caught up (`stages.catch_up`);
        None if `crossing` has records alone.
    to_records: True to copy from the arrays to the records, False to copy from the records to the arrays.
    """
    kernels = device.kernels("chunk_records", {"TO_RECORDS": True} if to_records else {})
    entries, words = slots.shape[0], record.itemsize // 4
    for name in record.names or ():
        kind, offset = record.fields[name][:2]  # type: ignore[index]  # it has fields
        block = prod(kind.shape)
        items = entries * block // _VECTOR
        of = map(np.uint64, (items, words, offset // 4, block))
        launch_items(device, kernels.copy_chunks, items, *of, slots, crossing, arrays[name])
    if caught is not None:
        at = np.uint64(entries * words)
        launch_items(device, kernels.copy_caught, entries, np.uint32(entries), at, slots, crossing, caught)


class RecordCopies:
    """Copies of records between host memory and the slots of a pool.

    They are on a second queue beside the device's own, unless the device shares the host's memory: its cores are then
    busy with the device's own queue.

    most: maximum number of records of a copy.
    """

    def __init__(self, device: Device, most: int) -> None:
        self._device, self._most = device, most
        self._second = device if device.shares_memory else device.beside()
        self._work = Workspace(self._second)
        self._crossing: Hosted | None = None
        """Memory for a copy, on the device and on the host. It is allocated at the first copy."""
        self._reads = False
        """True if the device may still read the host's memory for a copy."""
        self._ending: Any = None
        """Event after the latest copies, for which the device's own queue does not wait yet; None if there is none."""

    @property
    def overlaps(self) -> bool:
        """True if copies do not wait for the commands on the device's own queue."""
        return self._second is not self._device

    def begin(self, mark: Any) -> None:
        """Let the next copies wait for an event of the device's own queue (`Device.mark`)."""
        self._second.follow(mark)

    def end(self) -> None:
        """Let the next `join` wait for the copies so far."""
        self._ending = self._second.mark()

    def join(self) -> None:
        """Let later commands on the device's own queue wait for the copies up to the last `end`."""
        if self._ending is not None:
            self._device.follow(self._ending)
            self._ending = None

    def free(self) -> None:
        """Wait for all copies, and free their memory on the device and on the host."""
        self._second.finish()
        self._work.clear()
        self._crossing, self._reads = None, False

    def to_slots(
        self,
        record: np.dtype[Any],
        slots: NDArray[np.uint32],
        read: Callable[[NDArray[Any]], None],
        caught: NDArray[np.uint32],
        arrays: Mapping[str, DeviceArray],
        of_slots: DeviceArray,
    ) -> None:
        """Copy k records to slots of the pool. Does not wait for the copies.

        record: type of a record (`chunks.store.record_type`).
        slots: (k,), the slot of each record.
        read: function that fills the records (k,).
        caught: (k,), the step up to which each chunk has been caught up.
        arrays: the pool's arrays by field.
        of_slots: (slots,) uint32, this step for all slots of the pool.
        """
        crossing, host, records = self._memory(record, len(slots))
        read(records)
        host[-len(slots) :] = caught
        if not self._device.shares_memory:
            crossing.send(host)
        copy_chunks(self._second, self._sent(slots), crossing, record, arrays, of_slots, to_records=False)
        self._reads = True

    def from_slots(
        self,
        record: np.dtype[Any],
        slots: NDArray[np.uint32],
        arrays: Mapping[str, DeviceArray],
        of_slots: DeviceArray,
    ) -> tuple[NDArray[Any], NDArray[np.uint32]]:
        """Copy slots (k,) of the pool to records, and wait for the copies.

        record, arrays, of_slots: as for `to_slots`.
        Returns the records (k,), and the step up to which each chunk has been caught up (k,). Both are valid until the
        next copy.
        """
        crossing, host, records = self._memory(record, len(slots))
        copy_chunks(self._second, self._sent(slots), crossing, record, arrays, of_slots, to_records=True)
        if self._device.shares_memory:
            self._second.finish()
        else:
            crossing.read_into(host)
        return records, host[-len(slots) :]

    def _memory(self, record: np.dtype[Any], count: int) -> tuple[DeviceArray, NDArray[np.uint32], NDArray[Any]]:
        """Return an array for `count` records and as many steps on the device and on the host, and the records in the
        host's array. Waits until the device does not read them any more."""
        words = record.itemsize // 4
        if self._crossing is None:
            self._crossing = hosted(self._second, (self._most * (words + 1),), np.uint32, in_pinned_memory=True)
        if self._reads:
            self._second.finish()
            self._reads = False
        host = self._crossing.host[: count * (words + 1)]
        return self._crossing.array.reshaped(len(host)), host, host[: count * words].view(record)

    def _sent(self, slots: NDArray[np.uint32]) -> DeviceArray:
        """Send the numbers of slots to the device."""
        on_device = self._work.array("crossing_slots", slots.shape, np.uint32)
        on_device.send(slots)
        return on_device
