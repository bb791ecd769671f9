# SPDX-License-Identifier: Apache-2.0
"""Launches duplicate.cl: a (tile, Gaussian) pair for each tile that a visible Gaussian reaches, in order of depth."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass, replace
from typing import Any

import numpy as np
from numpy.typing import NDArray

from clsplat.device.buffers import DeviceArray, Workspace
from clsplat.device.context import Device
from clsplat.device.launch import launch_groups, launch_items
from clsplat.device.profile import stage
from clsplat.errors import CapacityError, amount
from clsplat.layouts.columns import COUNTED, READBACK, TILE
from clsplat.stages.project import Projected
from clsplat.stages.scan import Elements, chunking, scan
from clsplat.stages.sort import SORT_KEY_BYTES, sort

MAX_PAIRS_PER_BAND = 2**31 - 1024
"""Maximum number of pairs in a band. A pixel's stop, a position in a list, is a signed 32-bit integer, and kernels read
slightly past the last pair."""


DUPLICATE_GAUSSIAN_BYTES = 3 * 4 + SORT_KEY_BYTES + 3 * 4
"""Bytes per Gaussian: an entry each in `first_slots`, `gaussian_from_visible`, `depth_keys`, `gaussian_from_rank`,
`rank_counts` and `offsets`, and the Gaussian's share of the sort by depth."""
BAND_GAUSSIAN_BYTES = 4
"""Additional bytes per Gaussian if there are several bands: the number of the Gaussian's tiles in the band."""
BAND_TILE_BYTES = 4
"""Additional bytes per tile if there are several bands: the number of the tile's pairs."""


def pair_bytes(*, sorts_pairs: bool) -> int:
    """Return the bytes per pair: its tile, slot and Gaussian. `sorts_pairs` adds the bytes of `duplicate_and_sort`:
    tile, Gaussian and depth by slot, and a sort of the pairs by depth."""
    return 12 + (12 + SORT_KEY_BYTES if sorts_pairs else 0)


@dataclass(frozen=True)
class Band:
    """The tiles [first, end) of an image in row-major order, listed and blended together."""

    first: int
    end: int

    @property
    def tiles(self) -> int:
        """Number of tiles in the band."""
        return self.end - self.first


@dataclass(frozen=True, eq=False)
class Totals:
    """The numbers of visible Gaussians and of their pairs.

    tile_counts, first_slots: (n), each Gaussian's number of tiles, and its first slot, a prefix sum of tile_counts.
    visible, pairs: the numbers of visible Gaussians and of pairs; pairs are capped at 2^32 - 1.
    refused: numbers of elements that `adam` did not update, by reason (`columns.REFUSED`).

    In a pass launched by capacity (`PairCapacity`), `visible` and `pairs` are upper bounds. These fields are then set.

    on_device: the READBACK array from which the pass's kernels read the two numbers.
    arriving: function that waits for the host's copy of the READBACK array, and returns it.
    """

    tile_counts: DeviceArray
    first_slots: DeviceArray
    visible: int
    pairs: int
    refused: tuple[int, ...] = ()
    on_device: DeviceArray | None = None
    arriving: Callable[[], NDArray[Any]] | None = None

    def elements(self, most: int, name: str) -> Elements:
        """Return the number of elements that a kernel processes, as the kernel's argument.

        The number is `most`. In a pass by capacity the kernel reads the number from field `name` of READBACK, and
        `most` is an upper bound of it.
        """
        return Elements(most, self.on_device, READBACK.index(name))


@dataclass(frozen=True, eq=False, kw_only=True)
class Counted(Totals):
    """The visible Gaussians and the number of their pairs.

    gaussian_from_visible, depth_keys: (visible), index and depth key of each visible Gaussian, in order of the index.
    least_key: a lower bound of the depth keys.
    key_bits: the number of low bits that can be set in a key minus least_key.
    """

    gaussian_from_visible: DeviceArray
    depth_keys: DeviceArray
    least_key: int
    key_bits: int


@dataclass(frozen=True, eq=False)
class Pairs:
    """Pairs in order of depth; pairs of equal depth are in order of the Gaussian's index.

    tile_keys: (pairs), the tile of each pair, counted from the band's first tile.
    pair_ids: (pairs, 2), the slot and the Gaussian of each pair.
    elements: the number of pairs that these arrays hold.
    """

    tile_keys: DeviceArray
    pair_ids: DeviceArray
    elements: Elements


@stage("duplicate")
def count(
    device: Device,
    work: Workspace,
    projected: Projected,
    *,
    all_bits: bool = False,
    readback: DeviceArray | None = None,
) -> Counted:
    """List the visible Gaussians, and count their pairs and the bits in which their depths differ.

    Waits for the device.

    all_bits: assume that depths differ in all 32 bits.
    readback: (READBACK_SIZE,) uint32, filled with the counts. The numbers of elements that `adam` refused, which it
    already contains, become part of the result. None uses an array without these numbers.
    """
    readback = readback or work.array("readback", (len(COUNTED),), np.uint32)
    first_slots, gaussian_from_visible, depth_keys = _compact(device, work, projected, readback)
    values = [int(value) for value in readback.get()]
    visible, pairs, complement, largest = values[:4]
    least = 0 if all_bits else 2**32 - 1 - complement
    return Counted(
        projected.tile_counts,
        first_slots,
        visible,
        pairs,
        tuple(values[READBACK.index("STOPPED") + 1 :]),
        gaussian_from_visible=gaussian_from_visible.reshaped(visible),
        depth_keys=depth_keys.reshaped(visible),
        least_key=least,
        key_bits=32 if all_bits else max(largest - least, 1).bit_length(),
    )


@stage("duplicate")
def count_by_capacity(
    device: Device,
    work: Workspace,
    projected: Projected,
    readback: DeviceArray,
    capacity: int,
    host: NDArray[np.uint32],
) -> Counted:
    """Do the work of `count` without waiting for the device.

    capacity: maximum number of pairs. With more pairs the pass stops (kernels/duplicate.cl).
    readback: (READBACK_SIZE,) uint32, filled with the counts. Pass the same array to `project_step`.
    host: host memory, to which `readback` is copied.

    Depths are sorted by all 32 bits. On a GPU this takes no more passes than a sort by the bits that differ.
    """
    (n,) = projected.tile_counts.shape
    first_slots, gaussian_from_visible, depth_keys = _compact(device, work, projected, readback, capacity)
    return Counted(
        projected.tile_counts,
        first_slots,
        n,
        capacity,
        on_device=readback,
        arriving=readback.begin_get(host),
        gaussian_from_visible=gaussian_from_visible,
        depth_keys=depth_keys,
        least_key=0,
        key_bits=32,
    )


def _compact(
    device: Device, work: Workspace, projected: Projected, readback: DeviceArray, capacity: int | None = None
) -> tuple[DeviceArray, DeviceArray, DeviceArray]:
    """Fill `readback`, and return the first slots (n), the visible Gaussians (n) and their depth keys (n).

    capacity: maximum number of pairs in a pass by capacity; None for other passes.
    """
    tile_counts = projected.tile_counts
    (n,) = tile_counts.shape
    shown = projected.shown or tile_counts
    by_gaussian = (
        work.array("first_slots", (n,), np.uint32),
        work.array("gaussian_from_visible", (n,), np.uint32),
        work.array("depth_keys", (n,), np.uint32),
    )
    groups, chunk = chunking(device, n)
    sums = work.array("visible_sums", (2, groups), np.uint32)
    limit, defines = ((), {}) if capacity is None else ((capacity,), {"BY_CAPACITY": True})
    kernels, chunks = device.kernels("duplicate", defines), (groups, device.shape.items, n, chunk)
    launch_groups(device, kernels.visible_sums, *chunks, shown, tile_counts, sums, readback)
    arrays = (shown, tile_counts, projected.splats, sums, *by_gaussian, readback, *limit)
    launch_groups(device, kernels.compact_visible, *chunks, *arrays)
    return by_gaussian


@stage("duplicate")
def count_band(
    device: Device,
    work: Workspace,
    projected: Projected,
    tiles: tuple[int, int],
    band: Band,
    *,
    all_bits: bool = False,
) -> Counted:
    """Do the work of `count` for the tiles of a band only. Overwrites the workspace's arrays of an earlier count."""
    n = projected.tile_counts.shape[0]
    band_counts = work.array("band_counts", (n,), np.uint32)
    kernel, arrays = device.kernels("duplicate").band_counts, (projected.tile_counts, projected.splats, band_counts)
    launch_items(device, kernel, n, n, *tiles, band.first, band.end, *arrays)
    return count(device, work, replace(projected, tile_counts=band_counts), all_bits=all_bits)


@stage("duplicate")
def plan_bands(
    device: Device, work: Workspace, projected: Projected, counted: Counted, tiles: tuple[int, int], capacity: int
) -> tuple[Band, ...]:
    """Return the fewest bands of at most `capacity` pairs each. Raises CapacityError if a tile has more."""
    if counted.pairs <= capacity:
        return (Band(0, tiles[0] * tiles[1]),)
    n = projected.tile_counts.shape[0]
    counts = work.array("counts_by_tile", (tiles[0] * tiles[1],), np.uint32)
    counts.fill(0)
    kernel = device.kernels("duplicate").count_by_tile
    launch_items(device, kernel, n, n, *tiles, projected.tile_counts, projected.splats, counts)
    by_tile = counts.get()
    if (most := int(by_tile.max(initial=0))) > capacity:
        raise CapacityError(
            f"one tile of {TILE}x{TILE} pixels has {most:,} Gaussians, but in the {amount(device.budget)} on "
            f"{device.name} there is room for only {capacity:,}: allow more memory (--max-device-mem)"
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
    visible, pairs = counted.visible, counted.pairs
    shown, listed = counted.elements(visible, "VISIBLE"), counted.elements(pairs, "PAIRS")
    kernels = device.kernels("duplicate", shown.defines)
    _, order = sort(device, work, "depth", counted.depth_keys, counted.key_bits, counted.least_key, shown)
    gaussian_from_rank = work.array("gaussian_from_rank", (visible,), np.uint32)
    counts = work.array("rank_counts", (visible,), np.uint32)
    ranked = (order, counted.gaussian_from_visible, counted.tile_counts, gaussian_from_rank, counts)
    all_rows = () if counted.on_device is None else (visible,)
    launch_items(device, kernels.order_counts, visible, *shown.arguments, *ranked, *all_rows)
    offsets = work.array("offsets", (visible,), np.uint32)
    scan(device, work, counts, offsets, work.array("pairs_total", (1,), np.uint32), shown)
    tile_keys = work.array("tile_keys", (pairs,), np.uint32)
    pair_ids = work.array("pair_ids", (pairs, 2), np.uint32)
    extent, arrays = (*tiles, band.first, band.end), (gaussian_from_rank, offsets, counted.first_slots, splats)
    launch_items(device, kernels.duplicate, visible, *shown.arguments, *extent, *arrays, tile_keys, pair_ids)
    return Pairs(tile_keys, pair_ids, listed)


@stage("duplicate")
def duplicate_and_sort(
    device: Device, work: Workspace, splats: DeviceArray, counted: Counted, tiles: tuple[int, int], band: Band
) -> Pairs:
    """Make the same pairs as `duplicate`, but by a sort of all pairs by depth, as in the code of Kerbl et al.

    With the sort by tile that follows, this equals one sort by 64-bit keys: tile in the upper half, depth in the lower.
    """
    visible, pairs = counted.visible, counted.pairs
    kernels = device.kernels("duplicate")
    tile_from_slot = work.array("tile_from_slot", (pairs,), np.uint32)
    pair_depths = work.array("pair_depths", (pairs,), np.uint32)
    gaussian_from_slot = work.array("gaussian_from_slot", (pairs,), np.uint32)
    extent, arrays = (*tiles, band.first, band.end), (counted.gaussian_from_visible, counted.first_slots, splats)
    by_slot = (tile_from_slot, pair_depths, gaussian_from_slot)
    launch_items(device, kernels.duplicate_slots, visible, visible, *extent, *arrays, *by_slot)
    _, slot_from_pair = sort(device, work, "pair_depth", pair_depths, counted.key_bits, counted.least_key)
    tile_keys = work.array("tile_keys", (pairs,), np.uint32)
    pair_ids = work.array("pair_ids", (pairs, 2), np.uint32)
    ordered = (slot_from_pair, tile_from_slot, gaussian_from_slot, tile_keys, pair_ids)
    launch_items(device, kernels.order_pairs, pairs, pairs, *ordered)
    return Pairs(tile_keys, pair_ids, counted.elements(pairs, "PAIRS"))
