# SPDX-License-Identifier: Apache-2.0
"""Launches duplicate.cl: visible Gaussians in order of depth, and a (tile, Gaussian) pair for each tile they reach."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np

from clsplat.device.buffers import DeviceArray, Workspace
from clsplat.device.context import Device
from clsplat.device.launch import launch_items
from clsplat.device.layout import TILE
from clsplat.device.memory import mebibytes
from clsplat.device.profile import stage
from clsplat.errors import CapacityError
from clsplat.stages.project import Projected
from clsplat.stages.scan import scan
from clsplat.stages.sort import sort

_KEY_BITS = 31
"""Bits of a positive float32."""


MAX_PAIRS = 2**31 - 1024
"""In one band: what `stops` count is signed, and read a little ahead of."""


@dataclass(frozen=True)
class Band:
    """The tiles [first, end) of an image in row-major order: what is listed and blended together."""

    first: int
    end: int

    @property
    def tiles(self) -> int:
        """How many."""
        return self.end - self.first


@dataclass(frozen=True, eq=False)
class Counted:
    """tile_counts, ranks, first_slots (n): a Gaussian's tiles, and the scans of `shown` as flags and of the tiles;
    shown (n): not 0 where a Gaussian is visible, the tile_counts unless culling is switched off; visible and pairs:
    the totals, pairs capped at 2^32 - 1."""

    tile_counts: DeviceArray
    shown: DeviceArray
    ranks: DeviceArray
    first_slots: DeviceArray
    visible: int
    pairs: int


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
def count(device: Device, work: Workspace, tile_counts: DeviceArray, shown: DeviceArray | None = None) -> Counted:
    """How many Gaussians are visible, and how many pairs they make; waits for the device."""
    (n,) = tile_counts.shape
    shown = shown or tile_counts
    ranks = work.array("visible_ranks", (n,), np.uint32)
    visible_total = work.array("visible_total", (1,), np.uint32)
    pairs_total = work.array("pairs_total", (1,), np.uint32)
    scan(device, work, shown, ranks, visible_total, as_flags=True)
    first_slots = work.array("first_slots", (n,), np.uint32)
    scan(device, work, tile_counts, first_slots, pairs_total)
    return Counted(tile_counts, shown, ranks, first_slots, int(visible_total.get()[0]), int(pairs_total.get()[0]))


@stage("duplicate")
def count_band(device: Device, work: Workspace, projected: Projected, tiles: tuple[int, int], band: Band) -> Counted:
    """`count` of the band's tiles alone. It replaces what an earlier count has left in the workspace."""
    n = projected.tile_counts.shape[0]
    band_counts = work.array("band_counts", (n,), np.uint32)
    launch_items(
        device,
        device.kernels("duplicate").band_counts,
        n,
        n,
        *tiles,
        band.first,
        band.end,
        projected.tile_counts,
        projected.splats,
        band_counts,
    )
    return count(device, work, band_counts, projected.shown)


@stage("duplicate")
def plan_bands(
    device: Device, work: Workspace, projected: Projected, tiles: tuple[int, int], capacity: int
) -> tuple[Band, ...]:
    """As few bands as there can be of at most `capacity` pairs each. Raises CapacityError where one tile has more."""
    n = projected.tile_counts.shape[0]
    counts = work.array("counts_by_tile", (tiles[0] * tiles[1],), np.uint32)
    counts.fill(0)
    launch_items(
        device,
        device.kernels("duplicate").count_by_tile,
        n,
        n,
        *tiles,
        projected.tile_counts,
        projected.splats,
        counts,
    )
    by_tile = counts.get()
    if (most := int(by_tile.max(initial=0))) > capacity:
        raise CapacityError(
            f"one tile of {TILE}x{TILE} pixels has {most:,} Gaussians, and the memory that is left on {device.name} "
            f"is enough for {capacity:,} of {mebibytes(device.budget)}: allow more (--max-device-mem)"
        )
    ends = np.cumsum(by_tile, dtype=np.uint64)
    bands, first, done = [], 0, 0
    while first < len(ends):
        end = int(np.searchsorted(ends, np.uint64(done + capacity), side="right"))
        bands.append(Band(first, end))
        first, done = end, int(ends[end - 1])
    return tuple(bands)


@stage("duplicate")
def duplicate(
    device: Device, work: Workspace, splats: DeviceArray, counted: Counted, tiles: tuple[int, int], band: Band
) -> Pairs:
    """Sort the visible Gaussians by depth and emit their pairs in that order."""
    visible, pairs, first_slots = counted.visible, counted.pairs, counted.first_slots
    n = counted.tile_counts.shape[0]
    kernels = device.kernels("duplicate")
    gaussian_from_visible = work.array("gaussian_from_visible", (visible,), np.uint32)
    depth_keys = work.array("depth_keys", (visible,), np.uint32)
    launch_items(
        device,
        kernels.compact_visible,
        n if visible else 0,
        n,
        counted.shown,
        counted.ranks,
        splats,
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
        counted.tile_counts,
        gaussian_from_rank,
        counts,
    )
    offsets = work.array("offsets", (visible,), np.uint32)
    scan(device, work, counts, offsets, work.array("pairs_total", (1,), np.uint32))
    tile_keys = work.array("tile_keys", (pairs,), np.uint32)
    slot_from_pair = work.array("slot_from_pair", (pairs,), np.uint32)
    gaussian_from_slot = work.array("gaussian_from_slot", (pairs,), np.uint32)
    launch_items(
        device,
        kernels.duplicate,
        visible,
        visible,
        *tiles,
        band.first,
        band.end,
        gaussian_from_rank,
        offsets,
        first_slots,
        splats,
        tile_keys,
        slot_from_pair,
        gaussian_from_slot,
    )
    return Pairs(gaussian_from_rank, tile_keys, slot_from_pair, first_slots, gaussian_from_slot)
