# SPDX-License-Identifier: Apache-2.0
"""duplicate.cl and ranges.cl: every tile that a Gaussian shows in lists it, once, front to back."""

from __future__ import annotations

import numpy as np
import pytest
import scenes
from pipeline import Pipeline

from clsplat.device.context import Device
from clsplat.reference import render as reference
from clsplat.reference.tiles import touched_tiles

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


@pytest.mark.parametrize("name", NAMES)
def test_few_tiles_are_listed_in_vain(device: Device, name: str) -> None:
    scene = make(name)
    run = Pipeline.run(device, scene)
    projected = reference.forward(*scene).projected
    wanted = sum(len(t) for t in touched_tiles(projected, run.camera.width, run.camera.height))
    listed = sum(len(t) for t in run.tiles_of())
    # An ellipse can pass between pixel centres of a tile that it reaches; more than this means a loose test.
    assert listed <= 1.15 * wanted + 4


@pytest.mark.parametrize("name", IN_EVERY_SHAPE)
def test_lists_are_front_to_back(shaped_device: Device, name: str) -> None:
    run = Pipeline.run(shaped_device, make(name))
    depths = run.splat("DEPTH")[:, 0]
    lists = run.frame.lists
    gaussians = lists.gaussian_from_sorted.get()
    for begin, end in lists.ranges.get():
        listed = gaussians[begin:end]
        order = np.lexsort((listed, depths[listed]))
        np.testing.assert_array_equal(order, np.arange(len(listed)))


def test_equal_depths_go_by_index(device: Device) -> None:
    run = Pipeline.run(device, scenes.equal_depth())
    pairs = run.frame.pairs
    gaussians = pairs.gaussian_from_slot.get()[pairs.slot_from_pair.get()]
    assert len(np.unique(gaussians)) > 1
    np.testing.assert_array_equal(gaussians, np.sort(gaussians))
