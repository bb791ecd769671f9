# SPDX-License-Identifier: Apache-2.0
"""Launches deep.cl: a frame in slices by depth (docs/pictures.md)."""

from __future__ import annotations

import numpy as np

from clsplat.device.buffers import DeviceArray, Workspace
from clsplat.device.context import Device
from clsplat.device.layout import DEEP, DEEP_LEVELS, TILE
from clsplat.device.profile import stage
from clsplat.stages.blend import Blended, launch_tiles
from clsplat.stages.ranges import TileLists

DEEP_FLOATS = len(DEEP)
"""Floats of a pixel and slice."""


@stage("deep")
def deep(
    device: Device,
    work: Workspace,
    bins: int,
    lists: TileLists,
    splats: DeviceArray,
    blended: Blended,
    height: int,
    camera_array: DeviceArray | None = None,
) -> DeviceArray:
    """(bins, DEEP_FLOATS, rows, stride) of the lists' tiles, which `blended` is of too. bins: the most slices that a
    pixel has; camera_array: for pixels that are rays."""
    plane_rows, stride = blended.stops.shape
    planes = work.array("deep", (bins, DEEP_FLOATS, plane_rows, stride), kept=lists.band.first > 0)
    share = np.float32(1 / (DEEP_LEVELS * bins))
    arrays = (lists.ranges, lists.gaussian_from_sorted, splats, blended.transmittance, blended.stops, planes)
    rays = (camera_array,) if device.switched("RAYS") else ()
    launch_tiles(device, "deep", {}, lists, stride // TILE, height, bins, share, *arrays, *rays)
    return planes
