# SPDX-License-Identifier: Apache-2.0
"""Launches bounds.cl: bounding boxes and greatest scales of a model's chunks."""

from __future__ import annotations

from clsplat.arrays import Float32
from clsplat.device.buffers import Workspace
from clsplat.device.context import Device
from clsplat.device.launch import DEFAULT_GROUP_ITEMS, launch_groups
from clsplat.device.profile import stage
from clsplat.stages.chunk_lists import ChunkList
from clsplat.stages.device_gaussians import DeviceGaussians

BOUNDS_FLOATS = 7
"""Number of floats in a chunk's bounds: least and greatest coordinates of the means, and the greatest log scale."""


@stage("bounds")
def bounds(device: Device, work: Workspace, gaussians: DeviceGaussians, chunks: ChunkList) -> Float32:
    """Return the bounds of the chunks in a list, (entries, BOUNDS_FLOATS). Waits for the device.

    An entry NO_CHUNK has empty bounds: from infinity to -infinity.
    """
    count = chunks.numbers.shape[0]
    items = 1 if device.shape.lanes > 1 or device.max_group < DEFAULT_GROUP_ITEMS else DEFAULT_GROUP_ITEMS
    found = work.array("chunk_bounds", (count, BOUNDS_FLOATS))
    kernel = device.kernels("bounds", {"ITEMS": items}).bounds
    launch_groups(device, kernel, count, items, *chunks.arguments, gaussians["means"], gaussians["log_scales"], found)
    return found.get()
