# SPDX-License-Identifier: Apache-2.0
"""blend.cl against the float64 twin, closed forms and itself in other shapes."""

from __future__ import annotations

from dataclasses import replace
from types import SimpleNamespace
from typing import Any, cast

import numpy as np
import pytest
import scenes
from compare import assert_close, assert_close_gradients, assert_close_images, assert_same_arrays, assert_same_bits
from pipeline import BACKGROUND, Pipeline, shaped
from quick import quick

from clsplat.camera import Camera
from clsplat.config.rasterizer import BenchSwitches, RasterizerConfig
from clsplat.device.buffers import upload
from clsplat.device.context import Device
from clsplat.device.drivers.quirks import subgroup_ways
from clsplat.device.drivers.shapes import Shape
from clsplat.device.launch import launch_groups
from clsplat.gaussians import Gaussians
from clsplat.layouts.columns import SLOT_PLAIN, SlotFields
from clsplat.models.edit import take
from clsplat.reference import render as reference
from clsplat.rendering.build_flags import kernel_defines
from clsplat.rendering.rasterizer import Rasterizer
from clsplat.stages.blend import frame_items
from clsplat.stages.device_gaussians import upload_gaussians

SIZES = ((1, 1), (15, 16), (16, 16), (17, 15), (33, 1), (1, 40), (64, 48))


def assert_image(device: Device, name: str) -> None:
    scene = scenes.NAMED[name]()
    wanted = reference.forward(*scene, BACKGROUND).blended
    # 2e-5 is the project's contract for a frame; the band is where a threshold may fall the other way.
    assert_close_images(Pipeline.run(device, scene).image, wanted.image, 2e-5, ignore=wanted.margin < 1e-4)


@pytest.mark.smoke
@pytest.mark.parametrize("name", scenes.NAMED)
def test_image(device: Device, name: str) -> None:
    assert_image(device, name)


@pytest.mark.parametrize("name", scenes.SHAPE_MATTERS)
def test_image_in_every_shape(shaped_device: Device, name: str) -> None:
    assert_image(shaped_device, name)


@pytest.mark.parametrize("size", SIZES, ids=str)
def test_sizes_at_the_seams(shaped_device: Device, size: tuple[int, int]) -> None:
    scene = scenes.random_cloud(200, 3, *size)
    run = Pipeline.run(shaped_device, scene)
    wanted = reference.forward(*scene, BACKGROUND).blended
    assert run.image.shape == (size[1], size[0], 3)
    assert_close_images(run.image, wanted.image, 2e-5, ignore=wanted.margin < 1e-4)
    padded = run.frame.blended.image.get()
    assert not padded[:, : size[1], size[0] :].any(), "right of the image is not black"
    assert not padded[:, size[1] :].any(), "below the image is not black"


HARD = {
    "needles": scenes.needles,
    "saturating": scenes.saturating,
    "cloud": lambda: scenes.random_cloud(900, 8, 75, 50),
}


@pytest.mark.slow
@pytest.mark.parametrize("name", HARD)
@pytest.mark.parametrize("items", quick([8, 16, 32, 64, 128, 256], 32, 256))
def test_a_group_of_any_size_has_the_bits_of_a_lone_item(default_device: Device, items: int, name: str) -> None:
    """Blocks that an ellipse is found not to reach have no pixel of it: a needle's ellipse cuts them at any angle."""
    scene = HARD[name]()
    alone, group = (Pipeline.run(shaped(default_device, 1, size), scene).frame.blended for size in (1, items))
    assert_same_bits(group.image.get(), alone.image.get())
    assert_same_bits(group.transmittance.get(), alone.transmittance.get())
    assert_same_bits(group.stops.get(), alone.stops.get())


@pytest.mark.parametrize(("kind", "group", "units", "tiles", "items"), [
    ("gpu", 1024, 132, 2112, 256),
    ("gpu", 1024, 132, 2113, 128),
    ("gpu", 1024, 132, 4224, 128),
    ("gpu", 1024, 132, 4225, 64),
    ("gpu", 1024, 132, 100_000, 64),
    ("gpu", 1024, 132, 1, 256),
    ("gpu", 128, 132, 1, 128),
    ("cpu", 1024, 132, 1, 64),
])  # fmt: skip
def test_few_tiles_are_shared_by_more_items(kind: str, group: int, units: int, tiles: int, items: int) -> None:
    limits = SimpleNamespace(max_compute_units=units)
    device = SimpleNamespace(kind=kind, max_group=group, cl_device=limits, shape=Shape(lanes=1, items=64, chunks=8))
    assert frame_items(cast("Device", device), tiles) == items


def launched_as_on_a_gpu(device: Device, monkeypatch: pytest.MonkeyPatch) -> list[int]:
    """Let a device count as a GPU. Returns a list to which each launch of blending adds the size of its groups."""
    groups: list[int] = []

    def launch(*arguments: Any) -> None:
        groups.append(arguments[3])
        launch_groups(*arguments)

    monkeypatch.setattr(device, "kind", "gpu")
    monkeypatch.setattr("clsplat.stages.blend.launch_groups", launch)
    return groups


def test_a_gpu_blends_few_tiles_in_larger_groups(default_device: Device, monkeypatch: pytest.MonkeyPatch) -> None:
    device, scene = shaped(default_device, 1, 64), HARD["cloud"]()
    frame = Pipeline.run(device, scene).frame.blended
    alone = [plane.get() for plane in (frame.image, frame.transmittance, frame.stops)]
    groups = launched_as_on_a_gpu(device, monkeypatch)
    wide = Pipeline.run(device, scene).frame.blended
    assert groups == [256], "20 tiles for the units of a CPU"
    for plane, wanted in zip((wide.image, wide.transmittance, wide.stops), alone, strict=True):
        assert_same_bits(plane.get(), wanted)


@pytest.mark.slow
@pytest.mark.parametrize("items", quick([16, 32, 64, 128, 256], 32, 128))
def test_the_gradient_of_a_group_of_any_size(default_device: Device, items: int) -> None:
    scene = scenes.many_per_tile()
    d_image = np.random.default_rng(2).standard_normal((scene[1].height, scene[1].width, 3))
    alone, group = (Pipeline.run(shaped(default_device, 1, size), scene).backward(d_image)[0] for size in (1, items))
    # two orders of adding up 256 numbers, sqrt(256) half ulp where nothing cancels, and the light behind a Gaussian in
    # two forms, an ulp more
    assert_close_gradients(group.arrays(), alone.arrays(), 2e-6)


def noise(run: Pipeline) -> np.ndarray:
    """Gradients by the planes of an image."""
    return np.random.default_rng(0).standard_normal(run.frame.blended.image.shape).astype(np.float32)


def stacked(count: int) -> tuple[Gaussians, Camera]:
    """A tile, and so many thin Gaussians before each other in it."""
    gaussians, camera = scenes.one(16, 16)
    arrays = {name: np.repeat(values, count, axis=0) for name, values in gaussians.arrays().items()}
    shift = np.random.default_rng(count).uniform(-0.1, 0.1, (count, 3))
    arrays["means"] = (arrays["means"] + shift).astype(np.float32)
    arrays["opacity_logits"][:] = -3
    return replace(gaussians, **arrays), camera


@pytest.mark.slow
@pytest.mark.parametrize("count", [1, 31, 32, 33, 64, 65, 300])
def test_the_gradient_by_gaussian(device: Device, count: int) -> None:
    """An item takes every 32nd pair of a tile's list, and the last ones walk to the end of the tile alone."""
    scene = stacked(count)
    d_image = np.random.default_rng(2).standard_normal((16, 16, 3))
    fields = SlotFields(absolute=True, contributions=True)
    twin = reference.render_grad(*scene, d_image, BACKGROUND)
    wanted = {**twin.parameters, "screen": twin.abs_means2d, "contributions": twin.contributions}
    for items in (32, 64):
        run = Pipeline.run(shaped(device, 1, items, True), scene)
        assert run.frame.listed.lists.gaussian_from_sorted.shape == (count,)
        gradients, screen = run.screened(d_image, fields)
        assert screen.contributions is not None
        on_image = {"screen": screen.gradients.get(), "contributions": screen.contributions.get()}
        # as of groups above; a single item is up to 3.3e-6 off in lists of 300, where it takes out light by light
        assert_close_gradients({**gradients.arrays(), **on_image}, wanted, 2e-6)


@pytest.mark.parametrize("items", quick([32, 64, 128, 256], 64))
@pytest.mark.parametrize("fields", [SlotFields(), SlotFields(absolute=True, contributions=True)], ids=["plain", "all"])
def test_sums_by_sub_groups_have_the_bits_of_rows(device: Device, items: int, fields: SlotFields) -> None:
    """Of every size of sub-groups, by each way that the driver has: items end with one field, with a few, or share
    one; sums of all of a group, or parts of them."""
    if not (offered := subgroup_ways(device.cl_device)):
        pytest.skip("the driver has no sub-groups of a size that is known")
    rows, slots = shaped(device, 1, items), {}
    scene = scenes.random_cloud(900, 8, 75, 50)
    shuffles = {name for way in offered for name in way if name.startswith("SHUFFLE")}
    sizes = (4, 8, 16, 32)
    asked = [{"SUBGROUP": size, name: True, "SUBGROUP_IS_ASKED": True} for name in sorted(shuffles) for size in sizes]
    for switches in ({}, *asked):
        run = Pipeline.run(rows.with_switches(switches), scene)
        slots[str(switches)] = run.slots(noise(run), fields)
    wanted, *others = slots.values()
    assert wanted.any() and len(others) >= 4
    for got in others:
        assert_same_bits(got, wanted)


@pytest.mark.slow
@pytest.mark.parametrize("switch", ["row_skip", "column_skip"])
def test_the_gradient_by_gaussian_has_its_bits_with_every_switch(device: Device, switch: str) -> None:
    """A pair beyond a pixel's stop, or a block that an ellipse does not reach, adds zeros alone."""
    slots = []
    scene, by_gaussian = scenes.random_cloud(900, 8, 75, 50), shaped(device, 1, 32, True)
    for config in (BenchSwitches(), BenchSwitches(**{switch: False})):  # type: ignore[arg-type]
        run = Pipeline.run(by_gaussian.with_switches(kernel_defines(config)), scene)
        slots.append(run.slots(noise(run)) + np.float32(0))
    assert_same_bits(slots[0], slots[1])
    assert slots[0].any()


@pytest.mark.parametrize("colour", [0.0, 0.25, 1.0])
def test_furnace(shaped_device: Device, colour: float) -> None:
    gaussians, camera = scenes.random_cloud(300, 2, 50, 40, degree=0)
    gaussians.sh[:] = (colour - 0.5) / 0.28209479177387814
    image = Pipeline.run(shaped_device, (gaussians, camera), (colour, colour, colour)).image
    # Weights and what is left add up to 1, but for a rounding per Gaussian.
    assert_close(image, np.full(image.shape, colour), absolute=3e-6)


def test_a_lone_gaussian_is_its_formula(shaped_device: Device) -> None:
    gaussians, camera = scenes.one()
    p = reference.forward(gaussians, camera).projected
    x, y = np.meshgrid(np.arange(camera.width) + 0.5, np.arange(camera.height) + 0.5)
    dx, dy = x - p.means2d[0, 0], y - p.means2d[0, 1]
    a, b, c = p.conics[0]
    alpha = np.minimum(0.99, p.opacities[0] * np.exp(-0.5 * (a * dx * dx + 2 * b * dx * dy + c * dy * dy)))
    alpha[alpha < 1 / 255] = 0
    wanted = alpha[:, :, None] * p.colors[0] + (1 - alpha[:, :, None]) * np.array(BACKGROUND)
    assert_close(Pipeline.run(shaped_device, (gaussians, camera)).image, wanted, absolute=2e-6)


def test_order_in_memory_does_not_matter(device: Device) -> None:
    gaussians, camera = scenes.random_cloud(500, 4, 60, 40)
    order = np.random.default_rng(0).permutation(len(gaussians))
    first = Pipeline.run(device, (gaussians, camera)).image
    assert_same_bits(Pipeline.run(device, (take(gaussians, order), camera)).image, first)


def test_saturated_pixels_stop_where_the_contract_says(shaped_device: Device) -> None:
    scene = scenes.saturating()
    run, wanted = Pipeline.run(shaped_device, scene), reference.forward(*scene).blended
    clear = wanted.margin > 1e-4
    got = run.crop(run.frame.blended.transmittance.get())
    assert_close(got[clear], wanted.transmittance[clear], relative=1e-4, absolute=1e-7)
    assert got.min() > 1e-4, "the Gaussian that would end a pixel is not added"


def test_stacked_opaque_gaussians(shaped_device: Device) -> None:
    """Two layers at the cap leave (1 - 0.99)^2, a hair under the limit in float32: both sides decide alike."""
    gaussians, camera = scenes.one(96, 64)
    arrays = {name: np.repeat(values, 3, axis=0) for name, values in gaussians.arrays().items()}
    arrays["means"][:, 2] += np.float32([0, 0.5, 1])
    arrays["opacity_logits"][:] = 12
    arrays["sh"][1] = 0.8
    scene = (replace(gaussians, **arrays), camera)
    wanted = reference.forward(*scene, BACKGROUND).blended.image
    assert_close_images(Pipeline.run(shaped_device, scene).image, wanted, 2e-5, flips=1e-3)
    assert np.abs(wanted - wanted[0, 0]).max() > 0.1, "the Gaussians are to be seen"


LANES = [*((8, name) for name in scenes.SHAPE_MATTERS), pytest.param(16, "overlap", marks=pytest.mark.slow)]


@pytest.mark.parametrize(("lanes", "name"), LANES)
def test_recorded_cells_are_those_that_contribute(device: Device, lanes: int, name: str) -> None:
    """The gradient has the same bits as without the record, and a pair without cells has none."""
    run = Pipeline.run(shaped(device, lanes, 1), scenes.NAMED[name]())
    blended = run.frame.blended
    assert blended.cells_from_sorted is not None
    recorded = run.slots(noise(run))
    assert_same_bits(recorded, run.slots(noise(run), blended=replace(blended, cells_from_sorted=None)))
    empty = blended.cells_from_sorted.get() == 0
    assert not recorded[run.frame.listed.lists.slot_from_sorted.get()[empty]].any()
    assert recorded.any()


@pytest.mark.parametrize(("lanes", "name"), LANES)
def test_cells_without_a_gradient_are_left_out(device: Device, lanes: int, name: str) -> None:
    """As good as visiting them, which contributions want, but for the sign of zeros; some pairs lie in such cells
    alone."""
    values = noise(run := Pipeline.run(shaped(device, lanes, 1), scenes.NAMED[name]()))
    values[:, :, : values.shape[2] // 2] = 0.0
    values[:, 5] = 0.0
    ways = (SlotFields(), SlotFields(contributions=True))
    slots = [run.slots(values, fields)[:, :SLOT_PLAIN] + np.float32(0) for fields in ways]
    assert_same_bits(slots[0], slots[1])
    assert slots[0].any()


@pytest.mark.parametrize("rubbish", [np.nan, np.inf, 1e30])
def test_gradients_in_padding_are_not_looked_at(shaped_device: Device, rubbish: float) -> None:
    """Nobody writes them: memory that was something else's lies there."""
    values, slots = noise(run := Pipeline.run(shaped_device, scenes.random_cloud(200, 3, 33, 19))), []
    for padding in (0.0, rubbish):
        values[:, 19:], values[:, :, 33:] = padding, padding
        slots.append(run.slots(values))
    assert_same_bits(slots[0] + np.float32(0), slots[1] + np.float32(0))


def test_without_a_gradient_nothing_is_recorded(default_device: Device) -> None:
    gaussians, camera = scenes.NAMED["overlap"]()
    rasterizer = Rasterizer(default_device)
    background = upload(default_device, np.array(BACKGROUND, np.float32))
    on_device = upload_gaussians(default_device, gaussians)
    frame = rasterizer.forward(on_device, camera, background, backward=False)
    without = frame.blended.image.get()
    assert frame.blended.cells_from_sorted is None
    assert_same_bits(without, rasterizer.forward(on_device, camera, background).blended.image.get())


WAYS = {
    "default": (RasterizerConfig(), SlotFields()),
    "absolute and contributions": (RasterizerConfig(), SlotFields(absolute=True, contributions=True)),
    "nothing recorded": (BenchSwitches(record_cells=False), SlotFields()),
    "no early stop": (BenchSwitches(early_stop=False), SlotFields()),
}


@pytest.mark.parametrize("way", WAYS)
@pytest.mark.parametrize("name", quick(["saturating", "random_cloud", "needles", "overlap"], "saturating", "needles"))
def test_no_bit_knows_of_the_width(device: Device, name: str, way: str) -> None:
    """Blending by two vectors of the shape in one has the bits of one at a time. Both are the same code without
    AVX-512."""
    config, fields = WAYS[way]
    usual = shaped(device, 8, 1)
    wide, narrow = (
        Pipeline.run(each, scenes.NAMED[name](), config=config)
        for each in (usual, usual.with_switches({"NARROW": True}))
    )
    for array in ("image", "transmittance", "stops"):
        assert_same_bits(getattr(wide.frame.blended, array).get(), getattr(narrow.frame.blended, array).get(), array)
    gradient = np.random.default_rng(3).normal(size=(wide.camera.height, wide.camera.width, 3))
    gradient[:, : wide.camera.width // 3] = 0  # cells, and halves of them, that have none
    got, wanted = (pipeline.screened(gradient, fields) for pipeline in (wide, narrow))
    # a sum that is zero may be so with either sign
    assert_same_arrays(*({name: a + np.float32(0) for name, a in each.arrays().items()} for each, _ in (got, wanted)))
    shown = wide.visible  # nobody writes other rows
    screens = [screen.gradients.get()[shown] + np.float32(0) for _, screen in (got, wanted)]
    assert_same_bits(*screens, "screen")
    if fields.contributions:
        assert got[1].contributions is not None
        assert wanted[1].contributions is not None
        assert_same_bits(got[1].contributions.get()[shown], wanted[1].contributions.get()[shown], "contributions")
