# SPDX-License-Identifier: Apache-2.0
"""Launches blend.cl and blend_grad.cl."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np

from clsplat.camera import Camera
from clsplat.device.buffers import DeviceArray, Workspace
from clsplat.device.context import Device
from clsplat.device.launch import launch_groups
from clsplat.device.layout import PLAIN_SLOTS, TILE, SlotFields
from clsplat.device.profile import stage
from clsplat.stages.duplicate import Band
from clsplat.stages.ranges import TileLists


@dataclass(frozen=True, eq=False)
class Blended:
    """Planes padded to whole tiles: image (3, rows, stride), transmittance (rows, stride), stops (rows, stride).

    cells_from_sorted (pairs) uint32: the cells in which each pair's Gaussian contributes, as bits; or None.
    """

    image: DeviceArray
    transmittance: DeviceArray
    stops: DeviceArray
    cells_from_sorted: DeviceArray | None


def _planes(work: Workspace, width: int, height: int, *, kept: bool) -> tuple[DeviceArray, DeviceArray, DeviceArray]:
    """Image, transmittance and stops of a frame: the workspace's, whoever asks; kept: as the last one left them."""
    rows, stride = -(-height // TILE) * TILE, -(-width // TILE) * TILE
    return (
        work.array("image", (3, rows, stride), kept=kept),
        work.array("transmittance", (rows, stride), kept=kept),
        work.array("stops", (rows, stride), np.int32, kept=kept),
    )


def tile_items(device: Device) -> int:
    """Work-items that share a tile: no more than it has vectors."""
    return min(device.shape.items, TILE * TILE // device.shape.lanes)


@stage("blend")
def blend(
    device: Device,
    work: Workspace,
    lists: TileLists,
    splats: DeviceArray,
    background: DeviceArray,
    width: int,
    height: int,
    band: Band | None = None,
    *,
    record: bool = True,
    camera_array: DeviceArray | None = None,
) -> Blended:
    """Blend the Gaussians of each of the band's tiles, all tiles if none is given, front to back over the background
    (3,). Pixels of other tiles are left as they are.

    record: keep the cells that the gradient has to go through, where the kernels' shape has them; camera_array: for
    pixels that are rays, which have no gradient.
    """
    tiles_x, tiles_y = -(-width // TILE), -(-height // TILE)
    planes = _planes(work, width, height, kept=band is not None and band.first > 0)
    items = tile_items(device)
    cells = None
    if record and not device.switched("RAYS") and items == 1 and device.shape.lanes >= 8:
        cells = work.array("cells_from_sorted", lists.gaussian_from_sorted.shape, np.uint32)
    defines = {"RECORD_CELLS": True} if cells else {}
    launch_groups(
        device,
        device.kernels("blend", ITEMS=items, **defines).blend,
        band.tiles if band else tiles_x * tiles_y,
        items,
        band.first if band else 0,
        tiles_x,
        width,
        height,
        lists.ranges,
        lists.gaussian_from_sorted,
        splats,
        background,
        *planes,
        *([cells] if cells else []),
        *([camera_array] if device.switched("RAYS") else []),
    )
    return Blended(*planes, cells)


def count_pairs(
    device: Device,
    work: Workspace,
    lists: TileLists,
    splats: DeviceArray,
    background: DeviceArray,
    camera: Camera,
    band: Band | None = None,
) -> tuple[int, int]:
    """(contributing, evaluated) pairs of a Gaussian and a pixel, by a build of blend.cl that counts them.

    Contributing: added to the pixel's colour. Evaluated: alpha was worked out, in a lane of a vector that was visited.
    """
    tiles_x, tiles_y = -(-camera.width // TILE), -(-camera.height // TILE)
    items = tile_items(device)
    planes = _planes(work, camera.width, camera.height, kept=True)  # those of `blend`: it writes the same values again
    tiles = band.tiles if band else tiles_x * tiles_y
    counts = work.array("counts", (tiles * items, 2), np.uint32)
    launch_groups(
        device,
        device.kernels("blend", ITEMS=items, COUNT_PAIRS=True).blend,
        tiles,
        items,
        band.first if band else 0,
        tiles_x,
        camera.width,
        camera.height,
        lists.ranges,
        lists.gaussian_from_sorted,
        splats,
        background,
        *planes,
        counts,
    )
    contributing, evaluated = counts.get().sum(axis=0, dtype=np.uint64)
    return int(contributing), int(evaluated)


@stage("blend_grad")
def blend_grad(
    device: Device,
    work: Workspace,
    lists: TileLists,
    splats: DeviceArray,
    background: DeviceArray,
    blended: Blended,
    image_gradient: DeviceArray,
    band: Band | None = None,
    *,
    fields: SlotFields = PLAIN_SLOTS,
) -> DeviceArray:
    """Partial gradients of every pair of the band at its slot, (pairs, fields.floats), from image_gradient (3, rows,
    stride)."""
    rows, stride = blended.transmittance.shape
    pairs = lists.gaussian_from_sorted.shape[0]
    slots = work.array("slots", (pairs, fields.floats))
    items = tile_items(device)
    cells = blended.cells_from_sorted
    defines = {**fields.defines, **({"RECORD_CELLS": True} if cells else {})}
    launch_groups(
        device,
        device.kernels("blend_grad", ITEMS=items, **defines).blend_grad,
        (band.tiles if band else (rows // TILE) * (stride // TILE)) if pairs else 0,
        items,
        band.first if band else 0,
        stride // TILE,
        rows,
        lists.ranges,
        lists.gaussian_from_sorted,
        lists.slot_from_sorted,
        splats,
        background,
        image_gradient,
        blended.transmittance,
        blended.stops,
        slots,
        *([cells] if cells else []),
    )
    return slots
