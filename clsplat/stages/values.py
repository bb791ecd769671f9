# SPDX-License-Identifier: Apache-2.0
"""Launches values.cl and values_grad.cl: any number of values a Gaussian, blended with the weights of an image."""

from __future__ import annotations

from collections.abc import Iterator

from clsplat.device.buffers import DeviceArray, Workspace
from clsplat.device.context import Device
from clsplat.device.layout import PLAIN_SLOTS, TILE, SlotFields
from clsplat.device.profile import stage
from clsplat.stages.blend import Blended, launch_tiles, tile_items
from clsplat.stages.project import Projected, Slots
from clsplat.stages.ranges import TileLists
from clsplat.stages.splats import COLOURS, MOMENTS, ScreenGradients, add_values, splats_grad

MOST = 32
"""Values of a pass. Where a work-item is a lane they are registers, and of fewer."""
_REGISTERS = 64
"""Sums that an item of a group has at most in the forward pass: of its pixels' values."""
_LOCAL = 2048
"""Values of a pass times items of a group in the gradient: what their sums take of local memory."""


def passes(first: int, depth: int, most: int) -> Iterator[tuple[int, int]]:
    """(first, count) of each pass over the values from `first` to before `depth`."""
    for begin in range(first, depth, most):
        yield begin, min(most, depth - begin)


def most_values(device: Device) -> int:
    """Values of a forward pass."""
    items = tile_items(device)
    return MOST if items == 1 else min(max(_REGISTERS * items // (TILE * TILE), 2), 16)


def most_gradients(device: Device) -> int:
    """Values of a pass of the gradient."""
    items = tile_items(device)
    return MOST if items == 1 else min(_LOCAL // items, 16)


@stage("values")
def values(
    device: Device,
    lists: TileLists,
    splats: DeviceArray,
    value_rows: DeviceArray,
    background: DeviceArray,
    blended: Blended,
    pixels: DeviceArray,
    *,
    first: int = COLOURS,
) -> None:
    """Blend the values from `first` on of value_rows (n, depth) over the background (depth,), with the weights of
    `blended`, which is of the same lists, into pixels (height, width, depth)."""
    height, width, depth = pixels.shape
    cells = blended.cells_from_sorted
    arrays = (lists.ranges, lists.gaussian_from_sorted, splats, value_rows, background, blended.stops, pixels)
    for begin, count in passes(first, depth, most_values(device)):
        defines = {"VALUES": count, **({"RECORD_CELLS": True} if cells else {})}
        of_pass = (width, height, depth, begin, *arrays, *([cells] if cells else []))
        launch_tiles(device, "values", defines, lists, -(-width // TILE), *of_pass)


@stage("values_grad")
def values_grad(
    device: Device,
    work: Workspace,
    lists: TileLists,
    first_slots: DeviceArray,
    projected: Projected,
    value_rows: DeviceArray,
    background: DeviceArray,
    blended: Blended,
    d_pixels: DeviceArray,
    d_alpha: DeviceArray | None,
    gradients: ScreenGradients,
    *,
    fields: SlotFields = PLAIN_SLOTS,
) -> None:
    """Fill every row of the gradients from d_pixels (height, width, depth) and d_alpha (height, width); fields: with
    absolute gradients, if the gradients have room for them. background (depth,)."""
    height, width, depth = d_pixels.shape
    tiles_x, pairs = -(-width // TILE), lists.gaussian_from_sorted.shape[0]
    by_cell = work.array("gradient_by_cell", (lists.band.tiles, depth + 1, TILE * TILE))
    most, cells = most_gradients(device), blended.cells_from_sorted
    given = [] if d_alpha is None else [d_alpha]
    recorded: dict[str, object] = {"RECORD_CELLS": True} if cells else {}
    defines: dict[str, object] = {"VALUES": min(most, depth), **({"ALPHA_GRADIENT": True} if given else {})}
    of_tiles = (lists, tiles_x, width, height, depth, d_pixels, background, *given, by_cell)
    launch_tiles(device, "values_grad", defines, *of_tiles, kernel="gradient_by_cell")
    listed = (lists.ranges, lists.gaussian_from_sorted, lists.slot_from_sorted)
    planes = (projected.splats, value_rows, by_cell, blended.transmittance, blended.stops)
    for first, count in passes(0, depth, most):
        geometry = first == 0
        own = {"GEOMETRY": True, **fields.defines} if geometry else {}
        floats = count + (MOMENTS + 2 * fields.absolute if geometry else 0)
        slots = work.array("slots", (pairs, floats))
        defines = {"VALUES": count, **recorded, **own}
        arrays = (*listed, *planes, slots, *([cells] if cells else []))
        if pairs:
            launch_tiles(device, "values_grad", defines, lists, tiles_x, height, depth, first, *arrays)
        if geometry:
            splats_grad(device, projected, Slots(slots, first_slots), gradients, kept=count, fields=fields)
        else:
            add_values(device, projected, Slots(slots, first_slots), gradients.values, first, count)
