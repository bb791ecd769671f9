# SPDX-License-Identifier: Apache-2.0
"""Launches sums.cl: sums along the rows of an array, with the same bits on every device."""

from __future__ import annotations

from clsplat.device.buffers import DeviceArray, Workspace
from clsplat.device.context import Device
from clsplat.device.launch import launch_items
from clsplat.device.profile import stage
from clsplat.layouts.columns import SUM_ROWS


def padded(count: int) -> int:
    """Number of columns that `row_sums` needs for `count` numbers: a multiple of SUM_ROWS. The columns after the
    numbers must be zeros."""
    return -(-count // SUM_ROWS) * SUM_ROWS


@stage("sums")
def row_sums(device: Device, work: Workspace, name: str, parts: DeviceArray) -> DeviceArray:
    """Return the sum of each row of `parts` (rows, columns), float32: an array (rows,) of the workspace.

    name: first part of the names of the workspace arrays for the sums.
    The number of columns must be a result of `padded`; without columns the sums are 0.
    """
    rows, columns = parts.shape
    kernel, level = device.kernels("sums").row_sums, 0
    if columns == 0:
        total = work.array(f"{name}_total", (rows,))
        total.fill(0.0)
        return total
    while columns > 1:
        level += 1
        sums = columns // SUM_ROWS
        stride = padded(sums) if sums > 1 else 1
        fewer = work.array(f"{name}_sums_{level}", (rows, stride))
        launch_items(device, kernel, fewer.size, rows, columns, stride, parts, fewer)
        parts, columns = fewer, stride
    return parts.reshaped(rows)
