# SPDX-License-Identifier: Apache-2.0
"""splats.cl and splats_grad.cl against the float64 twin."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
import pytest
from compare import assert_close, assert_close_gradient, assert_same_bits
from flat import Flat, cloud
from numpy.typing import NDArray

from clsplat.device.buffers import Workspace, from_host, hosted, upload
from clsplat.device.context import Device
from clsplat.layouts.columns import SPLAT, TILE, SlotFields
from clsplat.reference import splats as twin
from clsplat.selftest.cases.library import conics_of
from clsplat.stages.project import Projected, Slots
from clsplat.stages.splats import ScreenGaussians, ScreenGradients, add_values, splats, splats_grad

WIDTH, HEIGHT = 70, 50
WHITEN = np.sqrt(np.log2(np.e) / 2)


def screen(device: Device, flat: Flat) -> ScreenGaussians:
    means, conics, opacities, colours, depths, radii = (from_host(device, array) for array in flat.arrays)
    return ScreenGaussians(radii, means, conics, opacities, depths, colours)


def run(
    device: Device, flat: Flat, *, listed: bool = False
) -> tuple[dict[str, NDArray[np.float32]], NDArray[np.uint32]]:
    """Columns of the splats by name, and the tile counts."""
    projected = splats(device, Workspace(device), screen(device, flat), WIDTH, HEIGHT, listed=listed)
    rows = projected.splats.get()
    return {name: rows[:, k] for k, name in enumerate(SPLAT)}, projected.tile_counts.get()


def test_tiles_are_those_that_the_box_or_the_ellipse_reaches(device: Device) -> None:
    flat = cloud(200, WIDTH, HEIGHT, seed=3)
    _, tiles = run(device, flat)
    half = twin.splats(*(array.astype(np.float64) for array in (flat.conics, flat.opacities)), flat.radii).half_extents
    # those with a pixel's middle in the box, which has at most 16 of them here
    low, high = np.ceil((flat.means2d - half + 0.5) / TILE) - 1, np.floor((flat.means2d + half - 0.5) / TILE) + 1
    across = -(-np.array([WIDTH, HEIGHT]) // TILE)
    sides = np.clip(high, 0, across) - np.clip(low, 0, across)
    box = np.where((half > 0).all(axis=1), np.maximum(sides, 0).prod(axis=1), 0)
    assert (tiles >= box).all()
    assert (tiles == box).mean() > 0.97  # but where the box ends within a hundredth of a pixel of the middle


def test_a_needle_keeps_its_width(device: Device) -> None:
    """Of the float32 conic, whose determinant is a difference of numbers that are a million times as large."""
    sides = np.array([[400.0, 0.6], [300.0, 0.55], [90.0, 0.7], [4.0, 4.0]])
    conics = conics_of(sides, np.array([0.7, 2.2, 1.1, 0.0]))
    flat = cloud(4, WIDTH, HEIGHT)
    flat = replace(flat, conics=conics, radii=np.full((4, 2), 9, np.int32), opacities=np.full(4, 0.5, np.float32))
    flat = replace(flat, means2d=np.full((4, 2), 25.0, np.float32))
    got, tiles = run(device, flat)
    assert (tiles > 0).all()
    a, b, c = conics.astype(np.longdouble).T  # float64 keeps four digits of it
    wanted = np.sqrt((a * c - b * b) / a).astype(np.float64)
    assert_close(got["L22"] / WHITEN, wanted, relative=1e-6)  # roundings of the quotient and the root


def test_what_is_no_ellipse_is_culled(device: Device) -> None:
    flat = cloud(9, WIDTH, HEIGHT, seed=1)
    flat = replace(flat, radii=np.full((9, 2), 9, np.int32), means2d=np.full((9, 2), 20.0, np.float32))
    flat = replace(flat, opacities=np.full(9, 0.5, np.float32), conics=np.tile(np.float32([0.2, 0.0, 0.2]), (9, 1)))
    flat.means2d[1, 0] = np.nan
    flat.means2d[2, 1] = np.inf
    flat.conics[3] = [0.1, 0.2, 0.1]  # a saddle
    flat.conics[4, 0] = np.nan
    flat.conics[5, 2] = 0.0
    flat.opacities[6] = 1 / 300
    flat.opacities[7] = np.nan
    flat.depths[8] = np.inf
    _, tiles = run(device, flat)
    assert tiles[0] > 0
    assert not tiles[1:].any()
    rows, _ = run(device, flat, listed=True)
    assert_same_bits(rows["LOG2O"][1:], np.full(8, -1e3, np.float32))
    assert all(np.isfinite(rows[name]).all() for name in SPLAT if name != "UNUSED")


def test_fewer_values_than_a_splat_has_colours(device: Device) -> None:
    flat = replace(cloud(30, WIDTH, HEIGHT), colours=cloud(30, WIDTH, HEIGHT, 2).colours)
    got, tiles = run(device, flat)
    assert_same_bits(got["GREEN"][tiles > 0], flat.colours[tiles > 0, 1])
    assert not got["BLUE"][tiles > 0].any()


@pytest.mark.parametrize("count", [1, 64, 65])
@pytest.mark.parametrize(("kept", "depth", "absolute"), [(3, 3, True), (3, 1, False), (5, 9, True)])
def test_the_gradient_against_the_twin(device: Device, count: int, kept: int, depth: int, absolute: bool) -> None:
    rng = np.random.default_rng(count)
    flat = replace(cloud(count, WIDTH, HEIGHT, depth), radii=np.full((count, 2), 9, np.int32))
    made = splats(device, Workspace(device), screen(device, flat), WIDTH, HEIGHT, listed=True)
    tiles = rng.integers(0, 4, count).astype(np.uint32)
    first = (np.cumsum(tiles) - tiles).astype(np.uint32)
    fields = SlotFields(absolute=absolute)
    rows = rng.normal(size=(int(tiles.sum()), 6 + kept + 2 * absolute)).astype(np.float32)
    sums = np.zeros((count, rows.shape[1]))
    np.add.at(sums, np.repeat(np.arange(count), tiles), rows.astype(np.float64))
    by = [hosted(device, shape) for shape in ((count, 2), (count, 3), (count,), (count, depth), (count, 2))]
    for one in by:
        one.array.fill(np.nan)
    gradients = ScreenGradients(*(one.array for one in by))
    projected = Projected(made.splats, upload(device, tiles))
    slots = Slots(upload(device, rows), upload(device, first), fields)
    splats_grad(device, projected, slots, gradients, kept=kept)
    moments = sums[:, :6] * np.array([1, 1 / WHITEN, 1 / WHITEN, *[1 / WHITEN**2] * 3])
    drawn = flat.opacities > 1 / 255
    wanted = twin.splats_grad(flat.conics.astype(np.float64), flat.opacities.astype(np.float64), moments)
    for one, of in zip(by, (wanted.means2d, wanted.conics, wanted.opacities), strict=False):
        got, seen = one.get(), drawn & (tiles > 0)
        assert not got[tiles == 0].any()
        if seen.any():
            assert_close_gradient(got[seen], of[seen], 1e-5)  # sums of a few float32, and a lean of up to some tens
    got = by[3].get()
    assert_close(got[:, :kept], sums[:, 6 : 6 + min(kept, depth)], absolute=1e-6)  # sums of three numbers of order one
    assert np.isnan(got[:, kept:]).all()
    if absolute:
        assert_close(by[4].get(), sums[:, -2:] / WHITEN**2, absolute=2e-6)  # of three numbers, times 1.4
    if depth > kept:
        more = rng.normal(size=(len(rows), depth - kept)).astype(np.float32)
        add_values(
            device, projected, Slots(upload(device, more), slots.first_slots), gradients.values, kept, depth - kept
        )
        sums = np.zeros((count, depth - kept))
        np.add.at(sums, np.repeat(np.arange(count), tiles), more.astype(np.float64))
        assert_close(by[3].get()[:, kept:], sums, absolute=1e-6)  # as above
