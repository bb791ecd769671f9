# SPDX-License-Identifier: Apache-2.0
"""Launches scan.cl: exclusive prefix sums of uint32."""

from __future__ import annotations

import numpy as np

from clsplat.device.buffers import DeviceArray, Workspace
from clsplat.device.context import Device
from clsplat.device.launch import launch_groups

_PER_ITEM = 16


def chunking(device: Device, n: int) -> tuple[int, int]:
    """(groups, chunk): how many groups share n elements, and how many each has."""
    shape = device.shape
    chunk = shape.items * _PER_ITEM if shape.items > 1 else max(-(-n // shape.chunks), 1024)
    return max(-(-n // chunk), 1), chunk


def scan(
    device: Device,
    work: Workspace,
    values: DeviceArray,
    out: DeviceArray,
    total: DeviceArray,
    *,
    as_flags: bool = False,
) -> None:
    """out[i] = sum of values[:i], total[0] = sum of all; with `as_flags` each nonzero value counts 1."""
    n = values.shape[0]
    groups, chunk = chunking(device, n)
    sums = work.array("scan_sums", (groups,), np.uint32)
    kernels, items = device.kernels("scan"), device.shape.items
    launch_groups(device, kernels.scan_sums, groups, items, n, chunk, as_flags, values, sums)
    launch_groups(device, kernels.scan_top, 1, items, groups, sums, total)
    launch_groups(device, kernels.scan_chunks, groups, items, n, chunk, as_flags, values, sums, out)
