# SPDX-License-Identifier: Apache-2.0
"""Launches deep_merge.cl: the weighted merge of several deep pictures into one (docs/pictures.md)."""

from __future__ import annotations

import numpy as np

from clsplat.device.buffers import DeviceArray, Workspace
from clsplat.device.context import Device
from clsplat.device.launch import launch_items
from clsplat.device.profile import stage
from clsplat.layouts.columns import DEEP_LEVELS
from clsplat.stages.deep import DEEP_FLOATS


def merge_bytes(pictures: int, bins: int) -> int:
    """Return the bytes per pixel of all arrays of `deep_merge`. bins: number of slices of a pixel in each picture."""
    return pictures * (4 + bins * (4 * DEEP_FLOATS + 5)) + 4 * DEEP_FLOATS * bins


@stage("deep_merge")
def deep_merge(device: Device, work: Workspace, pictures: DeviceArray, weights: DeviceArray) -> DeviceArray:
    """Merge P deep pictures into one (bins, DEEP_FLOATS, pixels), an array of the workspace.

    pictures: (P, bins, DEEP_FLOATS, pixels), P at most DEEP_PICTURES.
    weights: (P, pixels), not negative; their sum over the pictures is close to 1 in each pixel.
    """
    count, bins, _, pixels = pictures.shape
    sources = work.array("deep_sources", (count * bins, pixels), np.uint8)
    left = work.array("deep_left", (count * bins, pixels))
    planes = work.array("deep_merged", (bins, DEEP_FLOATS, pixels))
    share = np.float32(1 / (DEEP_LEVELS * bins))
    kernel = device.kernels("deep_merge", {"LANES": 1}).deep_merge
    launch_items(device, kernel, pixels, pixels, count, bins, share, pictures, weights, sources, left, planes)
    return planes
