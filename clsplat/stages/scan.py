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
"""In groups of several items, the number of elements of a chunk per work-item is this number or a multiple of it."""
MIN_CHUNK_ELEMENTS, MAX_SINGLE_CHUNK_ELEMENTS = 1024, 1 << 14
"""For groups of one item: minimum elements of a chunk, and maximum elements that are scanned as a single chunk. Several
chunks need a second launch, which with fewer elements takes longer than the chunks save."""
MAX_SCAN_GROUPS = 2048
"""Maximum number of groups in a scan or sort, for groups of several items. More would cost too much, because each group
reads the counts of all groups before it."""


@dataclass(frozen=True, eq=False)
class Elements:
    """The number of elements that a kernel processes: `most`, or counts[place] if `counts` is given.

    most: number of elements for which launches are sized, at least counts[place].
    counts: array on the device from which the kernel reads the number (kernels/shared/count.h).
    place: index of the number in `counts`.
    """

    most: int
    counts: DeviceArray | None = None
    place: int = 0

    @property
    def arguments(self) -> tuple[Any, ...]:
        """The kernel arguments that give the number of elements."""
        return (self.most,) if self.counts is None else (self.counts.buffer, self.place)

    @property
    def defines(self) -> dict[str, object]:
        """Macros for the build of a kernel that gets its number of elements by `arguments`."""
        return {} if self.counts is None else {"BY_CAPACITY": True}


def chunking(device: Device, n: int, items: int = 0) -> tuple[int, int]:
    """Return the number of groups that share n elements, and the number of elements in each group's chunk.

    items: number of work-items of a group; 0 for the number in the kernel shape.
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
    """Compute out[i] = sum of values[:i] and total[0] = sum of values, in one launch if one group is enough, else two.

    elements: the number of values to scan, from the first on; None scans all.
    """
    elements = elements or Elements(values.shape[0])
    groups, chunk = chunking(device, elements.most)
    sums = work.array("scan_sums", (groups,), np.uint32)
    kernels, items = device.kernels("scan", elements.defines), device.shape.items
    chunks = (groups, items, *elements.arguments, chunk)
    if groups > 1:
        launch_groups(device, kernels.scan_sums, *chunks, values, sums)
    launch_groups(device, kernels.scan_chunks, *chunks, values, sums, out, total)
