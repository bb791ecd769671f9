# SPDX-License-Identifier: Apache-2.0
"""Launches scan.cl: exclusive prefix sums of uint32."""

from __future__ import annotations

import numpy as np

from clsplat.device.buffers import DeviceArray, Workspace
from clsplat.device.context import Device
from clsplat.device.launch import launch_groups

PER_ITEM = 16
"""Elements of a chunk for each item of a group, or a multiple of it."""
MOST_GROUPS = 2048
"""Groups of more than one item that share a scan or sort: each reads what all before it have counted."""


def chunking(device: Device, n: int, items: int = 0) -> tuple[int, int]:
    """(groups, chunk): how many groups share n elements, and how many each has. items: those of a group, if not the
    shape's."""
    items = items or device.shape.items
    if items == 1:
        chunk = max(-(-n // device.shape.chunks), 1024)
    else:
        tile = items * PER_ITEM
        chunk = tile * max(-(-n // (tile * MOST_GROUPS)), 1)
    return max(-(-n // chunk), 1), chunk


def scan(device: Device, work: Workspace, values: DeviceArray, out: DeviceArray, total: DeviceArray) -> None:
    """out[i] = sum of values[:i], total[0] = sum of all; one launch where one group is enough, else two."""
    n = values.shape[0]
    groups, chunk = chunking(device, n)
    sums = work.array("scan_sums", (groups,), np.uint32)
    kernels, items = device.kernels("scan"), device.shape.items
    if groups > 1:
        launch_groups(device, kernels.scan_sums, groups, items, n, chunk, values, sums)
    launch_groups(device, kernels.scan_chunks, groups, items, n, chunk, values, sums, out, total)
