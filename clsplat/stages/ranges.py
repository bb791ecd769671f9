# SPDX-License-Identifier: Apache-2.0
"""Launches ranges.cl: pairs sorted by tile, and the begin and end of each tile's pairs."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np

from clsplat.device.buffers import DeviceArray, Workspace
from clsplat.device.context import Device
from clsplat.device.launch import launch_items
from clsplat.device.profile import stage
from clsplat.stages.duplicate import Band, Pairs
from clsplat.stages.scan import Elements
from clsplat.stages.sort import SORT_KEY_BYTES, sort

TILE_SORT_PAIR_BYTES = SORT_KEY_BYTES + 8
"""Bytes per pair: its key and position in the sort by tile, `gaussian_from_sorted` and `slot_from_sorted`."""
RANGE_TILE_BYTES = 8
"""Bytes per tile of its range: the begin and end of its list."""


@dataclass(frozen=True, eq=False)
class TileLists:
    """The tile lists of a band.

    ranges: (tiles, 2), begin and end of each tile's pairs in gaussian_from_sorted and slot_from_sorted, (pairs) each.
    elements: the number of pairs in the lists.
    order: (tiles), the tiles in the order in which groups process them; None for the order in the image.
    """

    band: Band
    ranges: DeviceArray
    gaussian_from_sorted: DeviceArray
    slot_from_sorted: DeviceArray
    elements: Elements
    order: DeviceArray | None = None


@stage("ranges")
def tile_lists(device: Device, work: Workspace, pairs: Pairs, band: Band, *, all_bits: bool = False) -> TileLists:
    """Sort pairs, already in order of depth, by tile. The sort is stable, so that each tile's list is front to back.

    all_bits: True sorts by 32 bits, False by as many as the tile numbers need.
    """
    count, elements = pairs.tile_keys.shape[0], pairs.elements
    bits = 32 if all_bits else max(band.tiles - 1, 1).bit_length()
    keys, pair_from_sorted = sort(device, work, "tile", pairs.tile_keys, bits, elements=elements)
    ranges = work.array("ranges", (band.tiles, 2), np.uint32)
    ranges.fill(0)
    slot_from_sorted = work.array("slot_from_sorted", (count,), np.uint32)
    gaussian_from_sorted = work.array("gaussian_from_sorted", (count,), np.uint32)
    arrays = (keys, pair_from_sorted, pairs.pair_ids, ranges, slot_from_sorted, gaussian_from_sorted)
    kernel = device.kernels("ranges", elements.defines).ranges
    launch_items(device, kernel, count, *elements.arguments, *arrays)
    return TileLists(band, ranges, gaussian_from_sorted, slot_from_sorted, elements)
