# SPDX-License-Identifier: Apache-2.0
"""Launches ranges.cl: pairs sorted by tile, and where each tile's begin and end."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np

from clsplat.device.buffers import DeviceArray, Workspace
from clsplat.device.context import Device
from clsplat.device.launch import launch_items
from clsplat.device.profile import stage
from clsplat.stages.duplicate import Pairs
from clsplat.stages.sort import sort


@dataclass(frozen=True, eq=False)
class TileLists:
    """ranges (tiles, 2): begin and end in the lists; gaussian_from_sorted, slot_from_sorted (pairs)."""

    ranges: DeviceArray
    gaussian_from_sorted: DeviceArray
    slot_from_sorted: DeviceArray


@stage("ranges")
def tile_lists(device: Device, work: Workspace, pairs: Pairs, tiles: int, *, all_bits: bool = False) -> TileLists:
    """A stable sort by tile of pairs that are in order of depth: each tile's Gaussians front to back. By as many bits
    as the tiles need, or with `all_bits` by 32."""
    count = pairs.tile_keys.shape[0]
    bits = 32 if all_bits else max(tiles - 1, 1).bit_length()
    keys, pair_from_sorted = sort(device, work, "tile", pairs.tile_keys, bits)
    ranges = work.array("ranges", (tiles, 2), np.uint32)
    ranges.fill(0)
    slot_from_sorted = work.array("slot_from_sorted", (count,), np.uint32)
    gaussian_from_sorted = work.array("gaussian_from_sorted", (count,), np.uint32)
    launch_items(
        device,
        device.kernels("ranges").ranges,
        count,
        count,
        keys,
        pair_from_sorted,
        pairs.pair_ids,
        ranges,
        slot_from_sorted,
        gaussian_from_sorted,
    )
    return TileLists(ranges, gaussian_from_sorted, slot_from_sorted)
