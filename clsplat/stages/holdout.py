# SPDX-License-Identifier: Apache-2.0
"""Launches holdout.cl: a frame without the parts that surfaces of CG elements hide (docs/pictures.md)."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np

from clsplat.config.pictures import HOLDOUT_SURFACE_FIELDS
from clsplat.device.buffers import DeviceArray, upload
from clsplat.device.context import Device
from clsplat.device.profile import stage
from clsplat.images.holdouts import Surfaces
from clsplat.layouts.columns import TILE
from clsplat.stages.blend import Blended, ImageInputs, launch_tiles
from clsplat.stages.device_camera import padded_size
from clsplat.stages.ranges import TileLists

HELD_PIXEL_BYTES = 4 + 4 * len(HOLDOUT_SURFACE_FIELDS)
"""Bytes on the device of a pixel with one holdout surface: its entry of `starts`, and the surface."""


@dataclass(frozen=True, eq=False)
class Held:
    """Holdout surfaces on the device.

    starts: (rows * stride + 1) uint32, the index of each padded pixel's first surface, then the number of surfaces.
    surfaces: (S, 4) float32, columns HOLDOUT_SURFACE_FIELDS.
    """

    starts: DeviceArray
    surfaces: DeviceArray

    @property
    def arguments(self) -> tuple[DeviceArray, DeviceArray]:
        """The arrays as arguments of a kernel that leaves out what is behind the surfaces (kernels/shared/held.h)."""
        return self.starts, self.surfaces


def held_bytes(surfaces: Surfaces | None) -> int:
    """Bytes per pixel that the holdout surfaces of an image take on the device; 0 without surfaces."""
    return 0 if surfaces is None else 4 + 4 * len(HOLDOUT_SURFACE_FIELDS) * surfaces.dense


def upload_held(device: Device, surfaces: Surfaces) -> Held:
    """Upload the holdout surfaces of an image, which has at least one."""
    height, width = surfaces.counts.shape
    counts = np.zeros(padded_size(width, height), np.int64)
    counts[:height, :width] = surfaces.counts
    starts = np.concatenate([[0], np.cumsum(counts)]).astype(np.uint32)
    return Held(upload(device, starts), upload(device, surfaces.rows))


@stage("holdout")
def holdout(device: Device, held: Held, lists: TileLists, inputs: ImageInputs, blended: Blended) -> None:
    """Remove the light behind the surfaces from image and transmittance of `blended`, in the tiles of the lists."""
    tiles_x, listed = blended.stops.shape[1] // TILE, (lists.ranges, lists.gaussian_from_sorted)
    planes = (blended.stops, blended.image, blended.transmittance)
    arrays = (*listed, inputs.splats, inputs.background, *planes, *held.arguments)
    rays = (inputs.camera_array,) if device.switched("RAYS") else ()
    launch_tiles(device, "holdout", {}, lists, tiles_x, inputs.height, *arrays, *rays)
