# SPDX-License-Identifier: Apache-2.0
"""The training views' pixels, on the host and on the device."""

from __future__ import annotations

from typing import TYPE_CHECKING, Any

import numpy as np
from numpy.typing import NDArray

from clsplat.device.buffers import DeviceArray, allocate, shared
from clsplat.device.context import Device
from clsplat.device.uploads import SLOTS, Uploads
from clsplat.errors import CapacityError

if TYPE_CHECKING:
    from clsplat.scenes.scene import View


def kept_pixels(image: NDArray[Any]) -> int | None:
    """Pixels of a photograph that its mask, a fifth channel, leaves; None where it has none."""
    return int(np.count_nonzero(image[:, :, 4])) if image.shape[2] == 5 else None


class Photographs:
    """The training views' pixels at one resolution, decoded once each; uint8 where that holds them exactly.

    allowed: bytes that they may take on the device.
    """

    def __init__(self, views: list[View], device: Device) -> None:
        self._views, self._device = views, device
        self._factor = 0.0
        self._held: dict[tuple[int, float], NDArray[Any]] = {}
        self._on_device: dict[int, DeviceArray] = {}
        self._kept: dict[tuple[int, float], int | None] = {}
        self._taken = self.allowed = 0
        self._uploads: Uploads | None = None

    def for_device(self, device: Device) -> Photographs:
        """The same for another device, with the same pixels on the host."""
        other = Photographs(self._views, device)
        other._held = self._held
        return other

    def follow(self, allowed: int) -> None:
        """Take at most so many bytes on the device from here on."""
        self.allowed = allowed
        if self._taken > allowed:
            self._leave_device()

    def load(self, index: int, factor: float) -> NDArray[Any]:
        """View `index` at 1/factor of its size, (H, W, 3 or 4), straight alpha, or 5 with its mask, 0 where a pixel
        does not count; not to be written to."""
        if factor != self._factor:
            self._factor = factor
            for key in [key for key in self._held if key[1] != factor]:
                del self._held[key]
            self._leave_device()
        if (index, factor) not in self._held:
            camera = self._views[index].camera
            image: NDArray[np.float32] = self._views[index].load_masked(
                max(int(camera.width / factor), 1), max(int(camera.height / factor), 1)
            )
            levels = np.rint(image * 255)
            exact = (
                np.array_equal(levels * np.float32(1 / 255), image)  # as target.cl has it
                and 0 <= levels.min() <= levels.max() <= 255
            )
            self._held[index, factor] = levels.astype(np.uint8) if exact else np.ascontiguousarray(image, np.float32)
        return self._held[index, factor]

    def kept(self, index: int, factor: float) -> int | None:
        """Pixels of the same that count; None where there is no mask."""
        if (index, factor) not in self._kept:
            self._kept[index, factor] = kept_pixels(self.load(index, factor))
        return self._kept[index, factor]

    def bring(self, index: int, factor: float) -> NDArray[Any] | DeviceArray:
        """The same, on the device where there is room for it: it goes up once, and stays, or it has been sent `ahead`.
        A device that shares the host's memory reads it there."""
        image = self.load(index, factor)
        if index not in self._on_device:
            if self._device.shares_memory:
                self._on_device[index] = shared(self._device, image)
            elif self._uploads is not None and (sent := self._uploads.take((index, factor))) is not None:
                return sent
            elif self._taken + image.nbytes <= self.allowed:
                try:
                    array = allocate(self._device, image.shape, image.dtype)
                except CapacityError:  # another program may have taken what the plan counted on
                    self.allowed = self._taken
                    return image
                array.send(image)
                self._on_device[index] = array
                self._taken += image.nbytes
        return self._on_device.get(index, image)

    def ahead(self, index: int, factor: float) -> None:
        """Send the same to the device while that is at work, where there is no room to keep it: for the next `bring`
        of it. Called when a step has been launched."""
        if self._device.shares_memory or index in self._on_device:
            return
        image = self.load(index, factor)
        if self._taken + image.nbytes <= self.allowed:
            return
        if self._uploads is None and SLOTS * image.nbytes <= self.allowed:
            while self._taken + SLOTS * image.nbytes > self.allowed:  # for those that went up last
                self._taken -= self._on_device.popitem()[1].nbytes
            try:
                self._uploads = Uploads(self._device, image.nbytes)
            except CapacityError:
                self.allowed = self._taken
                return
            self._taken += self._uploads.taken
        if self._uploads is not None:
            self._uploads.begin((index, factor), image)

    def _leave_device(self) -> None:
        self._on_device.clear()
        self._uploads, self._taken = None, 0
