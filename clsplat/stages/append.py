# SPDX-License-Identifier: Apache-2.0
"""Launches append.cl: tile lists by append with atomics, each sorted by its own group, for a pass by capacity.

The kernels are for groups of several work-items. They replace the radix sorts of all pairs.
"""

from __future__ import annotations

import numpy as np
from numpy.typing import NDArray

from clsplat.device import cl
from clsplat.device.buffers import DeviceArray, Workspace
from clsplat.device.context import Device
from clsplat.device.launch import launch_groups
from clsplat.device.profile import stage
from clsplat.stages.blend import frame_items
from clsplat.stages.duplicate import Band, Totals
from clsplat.stages.probe_atomics import atomics_fault
from clsplat.stages.project import Projected
from clsplat.stages.ranges import TileLists

APPEND_PAIR_BYTES = 12
"""Bytes per pair in addition to the lists: the pair's depth and slot, and the slot's Gaussian."""

MAX_MEAN_PAIRS, MAX_LIST_PAIRS = 1500, 8192
"""Maximum pairs per tile for which lists are made by append: on average, and in the longest list.

One group sorts each list, in global memory if the list has more than 2,048 pairs. With longer lists too few groups have
too much work, and the radix sort is faster.
"""

LOCAL_PAIRS = 2048
"""Maximum pairs of a list that a group sorts in local memory. They take 16 KiB, half of the local memory that every
device has. Must be a power of two, 16 or more."""

_OFFSET_ITEMS = 1024
"""Number of work-items in each of the two groups of `list_offsets`. The first group handles the lengths of all tiles'
lists, the second the sums of all groups of the projection."""


def appends(device: Device) -> bool:
    """True if passes by capacity may make their lists by append: groups have several items, and the driver counts
    correctly with integer atomics."""
    return device.shape.items > 1 and not atomics_fault(device)


@stage("append")
def append(
    device: Device,
    work: Workspace,
    projected: Projected,
    tiles: tuple[int, int],
    readback: DeviceArray,
    capacity: int,
    host: NDArray[np.uint32],
) -> tuple[Totals, TileLists]:
    """Make the same tile lists as `duplicate` and `tile_lists`, but without waiting for the device.

    projected: Gaussians that `project` projected with `counts_lists`. Their `list_counts` are overwritten.
    capacity: maximum number of pairs. With more pairs the pass stops (kernels/append.cl).
    tiles: numbers of tiles across and down.
    readback: (READBACK_SIZE,) uint32, filled with the counts of the pass. Pass the same array to `project_step`.
    host: host memory, to which `readback` is copied.
    """
    (n,), number, items = projected.tile_counts.shape, tiles[0] * tiles[1], device.shape.items
    kernels, splats, tile_counts = device.kernels("append"), projected.splats, projected.tile_counts
    counted = projected.list_counts
    assert counted is not None, "lists by append need a projection with `counts_lists`"
    counts, slots, sums = counted.lengths, counted.slots, counted.sums
    (groups,) = sums.shape
    ranges, order = work.array("ranges", (number, 2), np.uint32), work.array("tile_order", (number,), np.uint32)
    many = max(items, min(_OFFSET_ITEMS, device.max_group))
    offsets, sizes = device.kernels("append", {"ITEMS": many}).list_offsets, (number, groups, capacity)
    launch_groups(device, offsets, 2, many, *sizes, counts, sums, ranges, order, readback)
    arriving = readback.begin_get(host)
    pairs = work.array("appended_pairs", (capacity, 2), np.uint32)
    gaussian_from_slot = work.array("gaussian_from_slot", (capacity,), np.uint32)
    appended = (splats, sums, readback, counts, tile_counts, slots, pairs, gaussian_from_slot)
    launch_groups(device, kernels.append_pairs, groups, items, n, *tiles, *appended)
    gaussian_from_sorted = work.array("gaussian_from_sorted", (capacity,), np.uint32)
    slot_from_sorted = work.array("slot_from_sorted", (capacity,), np.uint32)
    arrays = (order, ranges, gaussian_from_slot, pairs, gaussian_from_sorted, slot_from_sorted)
    local, sharing = cl.LocalMemory(8 * LOCAL_PAIRS), frame_items(device, number)
    sort = device.kernels("append", {"ITEMS": sharing}).sort_lists
    launch_groups(device, sort, number, sharing, LOCAL_PAIRS, *arrays, local)
    totals = Totals(tile_counts, slots, n, capacity, on_device=readback, arriving=arriving)
    elements = totals.elements(capacity, "PAIRS")
    return totals, TileLists(Band(0, number), ranges, gaussian_from_sorted, slot_from_sorted, elements, order)
