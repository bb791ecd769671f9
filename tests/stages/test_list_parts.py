# SPDX-License-Identifier: Apache-2.0
"""The gradient of blending in lists of several parts, each walked by a group of its own (kernels/shared/parts.h)."""

from __future__ import annotations

from dataclasses import replace
from functools import cache

import numpy as np
import pytest
from compare import assert_same_arrays, assert_same_bits
from pipeline import BACKGROUND, Pipeline, assert_gradients, shaped
from quick import quick
from scenes import Scene, make_gaussians, random_sh, straight_camera, world_from_pixels

from clsplat.camera import Projection
from clsplat.device.buffers import upload
from clsplat.device.context import Device
from clsplat.layouts.columns import PLAIN_SLOTS, TILE, SlotFields
from clsplat.rendering.rasterizer import PairCapacity, Rasterizer
from clsplat.stages.blend import PART_PAIRS, Blended
from clsplat.stages.device_gaussians import upload_gaussians

pytestmark = pytest.mark.slow  # groups of work-items
LENGTHS = (1, PART_PAIRS - 1, PART_PAIRS, PART_PAIRS + 1, 2 * PART_PAIRS, 2 * PART_PAIRS + 1, 3000)
WALL_GAUSSIANS = 4
WALLS = (40, PART_PAIRS - 4, 2 * PART_PAIRS - 1, 2 * PART_PAIRS + 3, 2 * PART_PAIRS + 300)
"""Places in a list of walls: in a part that some pixels do not leave, just before a boundary, across and after one, and
in the last part."""
EVERY_FIELD = SlotFields(absolute=True, contributions=True, nearness=True)
VARIANTS = {
    "colour": (3, PLAIN_SLOTS),
    "alpha": (4, PLAIN_SLOTS),
    "nearness": (4, SlotFields(nearness=True)),
    "everything": (5, EVERY_FIELD),
}
"""Planes of the image's gradient, and fields."""
PART_TOLERANCE = 1e-5
"""Error allowed of a field of the slots, relative to the field's largest value: shapes add in different orders. 3e-6
was seen, with parts and without."""


@cache
def listed(count: int, walls: tuple[int, ...] = (), tiles: int = 1) -> Scene:
    """A row of tiles, with `count` faint Gaussians in the first tile, some of which reach the next.

    walls: places in the list of a few opaque Gaussians each, which end the pixels of a strip of the first tile.
    """
    rng = np.random.default_rng(7)
    camera = straight_camera(TILE * tiles, TILE, float(TILE))
    pixels, depths = rng.uniform(0, TILE, (count, 2)), np.linspace(2.0, 6.0, count)
    axes, opacities = rng.uniform(1.0, 4.0, (count, 3)), rng.uniform(0.005, 0.02, count)
    quaternions = rng.normal(size=(count, 4))
    width = TILE / max(len(walls), 1)
    for k, place in enumerate(walls):
        wall = slice(place, place + WALL_GAUSSIANS)
        pixels[wall] = (k + 0.5) * width, TILE / 2
        axes[wall], opacities[wall], quaternions[wall] = (0.75 * width, 4 * TILE, 1.0), 0.999, (1.0, 0.0, 0.0, 0.0)
    log_scales = np.log(depths[:, None] / camera.fx * axes)
    means = world_from_pixels(camera, pixels, depths)
    return make_gaussians(means, quaternions, log_scales, opacities, random_sh(rng, count)), camera


def nearer(run: Pipeline) -> Pipeline:
    """The same pass with nearness."""
    run.frame = run.rasterizer.forward(run.gaussians, run.camera, run.frame.background, nearness=True)
    return run


def noise(blended: Blended, planes: int = 3) -> np.ndarray:
    """Random gradients of an image in planes."""
    return np.random.default_rng(3).standard_normal((planes, *blended.stops.shape)).astype(np.float32)


def slots_of(run: Pipeline, variant: str) -> np.ndarray:
    planes, fields = VARIANTS[variant]
    return run.slots(noise(run.frame.blended, planes), fields)


@pytest.mark.parametrize("count", quick(LENGTHS, PART_PAIRS, PART_PAIRS + 1, 3000))
def test_lists_of_any_length(device: Device, count: int) -> None:
    scene = listed(count)
    run = Pipeline.run(shaped(device, 1, 64), scene)
    assert run.frame.listed.lists.ranges.get().tolist() == [[0, count]]
    assert_gradients(run, scene)


def test_pixels_end_before_at_and_after_a_boundary(device: Device) -> None:
    scene = listed(1500, WALLS)
    run = Pipeline.run(shaped(device, 1, 64), scene)
    stops = set(run.frame.blended.stops.get().ravel().tolist())
    assert {2 * PART_PAIRS - 1, 2 * PART_PAIRS, 2 * PART_PAIRS + 2} <= stops, sorted(stops)
    for first, end in ((40, 50), (PART_PAIRS - 4, PART_PAIRS), (2 * PART_PAIRS + 300, 1500)):
        assert stops & set(range(first, end)), sorted(stops)
    assert_gradients(run, scene, SlotFields(absolute=True, contributions=True))


def test_a_list_that_all_pixels_end_early(device: Device) -> None:
    """No state is kept at later boundaries, and all later slots are zero."""
    scene = listed(1500, tuple(range(200, 280, WALL_GAUSSIANS)))
    run = Pipeline.run(shaped(device, 1, 64), scene)
    last = run.frame.blended.stops.get().max()
    assert 200 < last < PART_PAIRS
    run.rasterizer.work.array("slots", (1500, 9)).fill(np.nan)
    assert_gradients(run, scene)
    by_place = slots_of(run, "colour")[run.frame.listed.lists.slot_from_sorted.get()]
    assert by_place[:last].any(axis=1).sum() > last // 2
    assert not by_place[last:].any()


@pytest.mark.parametrize(
    ("variant", "projection"),
    [
        ("everything", "fisheye"),
        *(
            pytest.param(*pair, marks=pytest.mark.slow)
            for pair in (
                *(("colour", "perspective"), ("alpha", "fisheye"), ("nearness", "perspective")),
                ("everything", "perspective"),
            )
        ),
    ],
)
def test_other_gradients_are_those_of_a_lone_item(device: Device, variant: str, projection: Projection) -> None:
    gaussians, camera = listed(1500, WALLS, 2)
    scene = (gaussians, replace(camera, projection=projection))
    group, alone = (nearer(Pipeline.run(shaped(device, *shape), scene)) for shape in ((1, 64), (1, 1)))
    lists = group.frame.listed.lists
    assert_same_bits(lists.ranges.get(), alone.frame.listed.lists.ranges.get())
    assert np.diff(lists.ranges.get().astype(int)).max() > 2 * PART_PAIRS
    assert group.frame.blended.parts is not None
    assert alone.frame.blended.parts is None
    got, wanted = slots_of(group, variant), slots_of(alone, variant).astype(np.float64)
    size = np.abs(wanted).max(axis=0)
    assert size.min() > 0
    assert (np.abs(got - wanted).max(axis=0) <= PART_TOLERANCE * size).all()


@pytest.mark.slow
@pytest.mark.parametrize("variant", ["colour", "everything"])
def test_groups_of_32_to_256_items_have_the_same_bits(default_device: Device, variant: str) -> None:
    scene = listed(1500, WALLS, 2)
    runs = [nearer(Pipeline.run(shaped(default_device, 1, items), scene)) for items in (64, 32, 128, 256)]
    first, *others = (slots_of(run, variant) for run in runs)
    for each in others:
        assert_same_bits(each, first)


def test_every_driver_and_every_run_have_the_same_bits(device: Device, default_device: Device) -> None:
    scene = listed(1500, WALLS, 2)
    got, wanted = (slots_of(Pipeline.run(shaped(each, 1, 64), scene), "colour") for each in (device, default_device))
    assert_same_bits(got, wanted)


@pytest.mark.parametrize("appends", [True, False])
def test_a_pass_by_capacity_has_the_same_bits(device: Device, appends: bool) -> None:
    """Its arrays are too large, and hold the states of a pass with more pairs."""
    own, scene = shaped(device, 1, 64), listed(1500, WALLS, 2)
    wanted = slots_of(Pipeline.run(own, scene), "colour")
    rasterizer, room = Rasterizer(own), PairCapacity(8000, 1, appends)
    for gaussians, camera in (listed(3000, (), 2), scene):
        model, background = upload_gaussians(own, gaussians), np.array(BACKGROUND, np.float32)
        frame = rasterizer.forward(model, camera, background, room=room)
        slots = rasterizer.pair_gradients(frame, upload(own, noise(frame.blended))).values.get()
    assert len(wanted) + PART_PAIRS < len(slots)
    assert_same_bits(slots[: len(wanted)], wanted)


def test_bands_have_the_same_bits(device: Device) -> None:
    """Only the states of the last band are kept, so that each band is blended again for its own."""
    own, scene = shaped(device, 1, 64), listed(1500, WALLS, 2)
    whole, banded = (Pipeline.run(own, scene, capacity=capacity) for capacity in (10**6, 1600))
    assert (len(whole.frame.bands), len(banded.frame.bands)) == (1, 2)
    d_image = np.random.default_rng(5).standard_normal((whole.camera.height, whole.camera.width, 3))
    (wanted, on_image), (got, screen) = whole.backward(d_image), banded.backward(d_image)
    assert_same_arrays(got.arrays(), wanted.arrays())
    assert_same_bits(screen[whole.visible], on_image[whole.visible])
    assert_same_bits(banded.frame.blended.image.get(), whole.frame.blended.image.get())


def test_a_frame_without_a_gradient_in_view_keeps_no_states(device: Device) -> None:
    """Blending again makes them for a gradient after all."""
    run = Pipeline.run(shaped(device, 1, 64), listed(1500, WALLS, 2))
    wanted, image = slots_of(run, "colour"), run.image
    run.frame = run.rasterizer.forward(run.gaussians, run.camera, run.frame.background, backward=False)
    assert run.frame.blended.parts is None
    assert_same_bits(slots_of(run, "colour"), wanted)
    assert_same_bits(run.image, image)
