# SPDX-License-Identifier: Apache-2.0
"""Launches deep.cl: the samples of a deep picture, which are slices of a frame by depth (docs/pictures.md)."""

from __future__ import annotations

import numpy as np

from clsplat.device.buffers import DeviceArray, Workspace
from clsplat.device.context import Device
from clsplat.device.profile import stage
from clsplat.layouts.columns import DEEP_LEVELS, DEEP_SLICE, TILE
from clsplat.stages.blend import Blended, ImageInputs, launch_tiles
from clsplat.stages.ranges import TileLists

DEEP_FLOATS = len(DEEP_SLICE)
"""Number of floats of one slice at a pixel."""


@stage("deep")
def deep(
    device: Device,
    work: Workspace,
    bins: int,
    lists: TileLists,
    inputs: ImageInputs,
    blended: Blended,
) -> DeviceArray:
    """Return the slices of a frame, (bins, DEEP_FLOATS, rows, stride). Only the tiles in `lists` are filled.

    bins: maximum number of slices per pixel.
    blended: the frame, in which the tiles of `lists` must have been blended before.
    """
    plane_rows, stride = blended.stops.shape
    planes = work.array("deep", (bins, DEEP_FLOATS, plane_rows, stride), kept=lists.band.first > 0)
    share = np.float32(1 / (DEEP_LEVELS * bins))
    arrays = (lists.ranges, lists.gaussian_from_sorted, inputs.splats, blended.transmittance, blended.stops, planes)
    rays = (inputs.camera_array,) if device.switched("RAYS") else ()
    launch_tiles(device, "deep", {}, lists, stride // TILE, inputs.height, bins, share, *arrays, *rays)
    return planes
