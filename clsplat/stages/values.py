# SPDX-License-Identifier: Apache-2.0
"""Launches values.cl and values_grad.cl: any number of values per Gaussian, blended with the weights of an image."""

from __future__ import annotations

from collections.abc import Iterator
from dataclasses import dataclass

from clsplat.device.buffers import DeviceArray, Workspace
from clsplat.device.context import Device
from clsplat.device.profile import stage
from clsplat.layouts.columns import PLAIN_SLOTS, TILE, SlotFields
from clsplat.stages.blend import Blended, launch_tiles, tile_items
from clsplat.stages.project import Projected, Slots
from clsplat.stages.ranges import TileLists
from clsplat.stages.splats import SLOT_MOMENT_FIELDS, SPLAT_VALUES, ScreenGradients, add_values, splats_grad

MAX_VALUES_PER_PASS = 32
"""Maximum values per pass if one work-item has a whole tile. If several share a tile, fewer sums fit in registers."""
_MAX_REGISTER_SUMS = 64
"""Maximum number of sums in registers, values times pixels, of a work-item that shares its tile with others."""
_MAX_LOCAL_SUMS = 2048
"""Maximum number of sums in local memory, values times work-items, of a group in the gradient."""


def passes(first: int, end: int, most: int) -> Iterator[tuple[int, int]]:
    """Divide the values with indices [first, end) into passes. Yields the first index of a pass, and its number of
    values.

    most: maximum number of values per pass.
    """
    for begin in range(first, end, most):
        yield begin, min(most, end - begin)


def most_values(device: Device) -> int:
    """Return the maximum number of values per pass of `values`."""
    items = tile_items(device)
    return MAX_VALUES_PER_PASS if items == 1 else min(max(_MAX_REGISTER_SUMS * items // (TILE * TILE), 2), 16)


def most_gradients(device: Device) -> int:
    """Return the maximum number of values per pass of `values_grad`."""
    items = tile_items(device)
    return MAX_VALUES_PER_PASS if items == 1 else min(_MAX_LOCAL_SUMS // items, 16)


@dataclass(frozen=True, eq=False)
class ValuePass:
    """Values per Gaussian, and the image with whose weights they are blended.

    lists, projected, blended: tile lists, splats and results of the image.
    values: (n, D), the values of all Gaussians.
    background: (D,), the values behind all Gaussians.
    """

    lists: TileLists
    projected: Projected
    values: DeviceArray
    background: DeviceArray
    blended: Blended


@stage("values")
def values(device: Device, of: ValuePass, pixels: DeviceArray, *, first: int = SPLAT_VALUES) -> None:
    """Blend the values from index `first` on over their background, with the weights of the image.

    pixels: (height, width, D), filled with the result.
    """
    height, width, depth = pixels.shape
    lists, cells = of.lists, of.blended.cells_from_sorted
    rows = (of.projected.splats, of.values, of.background, of.blended.stops, pixels)
    arrays = (lists.ranges, lists.gaussian_from_sorted, *rows, *([cells] if cells else []))
    for begin, count in passes(first, depth, most_values(device)):
        defines = {"VALUES": count, **({"RECORD_CELLS": True} if cells else {})}
        launch_tiles(device, "values", defines, lists, -(-width // TILE), width, height, depth, begin, *arrays)


@stage("values_grad")
def values_grad(
    device: Device,
    work: Workspace,
    of: ValuePass,
    first_slots: DeviceArray,
    d_pixels: DeviceArray,
    d_alpha: DeviceArray | None,
    gradients: ScreenGradients,
    *,
    fields: SlotFields = PLAIN_SLOTS,
) -> None:
    """Fill every row of `gradients` from the gradients with respect to blended values and alpha.

    of: the arguments of `values`: the values, and the image by whose weights they are blended.
    first_slots: (n,), the first slot of each Gaussian.
    d_pixels: (height, width, D), the gradient with respect to the blended values.
    d_alpha: (height, width), the gradient with respect to alpha; None means zero.
    fields: fields of the slots; with absolute gradients if `gradients.absolute` is wanted.
    """
    height, width, depth = d_pixels.shape
    lists, cells, most = of.lists, of.blended.cells_from_sorted, most_gradients(device)
    tiles_x, pairs = -(-width // TILE), lists.gaussian_from_sorted.shape[0]
    by_cell = _gradient_by_cell(device, work, of, d_pixels, d_alpha)
    listed = (lists.ranges, lists.gaussian_from_sorted, lists.slot_from_sorted)
    planes = (of.projected.splats, of.values, by_cell, of.blended.transmittance, of.blended.stops)
    for first, count in passes(0, depth, most):
        geometry = first == 0
        own = {"GEOMETRY": True, **fields.defines} if geometry else {}
        slots = work.array("slots", (pairs, count + (SLOT_MOMENT_FIELDS + 2 * fields.absolute if geometry else 0)))
        defines = {"VALUES": count, **({"RECORD_CELLS": True} if cells else {}), **own}
        arrays = (*listed, *planes, slots, *([cells] if cells else []))
        if pairs:
            launch_tiles(device, "values_grad", defines, lists, tiles_x, height, depth, first, *arrays)
        if geometry:
            splats_grad(device, of.projected, Slots(slots, first_slots, fields), gradients, kept=count)
        else:
            add_values(device, of.projected, Slots(slots, first_slots), gradients.values, first, count)


def _gradient_by_cell(
    device: Device, work: Workspace, of: ValuePass, d_pixels: DeviceArray, d_alpha: DeviceArray | None
) -> DeviceArray:
    """Reorder the image's gradient as `values_grad` reads it: (tiles, D + 1, pixels of a tile)."""
    height, width, depth = d_pixels.shape
    by_cell = work.array("gradient_by_cell", (of.lists.band.tiles, depth + 1, TILE * TILE))
    given = [] if d_alpha is None else [d_alpha]
    defines = {"VALUES": min(most_gradients(device), depth), **({"ALPHA_GRADIENT": True} if given else {})}
    arguments = (width, height, depth, d_pixels, of.background, *given, by_cell)
    tiles_x = -(-width // TILE)
    launch_tiles(device, "values_grad", defines, of.lists, tiles_x, *arguments, kernel="gradient_by_cell")
    return by_cell
