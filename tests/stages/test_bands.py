# SPDX-License-Identifier: Apache-2.0
"""Bands of tiles: whatever fits in memory at once, frames and gradients have the same bits."""

from __future__ import annotations

import numpy as np
import pytest
from compare import assert_same_arrays, assert_same_bits
from pipeline import Pipeline
from quick import quick
from scenes import NAMED, SHAPE_MATTERS, overlap, random_cloud

from clsplat.config.rasterizer import BenchSwitches, RasterizerConfig
from clsplat.device.buffers import upload
from clsplat.device.context import Device
from clsplat.errors import CapacityError
from clsplat.stages.blend import count_pairs
from clsplat.stages.duplicate import Band


def most_in_a_tile(run: Pipeline) -> int:
    ranges = run.frame.listed.lists.ranges.get().astype(int)
    return int((ranges[:, 1] - ranges[:, 0]).max())


def in_bands(device: Device, name: str, capacity: int, config: RasterizerConfig | None = None) -> Pipeline:
    return Pipeline.run(device, NAMED[name](), config=config, capacity=capacity)


def check(
    device: Device,
    name: str,
    capacity: int | None = None,
    config: RasterizerConfig | None = None,
    *,
    absolute: bool = False,
) -> None:
    whole = Pipeline.run(device, NAMED[name](), config=config)
    total = whole.frame.listed.pairs.tile_keys.shape[0]
    banded = in_bands(device, name, capacity or most_in_a_tile(whole), config)
    assert whole.frame.bands == (Band(0, len(whole.frame.listed.lists.ranges.get())),)
    assert len(banded.frame.bands) >= (2 if most_in_a_tile(whole) < total else 1)
    assert_same_bits(banded.frame.blended.image.get(), whole.frame.blended.image.get())
    assert_same_bits(banded.frame.blended.transmittance.get(), whole.frame.blended.transmittance.get())
    d_image = np.random.default_rng(5).standard_normal((whole.camera.height, whole.camera.width, 3))
    wanted, wanted_screen = whole.backward(d_image, absolute=absolute)
    got, screen = banded.backward(d_image, absolute=absolute)
    visible = whole.visible
    assert_same_bits(screen[visible], wanted_screen[visible])
    assert_same_arrays(got.arrays(), wanted.arrays())


@pytest.mark.slow
@pytest.mark.parametrize("name", sorted(NAMED))
def test_bands_change_no_bit(default_device: Device, name: str) -> None:
    check(default_device, name)


@pytest.mark.slow
@pytest.mark.parametrize("name", quick(SHAPE_MATTERS, "overlap"))
def test_in_every_shape(shaped_device: Device, name: str) -> None:
    whole = Pipeline.run(shaped_device, NAMED[name]())
    check(shaped_device, name, capacity=max(most_in_a_tile(whole), whole.frame.listed.pairs.tile_keys.shape[0] // 3))


@pytest.mark.parametrize("name", ["random_cloud", "overlap", "many_per_tile"])
def test_bands_of_squares_whose_pairs_are_sorted(default_device: Device, name: str) -> None:
    check(default_device, name, config=BenchSwitches(tile_test="square", depth_sort="pairs", key_bits="all"))


@pytest.mark.slow
def test_absolute_gradients(default_device: Device) -> None:
    check(default_device, "overlap", absolute=True)


def test_bands_begin_and_end_within_a_row_of_tiles(default_device: Device) -> None:
    whole = Pipeline.run(default_device, random_cloud(300, 11, 70, 50))
    ranges = whole.frame.listed.lists.ranges.get().astype(int)
    counts, tiles_x = ranges[:, 1] - ranges[:, 0], 5
    capacity = int(counts.max())
    bands = in_bands(default_device, "random_cloud", capacity).frame.bands
    assert [band.first for band in bands] == [0, *(band.end for band in bands[:-1])]
    assert bands[-1].end == len(counts)
    assert any(band.first % tiles_x for band in bands)
    totals = [int(counts[band.first : band.end].sum()) for band in bands]
    assert max(totals) <= capacity
    assert all(one + counts[band.end] > capacity for one, band in zip(totals, bands[:-1], strict=False)), "none smaller"


@pytest.mark.slow
def test_a_pixel_that_the_first_gaussian_of_a_band_ends(default_device: Device) -> None:
    """It has a stop of 0 there, which once was taken for padding."""
    config = RasterizerConfig(transmittance_min=0.4)
    frames = [in_bands(default_device, "saturating", capacity, config).frame for capacity in (10**6, 60)]
    assert len(frames[1].bands) > 2
    assert_same_bits(frames[1].blended.image.get(), frames[0].blended.image.get())


def test_one_tile_too_full_says_so(default_device: Device) -> None:
    with pytest.raises(CapacityError, match=r"one tile of 16x16 pixels has \d+ Gaussians, but .* room for only 3: "):
        in_bands(default_device, "many_per_tile", 3)


def test_counted_pairs_are_those_of_one_band(default_device: Device) -> None:
    def counted(run: Pipeline) -> list[int]:
        work, splats = run.rasterizer.work, run.frame.projected.splats
        found = [
            count_pairs(default_device, work, part.lists, splats, run.frame.background, run.camera)
            for part in (run.rasterizer.listed(run.frame, band) for band in run.frame.bands)
        ]
        return [sum(column) for column in zip(*found, strict=True)]

    assert counted(in_bands(default_device, "overlap", 50)) == counted(Pipeline.run(default_device, overlap()))


def test_without_a_pair(default_device: Device) -> None:
    gaussians, camera = overlap()
    gaussians.opacity_logits[:] = -20
    run = Pipeline.run(default_device, (gaussians, camera), capacity=0)
    gradients, _ = run.backward(np.ones((camera.height, camera.width, 3)))
    assert not any(values.any() for values in gradients.arrays().values())


@pytest.mark.parametrize("name", ["random_cloud", "overlap", "many_per_tile"])
def test_a_larger_band_needs_no_room_for_the_one_before(default_device: Device, name: str) -> None:
    """Arrays grow from band to band, each freed before its successor is made: memory in use never falls."""
    capacity = most_in_a_tile(Pipeline.run(default_device, NAMED[name]()))
    device = default_device.with_memory_limit(2**40)
    run = in_bands(device, name, capacity)
    assert len(run.frame.bands) > 1
    assert device.memory.peak == device.memory.used
    gradient = upload(device, np.zeros(run.frame.blended.image.shape, np.float32))
    slots = run.rasterizer.pair_gradients(run.frame, gradient)
    assert slots.first_slots is None
    assert device.memory.peak == device.memory.used
