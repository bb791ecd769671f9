# SPDX-License-Identifier: Apache-2.0
"""Launches scan.cl: exclusive prefix sums of uint32."""

from __future__ import annotations

from dataclasses import dataclass
from typing import Any

import numpy as np

from clsplat.device.buffers import DeviceArray, Workspace
from clsplat.device.context import Device
from clsplat.device.launch import launch_groups

PER_ITEM = 16
"""Elements of a chunk for each item of a group, or a multiple of it."""
LEAST_CHUNK, MOST_ALONE = 1024, 1 << 14
"""Elements of a chunk at least, where a group is one item, and up to how many are one chunk: they are done sooner than
another launch begins."""
MOST_GROUPS = 2048
"""Groups of more than one item that share a scan or sort: each reads what all before it have counted."""


@dataclass(frozen=True, eq=False)
class Elements:
    """The number of elements that a kernel is for (kernels/shared/count.h): `most`, or with `counts` the number at
    `place` there, which is not larger; a launch is for `most`."""

    most: int
    counts: DeviceArray | None = None
    place: int = 0

    @property
    def arguments(self) -> tuple[Any, ...]:
        """The kernel's arguments for it."""
        return (self.most,) if self.counts is None else (self.counts.buffer, self.place)

    @property
    def defines(self) -> dict[str, object]:
        """The defines of kernels that take these arguments."""
        return {} if self.counts is None else {"BY_CAPACITY": True}


def chunking(device: Device, n: int, items: int = 0) -> tuple[int, int]:
    """(groups, chunk): how many groups share n elements, and how many each has. items: those of a group, if not the
    shape's."""
    items = items or device.shape.items
    if items == 1:
        chunk = max(-(-n // device.shape.chunks), LEAST_CHUNK) if n > MOST_ALONE else max(n, 1)
    else:
        tile = items * PER_ITEM
        chunk = tile * max(-(-n // (tile * MOST_GROUPS)), 1)
    return max(-(-n // chunk), 1), chunk


def scan(
    device: Device,
    work: Workspace,
    values: DeviceArray,
    out: DeviceArray,
    total: DeviceArray,
    elements: Elements | None = None,
) -> None:
    """out[i] = sum of values[:i], total[0] = sum of all; one launch where one group is enough, else two. elements: the
    values that count, if not all do."""
    elements = elements or Elements(values.shape[0])
    groups, chunk = chunking(device, elements.most)
    sums = work.array("scan_sums", (groups,), np.uint32)
    kernels, items = device.kernels("scan", **elements.defines), device.shape.items
    chunks = (groups, items, *elements.arguments, chunk)
    if groups > 1:
        launch_groups(device, kernels.scan_sums, *chunks, values, sums)
    launch_groups(device, kernels.scan_chunks, *chunks, values, sums, out, total)
