# SPDX-License-Identifier: Apache-2.0
"""Launches holdout.cl: a frame behind the surfaces of other elements (docs/pictures.md)."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np

from clsplat.config.holdout import HELD
from clsplat.device.buffers import DeviceArray, upload
from clsplat.device.context import Device
from clsplat.device.layout import TILE
from clsplat.device.profile import stage
from clsplat.images.holdouts import Surfaces
from clsplat.stages.blend import Blended, launch_tiles
from clsplat.stages.device_camera import padded_size
from clsplat.stages.ranges import TileLists

HELD_BYTES = 4 + 4 * len(HELD)
"""Bytes of each pixel with one surface."""


@dataclass(frozen=True, eq=False)
class Held:
    """Surfaces on the device: starts (rows * stride + 1) uint32 of each pixel of a padded plane, the end behind it;
    surfaces (S, 4) float32."""

    starts: DeviceArray
    surfaces: DeviceArray

    @property
    def arguments(self) -> tuple[DeviceArray, DeviceArray]:
        """The arguments of a kernel that holds out."""
        return self.starts, self.surfaces


def held_bytes(surfaces: Surfaces | None) -> int:
    """Bytes of each pixel of a picture for its surfaces."""
    return 0 if surfaces is None else 4 + 4 * len(HELD) * surfaces.dense


def upload_held(device: Device, surfaces: Surfaces) -> Held:
    """The surfaces of a picture, which has one at least, on the device."""
    height, width = surfaces.counts.shape
    counts = np.zeros(padded_size(width, height), np.int64)
    counts[:height, :width] = surfaces.counts
    starts = np.concatenate([[0], np.cumsum(counts)]).astype(np.uint32)
    return Held(upload(device, starts), upload(device, surfaces.rows))


@stage("holdout")
def holdout(
    device: Device,
    held: Held,
    lists: TileLists,
    splats: DeviceArray,
    background: DeviceArray,
    blended: Blended,
    height: int,
    camera_array: DeviceArray | None = None,
) -> None:
    """Write image and transmittance of `blended`, which is of the lists' tiles, anew, held out. camera_array: for
    pixels that are rays."""
    arrays = (lists.ranges, lists.gaussian_from_sorted, splats, background, blended.stops, blended.image)
    rays = (camera_array,) if device.switched("RAYS") else ()
    tiles_x = blended.stops.shape[1] // TILE
    launch_tiles(device, "holdout", {}, lists, tiles_x, height, *arrays, blended.transmittance, *held.arguments, *rays)
