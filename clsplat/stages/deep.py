# SPDX-License-Identifier: Apache-2.0
"""Launches deep.cl: a frame in slices by depth (docs/pictures.md)."""

from __future__ import annotations

from clsplat.device.buffers import DeviceArray, Workspace
from clsplat.device.context import Device
from clsplat.device.layout import DEEP, TILE
from clsplat.device.profile import stage
from clsplat.stages.blend import Blended, launch_tiles
from clsplat.stages.ranges import TileLists

DEEP_FLOATS = len(DEEP)
"""Floats of a pixel and bin."""


@stage("deep")
def deep(
    device: Device,
    work: Workspace,
    bounds: DeviceArray,
    lists: TileLists,
    splats: DeviceArray,
    blended: Blended,
    height: int,
    camera_array: DeviceArray | None = None,
) -> DeviceArray:
    """(bins, DEEP_FLOATS, rows, stride) of the lists' tiles, which `blended` is of too. bounds (bins - 1,): the depths
    at which the next bin begins, with one more of any value; camera_array: for pixels that are rays."""
    plane_rows, stride = blended.stops.shape
    bins = bounds.shape[0]
    planes = work.array("deep", (bins, DEEP_FLOATS, plane_rows, stride))
    arrays = (bounds, lists.ranges, lists.gaussian_from_sorted, splats, blended.stops, planes)
    rays = (camera_array,) if device.switched("RAYS") else ()
    launch_tiles(device, "deep", {}, lists, stride // TILE, height, bins, *arrays, *rays)
    return planes
