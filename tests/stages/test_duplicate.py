# SPDX-License-Identifier: Apache-2.0
"""duplicate.cl and ranges.cl: every tile that a Gaussian shows in lists it, once, front to back."""

from __future__ import annotations

import numpy as np
import pytest
import scenes
from numpy.typing import NDArray
from pipeline import Pipeline, shaped
from quick import quick

from clsplat.config.rasterizer import BenchSwitches
from clsplat.device.buffers import Workspace, upload
from clsplat.device.context import Device
from clsplat.layouts.columns import SPLAT
from clsplat.reference import project as reference_project
from clsplat.reference import render as reference
from clsplat.reference.tiles import touched_tiles
from clsplat.stages import scan as stages_scan
from clsplat.stages.duplicate import count
from clsplat.stages.project import Projected
from clsplat.stages.scan import MAX_SINGLE_CHUNK_ELEMENTS
from clsplat.stages.sort import BITONIC_KEYS_BY_KIND

NAMES = [*scenes.NAMED, "cloud"]
IN_EVERY_SHAPE = ["off_frustum", "equal_depth", "cloud"]
"""Scans and sorts differ in shape: some culled, equal keys, and more than one group."""


def make(name: str):  # type: ignore[no-untyped-def]
    return scenes.random_cloud(900, 5, 150, 90) if name == "cloud" else scenes.NAMED[name]()


@pytest.mark.parametrize("name", NAMES)
def test_lists_hold_every_tile_that_is_reached(device: Device, name: str) -> None:
    assert_lists_hold_every_tile(device, name)


@pytest.mark.parametrize("name", IN_EVERY_SHAPE)
def test_lists_hold_every_tile_in_every_shape(shaped_device: Device, name: str) -> None:
    assert_lists_hold_every_tile(shaped_device, name)


def assert_lists_hold_every_tile(device: Device, name: str) -> None:
    scene = make(name)
    run = Pipeline.run(device, scene)
    projected = reference.forward(*scene).projected
    # A hair inside the threshold: at it float32 may decide otherwise, and nothing is lost.
    wanted = touched_tiles(projected, run.camera.width, run.camera.height, threshold=(1 + 1e-5) / 255)
    got = run.tiles_of()
    for gaussian, tiles in enumerate(wanted):
        assert set(tiles) <= got[gaussian], gaussian
    assert [len(tiles) for tiles in got] == list(run.frame.projected.tile_counts.get())


@pytest.mark.parametrize("name", quick(NAMES, "cloud", "equal_depth"))
def test_few_tiles_are_listed_in_vain(device: Device, name: str, monkeypatch: pytest.MonkeyPatch) -> None:
    scene = make(name)
    run = Pipeline.run(device, scene)
    monkeypatch.setattr("clsplat.rendering.rasterizer.kernel_defines", lambda _config, *, antialiased: {"SMALL_BOX": 0})
    exact = Pipeline.run(device, scene)
    projected = reference.forward(*scene).projected
    wanted = sum(len(t) for t in touched_tiles(projected, run.camera.width, run.camera.height))
    listed = [len(t) for t in exact.tiles_of()]
    # An ellipse can pass between pixel centres of a tile that it reaches; more than this means a loose test.
    assert sum(listed) <= 1.15 * wanted + 4
    for gaussian, tiles in enumerate(run.tiles_of()):
        assert listed[gaussian] <= len(tiles) <= max(listed[gaussian], 16), "whole boxes, if they are small"


@pytest.mark.parametrize("name", IN_EVERY_SHAPE)
def test_lists_are_front_to_back(shaped_device: Device, name: str) -> None:
    run = Pipeline.run(shaped_device, make(name))
    depths = run.splat("DEPTH")[:, 0]
    lists = run.frame.listed.lists
    gaussians = lists.gaussian_from_sorted.get()
    for begin, end in lists.ranges.get():
        listed = gaussians[begin:end]
        order = np.lexsort((listed, depths[listed]))
        np.testing.assert_array_equal(order, np.arange(len(listed)))


def test_equal_depths_go_by_index(device: Device) -> None:
    run = Pipeline.run(device, scenes.equal_depth())
    pairs = run.frame.listed.pairs
    gaussians = pairs.pair_ids.get()[:, 1]
    assert len(np.unique(gaussians)) > 1
    np.testing.assert_array_equal(gaussians, np.sort(gaussians))


def square_tiles(
    projected: reference_project.ProjectedTwin, width: int, height: int, *, slack: float = 0.0, threshold: float
) -> list[NDArray[np.int64]]:
    """Tiles that have a pixel centre in a square around each Gaussian, like `touched_tiles`.

    The square is that of the longest half axis of the ellipse where alpha is `threshold`, made wider by `slack` pixels:
    what Kerbl et al.'s code lists, but for its extent of 3 sigma. The kernels' set with tile_test "square" lies between
    those of slack 0 and of a little more.
    """
    tile = 16
    tiles_x, tiles_y = -(-width // tile), -(-height // tile)
    result = []
    for gaussian, visible in enumerate(projected.visible):
        if not visible:
            result.append(np.zeros(0, np.int64))
            continue
        sxx, sxy, syy = projected.covariances[gaussian]
        larger = 0.5 * (sxx + syy) + np.hypot(0.5 * (sxx - syy), sxy)
        budget = max(2 * np.log(projected.opacities[gaussian] / threshold), 0.0)
        reach = np.sqrt(budget * larger) + slack
        low, high = projected.means2d[gaussian] - reach, projected.means2d[gaussian] + reach
        first = np.clip(np.ceil((low - (tile - 0.5)) / tile), 0, (tiles_x, tiles_y)).astype(np.int64)
        end = np.clip(np.floor((high - 0.5) / tile) + 1, 0, (tiles_x, tiles_y)).astype(np.int64)
        columns, rows = np.arange(first[0], max(end[0], first[0])), np.arange(first[1], max(end[1], first[1]))
        result.append((rows[:, None] * tiles_x + columns).ravel())
    return result


@pytest.mark.parametrize("name", quick(NAMES, "cloud", "equal_depth"))
def test_squares_are_those_of_the_longest_half_axis(device: Device, name: str) -> None:
    scene = make(name)
    run = Pipeline.run(device, scene, config=BenchSwitches(tile_test="square"))
    projected, camera = reference.forward(*scene).projected, run.camera
    size = camera.width, camera.height
    # A hair inside the threshold as above; TILE_SLACK is 0.01 pixels, and float32 loses a part in 1e5 of wide squares.
    inner = square_tiles(projected, *size, threshold=(1 + 1e-5) / 255)
    reach = np.where(projected.visible, projected.half_extents.max(axis=-1), 0).max()
    outer = square_tiles(projected, *size, slack=0.02 + 1e-5 * reach, threshold=(1 - 1e-5) / 255)
    for gaussian, got in enumerate(run.tiles_of()):
        assert set(inner[gaussian]) <= got <= set(outer[gaussian]), gaussian
    assert [len(tiles) for tiles in run.tiles_of()] == list(run.frame.projected.tile_counts.get())


@pytest.mark.parametrize("name", IN_EVERY_SHAPE)
@pytest.mark.parametrize("key_bits", ["needed", "all"])
def test_sorting_all_pairs_makes_the_same_lists(shaped_device: Device, key_bits: str, name: str) -> None:
    wanted = Pipeline.run(shaped_device, make(name)).frame
    config = BenchSwitches(depth_sort="pairs", key_bits=key_bits)  # type: ignore[arg-type]  # one of them
    got = Pipeline.run(shaped_device, make(name), config=config).frame
    for array in ("ranges", "gaussian_from_sorted", "slot_from_sorted"):
        arrays = [getattr(frame.listed.lists, array).get() for frame in (got, wanted)]
        np.testing.assert_array_equal(*arrays, array)


def counted(device: Device, depths: np.ndarray, visible: np.ndarray, **options: bool):  # type: ignore[no-untyped-def]
    splats = np.zeros((len(depths), len(SPLAT)), np.float32)
    splats[:, SPLAT.index("DEPTH")] = depths
    tiles = np.where(visible, 3, 0).astype(np.uint32)
    return count(device, Workspace(device), Projected(upload(device, splats), upload(device, tiles)), **options)


@pytest.mark.parametrize("n", [1, 2, 63, 64, 65, 1025, 9000, MAX_SINGLE_CHUNK_ELEMENTS + 1])
def test_key_bits_are_those_in_which_the_visible_depths_differ(shaped_device: Device, n: int) -> None:
    rng = np.random.default_rng(n)
    depths, visible = rng.uniform(1.5, 11, n).astype(np.float32), rng.random(n) < 0.7
    visible[0] = True
    depths[~visible] = rng.choice([1e-3, 1e5, -1.0], int((~visible).sum()))  # of culled Gaussians: whatever was there
    keys = depths[visible].view(np.uint32)
    got = counted(shaped_device, depths, visible)
    assert (got.visible, got.pairs) == (visible.sum(), 3 * visible.sum())
    assert got.least_key == keys.min()
    assert got.key_bits == max(int(keys.max() - keys.min()).bit_length(), 1)
    np.testing.assert_array_equal(got.depth_keys.get(), keys)
    np.testing.assert_array_equal(got.gaussian_from_visible.get(), np.flatnonzero(visible))
    every = counted(shaped_device, depths, visible, all_bits=True)
    assert (every.least_key, every.key_bits) == (0, 32)


@pytest.mark.parametrize("items", quick((2, 4, 8)))
def test_key_bits_in_small_groups(device: Device, items: int) -> None:
    """Intel's CPU driver inverts keys wrongly there in a loop that takes a maximum."""
    depths = np.linspace(7, 3, 65).astype(np.float32)
    got = counted(shaped(device, 1, items), depths, depths < 6)
    keys = depths[depths < 6].view(np.uint32)
    assert (got.least_key, got.key_bits) == (keys.min(), int(keys.max() - keys.min()).bit_length())


def test_key_bits_of_no_gaussian_and_of_equal_ones(shaped_device: Device) -> None:
    none = counted(shaped_device, np.ones(70, np.float32), np.zeros(70, np.bool_))
    assert (none.visible, none.pairs, none.key_bits) == (0, 0, 1)
    assert counted(shaped_device, np.full(70, 4.0, np.float32), np.ones(70, np.bool_)).key_bits == 1


def test_fewer_bits_are_fewer_launches(default_device: Device, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(stages_scan, "MAX_SINGLE_CHUNK_ELEMENTS", 0)  # else one item sorts so few alone, in one launch
    monkeypatch.setattr(stages_scan, "MIN_CHUNK_ELEMENTS", 256)
    monkeypatch.setitem(BITONIC_KEYS_BY_KIND, default_device.kind, 0)  # of so few, which a GPU sorts in one launch
    device = default_device.with_shape()  # with a recorder of its own: nobody else's launches are counted
    gaussians, camera = make("cloud")
    # Depths from 2 to 3 differ in 22 bits: two digits of 11 rather than three.
    camera = scenes.straight_camera(camera.width, camera.height)
    rng = np.random.default_rng(0)
    pixels = rng.uniform(0, 1, (len(gaussians), 2)) * (camera.width, camera.height)
    gaussians.means[:] = scenes.world_from_pixels(camera, pixels, rng.uniform(2, 3, len(gaussians)))
    launches = {}
    for key_bits in ("needed", "all"):
        config = BenchSwitches(key_bits=key_bits)  # type: ignore[arg-type]  # one of them
        run = Pipeline.run(device, (gaussians, camera), config=config)
        with device.recorder.recording(wait=False) as stages:
            run.rasterizer.forward(run.gaussians, run.camera, run.frame.background)
        launches[key_bits] = {name: stages[name].launches for name in ("duplicate", "ranges")}
    for name in ("duplicate", "ranges"):
        assert launches["needed"][name] < launches["all"][name], name
