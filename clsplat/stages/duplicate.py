# SPDX-License-Identifier: Apache-2.0
"""Launches duplicate.cl: visible Gaussians in order of depth, and a (tile, Gaussian) pair for each tile they reach."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np

from clsplat.device.buffers import DeviceArray, Workspace
from clsplat.device.context import Device
from clsplat.device.launch import launch_items
from clsplat.device.profile import stage
from clsplat.errors import CapacityError
from clsplat.stages.project import Projected
from clsplat.stages.scan import scan
from clsplat.stages.sort import sort

_OVERFLOW = 0xFFFFFFFF
"""What scan gives for a total that does not fit."""

_KEY_BITS = 31
"""Bits of a positive float32."""


@dataclass(frozen=True, eq=False)
class Pairs:
    """gaussian_from_rank (visible): by depth, ties by index; tile_keys, slot_from_pair (pairs): in that order;
    first_slots (n): where a Gaussian's slots begin; gaussian_from_slot (pairs)."""

    gaussian_from_rank: DeviceArray
    tile_keys: DeviceArray
    slot_from_pair: DeviceArray
    first_slots: DeviceArray
    gaussian_from_slot: DeviceArray


@stage("duplicate")
def duplicate(device: Device, work: Workspace, projected: Projected, tiles: tuple[int, int]) -> Pairs:
    """Sort the visible Gaussians by depth and emit their pairs in that order."""
    n = projected.tile_counts.shape[0]
    kernels = device.kernels("duplicate")
    ranks = work.array("visible_ranks", (n,), np.uint32)
    visible_total = work.array("visible_total", (1,), np.uint32)
    pairs_total = work.array("pairs_total", (1,), np.uint32)
    scan(device, work, projected.tile_counts, ranks, visible_total, as_flags=True)
    first_slots = work.array("first_slots", (n,), np.uint32)
    scan(device, work, projected.tile_counts, first_slots, pairs_total)
    visible, pairs = int(visible_total.get()[0]), int(pairs_total.get()[0])
    if pairs == _OVERFLOW:
        raise CapacityError(
            f"{visible} visible Gaussians reach more than {_OVERFLOW} tiles together: use a smaller image"
        )

    gaussian_from_visible = work.array("gaussian_from_visible", (visible,), np.uint32)
    depth_keys = work.array("depth_keys", (visible,), np.uint32)
    launch_items(
        device,
        kernels.compact_visible,
        n if visible else 0,
        n,
        projected.tile_counts,
        ranks,
        projected.splats,
        gaussian_from_visible,
        depth_keys,
    )
    _, order = sort(device, work, "depth", depth_keys, _KEY_BITS)
    gaussian_from_rank = work.array("gaussian_from_rank", (visible,), np.uint32)
    counts = work.array("rank_counts", (visible,), np.uint32)
    launch_items(
        device,
        kernels.order_counts,
        visible,
        visible,
        order,
        gaussian_from_visible,
        projected.tile_counts,
        gaussian_from_rank,
        counts,
    )
    offsets = work.array("offsets", (visible,), np.uint32)
    scan(device, work, counts, offsets, pairs_total)
    tile_keys = work.array("tile_keys", (pairs,), np.uint32)
    slot_from_pair = work.array("slot_from_pair", (pairs,), np.uint32)
    gaussian_from_slot = work.array("gaussian_from_slot", (pairs,), np.uint32)
    launch_items(
        device,
        kernels.duplicate,
        visible,
        visible,
        *tiles,
        gaussian_from_rank,
        offsets,
        first_slots,
        projected.splats,
        tile_keys,
        slot_from_pair,
        gaussian_from_slot,
    )
    return Pairs(gaussian_from_rank, tile_keys, slot_from_pair, first_slots, gaussian_from_slot)
