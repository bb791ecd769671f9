# SPDX-License-Identifier: Apache-2.0
"""Launches blend.cl and blend_grad.cl: alpha blending of each tile's Gaussians from front to back, and its gradient."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass, replace
from typing import Any

import numpy as np

from clsplat.camera import Camera
from clsplat.device.buffers import DeviceArray, Workspace
from clsplat.device.context import Device
from clsplat.device.launch import launch_groups
from clsplat.device.profile import stage
from clsplat.layouts.columns import PLAIN_SLOTS, TILE, SlotFields
from clsplat.stages.device_camera import padded_size
from clsplat.stages.ranges import TileLists

BLEND_PIXEL_BYTES = 20
"""Bytes per pixel of `Blended`, padding included: image, transmittance and stop."""


PART_PAIRS = 512
"""Number of pairs of a list that one group of several items processes in the gradient of blending. A longer list is
divided between groups (kernels/shared/parts.h). Must be a multiple of every BATCH of blend.cl."""


def gradient_pair_bytes(device: Device, fields: SlotFields) -> int:
    """Bytes per pair in the gradient of blending: its slot, and its cells or its share of the arrays of `ListParts`."""
    cells, state = 4, 4 * (4 + fields.nearness) * TILE * TILE + 4
    return 4 * fields.floats + (cells if tile_items(device) == 1 else -(-state // PART_PAIRS))


@dataclass(frozen=True, eq=False)
class ListParts:
    """Where groups of the gradient of blending begin within long lists (kernels/shared/parts.h).

    states: (boundaries, 4, TILE * TILE), transmittance and colour of a tile's pixels at each boundary; with nearness
    (boundaries, 5, TILE * TILE).
    tile_of_state: (boundaries), the tile of the band that owns each state.
    """

    states: DeviceArray
    tile_of_state: DeviceArray

    @property
    def boundaries(self) -> int:
        """Number of boundaries for which there is room."""
        return self.states.shape[0]

    @property
    def arguments(self) -> tuple[Any, Any]:
        """Kernel arguments, as plain buffers: the profile must not count their bytes, of which few are used."""
        return self.states.buffer, self.tile_of_state.buffer

    @property
    def defines(self) -> dict[str, object]:
        """The defines of kernels that take `arguments`."""
        return {"PART_PAIRS": PART_PAIRS, "STATE_SIZE": self.states.shape[1]}


@dataclass(frozen=True, eq=False)
class ImageInputs:
    """Input of the stages that process pixels, in addition to the tile lists.

    splats: (n, SPLAT), the array `splats` of `stages.project.Projected`.
    background: (3,), the background colour.
    width, height: size of the image in pixels.
    camera_array: the camera (`pack_camera`), for camera models that evaluate Gaussians along the rays of pixels.
    """

    splats: DeviceArray
    background: DeviceArray
    width: int
    height: int
    camera_array: DeviceArray | None = None


@dataclass(frozen=True, eq=False)
class Blended:
    """Results of `blend`, as planes padded to whole tiles.

    image: (3, rows, stride).
    transmittance: (rows, stride).
    stops: (rows, stride) int32, the sorted index of the first pair that is not added to the pixel; -1 in padding.
    cells_from_sorted: (pairs) uint32, a bit for each cell in which the pair contributes; None if not recorded.
    nearness: (rows, stride), the sum of weight / depth, if requested.
    parts: the boundaries within the lists of the last band; None if they are not recorded.
    """

    image: DeviceArray
    transmittance: DeviceArray
    stops: DeviceArray
    cells_from_sorted: DeviceArray | None
    nearness: DeviceArray | None = None
    parts: ListParts | None = None


def _planes(work: Workspace, width: int, height: int, *, kept: bool) -> tuple[DeviceArray, DeviceArray, DeviceArray]:
    """Arrays for the image, transmittance and stops of a frame. kept: True keeps their contents from the last call."""
    rows, stride = padded_size(width, height)
    return (
        work.array("image", (3, rows, stride), kept=kept),
        work.array("transmittance", (rows, stride), kept=kept),
        work.array("stops", (rows, stride), np.int32, kept=kept),
    )


_MIN_TILE_ITEMS = 8
"""Minimum number of work-items that share a tile: those of one row of a pixel block (kernels/shared/blocks.h). A tile
that is not shared has one work-item."""


def tile_items(device: Device) -> int:
    """Number of work-items that share a tile: at most one per pixel, and 1 if a vector holds several pixels."""
    if device.shape.lanes > 1 or device.shape.items == 1:
        return 1
    return min(max(device.shape.items, _MIN_TILE_ITEMS), TILE * TILE)


_BUSY_ITEMS = 4096
"""Number of work-items per compute unit above which larger groups in `blend` only add instructions. It is 16 tiles of
256 work-items or 32 of 128, as predicted for NVIDIA's GPUs (docs/gpu-static.md)."""


def frame_items(device: Device, tiles: int) -> int:
    """Number of work-items that share a tile in `blend` and `sort_lists`, in a frame of `tiles` tiles. No result
    depends on this number.

    With few tiles per compute unit of a GPU, a frame takes as long as its longest lists. More work-items sort a long
    list in less time, and each warp then blends fewer of its Gaussians.
    """
    items = tile_items(device)
    if device.kind != "gpu" or items == 1:
        return items
    return items_for(tiles, int(device.cl_device.max_compute_units), items, min(TILE * TILE, device.max_group))


def items_for(tiles: int, units: int, items: int, most: int) -> int:
    """Return the number of work-items that share a tile on a GPU, for `frame_items`.

    The result is `items` times a power of two: the largest that is at most `most`, and with which a compute unit has at
    most _BUSY_ITEMS work-items.

    tiles: number of tiles of the frame.
    units: number of the GPU's compute units.
    items: number of work-items that share a tile by the kernel shape.
    most: maximum number of work-items in a group.
    """
    while 2 * items <= most and 2 * items * tiles <= _BUSY_ITEMS * units:
        items *= 2
    return items


_GRADIENT_REGISTERS = {64: 96}
"""Maximum registers per work-item of `blend_grad`, by the number of work-items that share a tile, where the driver
accepts a limit. Without a limit NVIDIA's assembler uses only 80 registers, so few that loads have to wait for one
another."""


def launch_tiles(
    device: Device,
    stem: str,
    defines: Mapping[str, object],
    lists: TileLists,
    tiles_x: int,
    *arguments: Any,
    kernel: str = "",
    items: int | None = None,
    registers: int = 0,
    more: int = 0,
) -> None:
    """Launch a kernel of `stem`.cl, with one group per tile of the lists.

    kernel: the kernel's name, if it is not `stem`.
    items: number of work-items that share a tile; None for `tile_items`.
    registers: maximum registers per work-item, if the driver has an option for it; 0 for no limit.
    more: number of groups in addition to those of the tiles.

    The kernel's arguments are the first tile, the number of tiles in a row of the image, and `arguments`.
    """
    items = items or tile_items(device)
    built = getattr(device.kernels(stem, {"ITEMS": items, **defines}, registers), kernel or stem)
    launch_groups(device, built, lists.band.tiles + more, items, lists.band.first, tiles_x, *arguments)


def _divides(device: Device) -> bool:
    """True if several work-groups of `blend_grad` share a long list (`ListParts`)."""
    return tile_items(device) > 1 and not _by_gaussian(device)


def _by_gaussian(device: Device) -> bool:
    """True if each work-item of `blend_grad` owns Gaussians instead of pixels."""
    return device.shape.by_gaussian and not device.switched("RAYS")


def _rays(device: Device, inputs: ImageInputs) -> DeviceArray | None:
    """The camera if Gaussians are evaluated along the rays of pixels, otherwise None."""
    return inputs.camera_array if device.switched("RAYS") else None


def _list_parts(work: Workspace, lists: TileLists, *, nearness: bool) -> ListParts:
    boundaries = lists.gaussian_from_sorted.shape[0] // PART_PAIRS
    states = work.array("list_states", (boundaries, 5 if nearness else 4, TILE * TILE))
    return ListParts(states, work.array("tile_of_state", (boundaries,), np.uint32))


@stage("blend")
def blend(
    device: Device,
    work: Workspace,
    lists: TileLists,
    inputs: ImageInputs,
    *,
    record: bool = True,
    nearness: bool = False,
    items: int | None = None,
) -> Blended:
    """Blend the Gaussians of each tile in the lists front to back over the background.

    Pixels of other tiles are left unchanged.

    record: also fill the arrays of `Blended` that make the gradient quicker, as far as the kernel shape has them.
    nearness: also blend 1 / depth.
    items: number of work-items that share a tile; None for `frame_items`.
    """
    planes, near = _planes(work, inputs.width, inputs.height, kept=lists.band.first > 0), None
    if nearness:
        near = work.array("nearness", padded_size(inputs.width, inputs.height), kept=lists.band.first > 0)
    cells = parts = None
    if record and not device.switched("RAYS") and tile_items(device) == 1 and device.shape.lanes >= 8:
        cells = work.array("cells_from_sorted", lists.gaussian_from_sorted.shape, np.uint32)
    if record and _divides(device):
        parts = _list_parts(work, lists, nearness=nearness)
    blended = Blended(*planes, cells, near, parts)
    _fill(device, lists, inputs, blended, items or frame_items(device, lists.band.tiles))
    return blended


def _fill(device: Device, lists: TileLists, inputs: ImageInputs, blended: Blended, items: int) -> None:
    """Fill the arrays of `blended` for the tiles of the lists."""
    near, cells, parts = blended.nearness, blended.cells_from_sorted, blended.parts
    planes = (blended.image, blended.transmittance, blended.stops)
    extra: list[Any] = [array for array in (near, cells) if array]
    extra += [*(parts.arguments if parts else ()), *(array for array in (_rays(device, inputs), lists.order) if array)]
    arrays = (lists.ranges, lists.gaussian_from_sorted, inputs.splats, inputs.background, *planes, *extra)
    switches = (("NEARNESS", near), ("RECORD_CELLS", cells), ("TILE_ORDER", lists.order))
    defines = {**{name: True for name, on in switches if on}, **(parts.defines if parts else {})}
    launch_tiles(
        device, "blend", defines, lists, -(-inputs.width // TILE), inputs.width, inputs.height, *arrays, items=items
    )


def count_pairs(
    device: Device,
    work: Workspace,
    lists: TileLists,
    splats: DeviceArray,
    background: DeviceArray,
    camera: Camera,
) -> tuple[int, int]:
    """Count the contributing and the evaluated pairs of a Gaussian and a pixel, by a counting build of blend.cl.

    A pair contributes if the Gaussian's colour is added to the pixel. It is evaluated if its alpha is computed; a
    vector computes the alpha of all its lanes.
    """
    width, height = camera.width, camera.height
    planes = _planes(work, width, height, kept=True)  # the arrays of `blend`, which get the same values again
    counts = work.array("counts", (lists.band.tiles * tile_items(device), 2), np.uint32)
    arrays = (lists.ranges, lists.gaussian_from_sorted, splats, background, *planes, counts)
    launch_tiles(device, "blend", {"COUNT_PAIRS": True}, lists, -(-width // TILE), width, height, *arrays)
    contributing, evaluated = counts.get().sum(axis=0, dtype=np.uint64)
    return int(contributing), int(evaluated)


def _divided(
    device: Device, work: Workspace, lists: TileLists, inputs: ImageInputs, blended: Blended, *, nearness: bool
) -> Blended:
    """Blend the tiles again to record `Blended.parts`, which `blend` does not record in a frame of several bands."""
    near = blended.nearness
    if nearness and near is None:
        near = work.array("nearness", blended.transmittance.shape)
    again = replace(blended, nearness=near, parts=_list_parts(work, lists, nearness=near is not None))
    _fill(device, lists, inputs, again, frame_items(device, lists.band.tiles))
    return again


@stage("blend_grad")
def blend_grad(
    device: Device,
    work: Workspace,
    lists: TileLists,
    inputs: ImageInputs,
    blended: Blended,
    image_gradient: DeviceArray,
    *,
    fields: SlotFields = PLAIN_SLOTS,
) -> DeviceArray:
    """Return the gradients of each pair of a Gaussian and a tile, summed over the tile's pixels.

    The result has the shape (pairs, fields.floats). The row of a pair is its slot.

    image_gradient: (3, rows, stride), the loss's gradient with respect to the image. An optional fourth plane is the
    gradient with respect to the transmittance. With `fields.nearness` the last plane is the gradient with respect to
    nearness.
    fields: the columns of the result, in addition to the gradients that every slot has.
    """
    rows, stride = blended.transmittance.shape
    pairs = lists.gaussian_from_sorted.shape[0]
    slots = work.array("slots", (pairs, fields.floats))
    if pairs == 0:
        return slots
    if _divides(device) and (blended.parts is None or (fields.nearness and blended.nearness is None)):
        blended = _divided(device, work, lists, inputs, blended, nearness=fields.nearness)
    cells, parts = blended.cells_from_sorted, blended.parts
    defines = {**fields.defines, **({"RECORD_CELLS": True} if cells else {})}
    if _by_gaussian(device):
        defines["BY_GAUSSIAN"] = True
    if image_gradient.shape[0] - fields.nearness == 4:
        defines["ALPHA_GRADIENT"] = True
    if lists.order:
        defines["TILE_ORDER"] = True
    divided: tuple[Any, ...] = ()
    if parts:
        defines |= {**parts.defines, **lists.elements.defines}
        seen = [array.buffer for array in (blended.image, blended.nearness if fields.nearness else None) if array]
        divided = (parts.boundaries, *lists.elements.arguments, seen[0], *parts.arguments, *seen[1:])
    listed = (lists.ranges, lists.gaussian_from_sorted, lists.slot_from_sorted)
    planes = (image_gradient, blended.transmittance, blended.stops)
    extra = [array for array in (_rays(device, inputs), lists.order) if array]
    arrays = (*listed, inputs.splats, inputs.background, *planes, slots, *([cells] if cells else []), *divided, *extra)
    most = _GRADIENT_REGISTERS.get(tile_items(device), 0)
    launch_tiles(
        device,
        "blend_grad",
        defines,
        lists,
        stride // TILE,
        rows,
        *arrays,
        registers=most,
        more=parts.boundaries if parts else 0,
    )
    return slots
