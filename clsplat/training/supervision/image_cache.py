# SPDX-License-Identifier: Apache-2.0
"""Photographs on the device: kept there as far as memory allows, otherwise uploaded step by step.

Main memory: `host_photographs.py`. The cache on the disk: `decoded_store.py`.
"""

from __future__ import annotations

from typing import Any

import numpy as np
from numpy.typing import NDArray

from clsplat.device.buffers import DeviceArray, allocate, shared
from clsplat.device.context import Device
from clsplat.device.upload_ring import UPLOAD_RING_SLOTS, UploadRing
from clsplat.errors import CapacityError
from clsplat.training.supervision.decoding import PhotographError
from clsplat.training.supervision.host_photographs import HostPhotographs


def kept_pixels(image: NDArray[Any]) -> int | None:
    """Number of pixels that a photograph's mask, its fifth channel, keeps; None without a mask."""
    return int(np.count_nonzero(image[:, :, 4])) if image.shape[2] == 5 else None


class ImageCache:
    """Photographs of the training views at one resolution, on the device as far as its memory allows.

    host: the photographs in main memory, which the caches of several devices share.
    allowed: maximum number of bytes on the device. `host` limits main memory.
    """

    def __init__(self, device: Device, host: HostPhotographs) -> None:
        self._device, self.host = device, host
        self._factor = 0.0
        self._on_device: dict[int, DeviceArray] = {}
        self._kept: dict[tuple[int, float], int | None] = {}
        self._taken = self.allowed = 0
        self._uploads: UploadRing | None = None

    def follow(self, allowed: int) -> None:
        """Set the maximum number of bytes on the device. If the photographs there have more, free them all."""
        self.allowed = allowed
        if self._taken > allowed:
            self._leave_device()

    def load(self, index: int, factor: float) -> NDArray[Any]:
        """Photograph of view `index` at 1/factor of its size, on the host; do not write to it.

        It is (H, W, 3), or has a fourth channel of straight alpha, and with a mask a fifth. The mask is 0 for pixels
        that the loss leaves out. Raises PhotographError.
        """
        self._enter(factor)
        return self.host.get(index, factor)

    def kept(self, index: int, factor: float) -> int | None:
        """Number of pixels that the mask of view `index` keeps at 1/factor of its size; None without a mask."""
        key = index, factor
        if key not in self._kept:
            self._kept[key] = kept_pixels(self.load(index, factor))
        return self._kept[key]

    def bring(self, index: int, factor: float) -> NDArray[Any] | DeviceArray:
        """Return the photograph of view `index`: a device array if the device has memory for it, else the host's array.

        A photograph is uploaded once and stays, unless `ahead` has already sent it to the upload ring. A device that
        shares main memory reads the host's array.
        """
        self._enter(factor)
        if index in self._on_device:
            return self._on_device[index]
        image = self.load(index, factor)
        if self._device.shares_memory:
            array = shared(self._device, image)
            if not self.host.bounded:  # else `host` may evict the image to free its memory
                self._on_device[index] = array
            return array
        if self._uploads is not None and (sent := self._uploads.take((index, factor))) is not None:
            return sent
        if self._taken + image.nbytes > self.allowed:
            return image
        try:
            array = allocate(self._device, image.shape, image.dtype)
        except CapacityError:  # another program has taken memory that the plan counted on
            self.allowed = self._taken
            return image
        array.send(image)
        self._on_device[index] = array
        self._taken += image.nbytes
        return array

    def ahead(self, index: int, factor: float) -> None:
        """Begin to upload the photograph for the next `bring`, if the device has no memory to keep it (`UploadRing`).

        Call it after launching a step: the upload then runs while the device computes.
        """
        if self._device.shares_memory or (index in self._on_device and factor == self._factor):
            return
        try:
            image = self.load(index, factor)
        except PhotographError:  # `bring` raises the error again, before the step that needs the photograph
            return
        if self._taken + image.nbytes <= self.allowed:
            return
        if self._uploads is None and UPLOAD_RING_SLOTS * image.nbytes <= self.allowed:
            while self._taken + UPLOAD_RING_SLOTS * image.nbytes > self.allowed:  # free the images uploaded last
                self._taken -= self._on_device.popitem()[1].nbytes
            try:
                self._uploads = UploadRing(self._device, image.nbytes)
            except CapacityError:
                self.allowed = self._taken
                return
            self._taken += self._uploads.taken
        if self._uploads is not None:
            self._uploads.begin((index, factor), image)

    def _enter(self, factor: float) -> None:
        """Free the device's images if the size changes."""
        if factor != self._factor:
            self._factor = factor
            self._leave_device()

    def _leave_device(self) -> None:
        self._on_device.clear()
        self._uploads, self._taken = None, 0
