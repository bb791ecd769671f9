# SPDX-License-Identifier: Apache-2.0
"""Launches duplicate.cl: visible Gaussians in order of depth, and a (tile, Gaussian) pair for each tile they reach."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np

from clsplat.device.buffers import DeviceArray, Workspace
from clsplat.device.context import Device
from clsplat.device.launch import launch_items
from clsplat.stages.project import Projected
from clsplat.stages.scan import scan, total
from clsplat.stages.sort import sort

_KEY_BITS = 31
"""Bits of a positive float32."""


@dataclass(frozen=True, eq=False)
class Pairs:
    """gaussian_from_rank (visible): by depth, ties by index; offsets (visible): where a rank's pairs begin;
    tile_keys, gaussian_from_pair (pairs)."""

    gaussian_from_rank: DeviceArray
    offsets: DeviceArray
    tile_keys: DeviceArray
    gaussian_from_pair: DeviceArray


def duplicate(device: Device, work: Workspace, projected: Projected, tiles: tuple[int, int]) -> Pairs:
    """Sort the visible Gaussians by depth and emit their pairs in that order."""
    n = projected.tile_counts.shape[0]
    kernels = device.kernels("duplicate")
    ranks = work.array("visible_ranks", (n,), np.uint32)
    visible_total = work.array("visible_total", (1,), np.uint32)
    pairs_total = work.array("pairs_total", (1,), np.uint32)
    scan(device, work, projected.tile_counts, ranks, visible_total, as_flags=True)
    total(device, work, projected.tile_counts, pairs_total)
    visible, pairs = int(visible_total.get()[0]), int(pairs_total.get()[0])

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
    gaussian_from_pair = work.array("gaussian_from_pair", (pairs,), np.uint32)
    launch_items(
        device,
        kernels.duplicate,
        visible,
        visible,
        *tiles,
        gaussian_from_rank,
        offsets,
        projected.splats,
        tile_keys,
        gaussian_from_pair,
    )
    return Pairs(gaussian_from_rank, offsets, tile_keys, gaussian_from_pair)
