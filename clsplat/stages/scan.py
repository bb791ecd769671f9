# SPDX-License-Identifier: Apache-2.0
"""Launches scan.cl: exclusive prefix sums of uint32."""

from __future__ import annotations

from dataclasses import dataclass
from typing import Any

import numpy as np

from clsplat.device.buffers import DeviceArray, Workspace
from clsplat.device.context import Device
from clsplat.device.launch import launch_groups

CHUNK_ELEMENTS_PER_ITEM = 16
"""A chunk has this many elements per work-item of a group, or a multiple of that."""
MIN_CHUNK_ELEMENTS, MAX_SINGLE_CHUNK_ELEMENTS = 1024, 1 << 14
"""For groups of one item: the fewest elements of a chunk, and the number of elements up to which a single chunk takes
all. A chunk of that size is done before a second launch would begin."""
MAX_SCAN_GROUPS = 2048
"""The most groups (of more than one item each) that share a scan or sort, because each reads the counts of all earlier
groups."""


@dataclass(frozen=True, eq=False)
class Elements:
    """The number of elements that a kernel processes (kernels/shared/count.h).

    The number is `most`. If `counts` is given, the number is counts[place] instead, which must be at most `most`.
    Launches are sized for `most`.
    """

    most: int
    counts: DeviceArray | None = None
    place: int = 0

    @property
    def arguments(self) -> tuple[Any, ...]:
        """The kernel arguments for the number."""
        return (self.most,) if self.counts is None else (self.counts.buffer, self.place)

    @property
    def defines(self) -> dict[str, object]:
        """The defines of kernels that take these arguments."""
        return {} if self.counts is None else {"BY_CAPACITY": True}


def chunking(device: Device, n: int, items: int = 0) -> tuple[int, int]:
    """(groups, chunk): the number of groups that share n elements, and the elements of each.

    items: work-items of a group, if different from the kernel shape.
    """
    items = items or device.shape.items
    if items == 1:
        chunk = max(-(-n // device.shape.chunks), MIN_CHUNK_ELEMENTS) if n > MAX_SINGLE_CHUNK_ELEMENTS else max(n, 1)
    else:
        tile = items * CHUNK_ELEMENTS_PER_ITEM
        chunk = tile * max(-(-n // (tile * MAX_SCAN_GROUPS)), 1)
    return max(-(-n // chunk), 1), chunk


def scan(
    device: Device,
    work: Workspace,
    values: DeviceArray,
    out: DeviceArray,
    total: DeviceArray,
    elements: Elements | None = None,
) -> None:
    """Compute out[i] = sum of values[:i] and total[0] = sum of all, in one launch if one group is enough, else two.

    elements: the number of values that count, if it is not all of them.
    """
    elements = elements or Elements(values.shape[0])
    groups, chunk = chunking(device, elements.most)
    sums = work.array("scan_sums", (groups,), np.uint32)
    kernels, items = device.kernels("scan", elements.defines), device.shape.items
    chunks = (groups, items, *elements.arguments, chunk)
    if groups > 1:
        launch_groups(device, kernels.scan_sums, *chunks, values, sums)
    launch_groups(device, kernels.scan_chunks, *chunks, values, sums, out, total)
