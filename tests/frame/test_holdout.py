# SPDX-License-Identifier: Apache-2.0
"""Frames held out: against the float64 twin, closed forms, and the model without what is behind."""

from __future__ import annotations

from dataclasses import replace
from typing import Any

import numpy as np
import pytest
import scenes
from compare import assert_close, assert_same_bits
from numpy.typing import NDArray
from pipeline import EVERY_SHAPE, shaped, shapes_of

from clsplat.camera import Camera
from clsplat.config.pictures import FramingConfig
from clsplat.device.context import Device
from clsplat.device.selection import open_device
from clsplat.frame.draw import drawn_by
from clsplat.frame.holdout import Cut
from clsplat.frame.samples import supersampled
from clsplat.frame.strips import in_strips
from clsplat.gaussians import Gaussians
from clsplat.images.holdouts import Holdout, Surfaces, surfaces_of
from clsplat.reference import holdout as twin
from clsplat.reference import render as reference
from clsplat.rendering.renderer import Renderer

BACKGROUND = (0.2, 0.4, 0.6)
CLOUD = scenes.random_cloud(600, 8, 70, 50)
EVERYTHING = ("rgb", "alpha", "depth", "median", "first", "normals", "position", "count", "id")


def layered(camera: Camera, seed: int = 3) -> list[tuple[NDArray[Any], NDArray[Any], NDArray[Any]]]:
    """Three surfaces a pixel in no order, of which the second has a length; opaque ones; none at the left."""
    random, shape = np.random.default_rng(seed), (camera.height, camera.width)
    made = []
    for k in range(3):
        begin = random.uniform(2, 8, shape).astype(np.float32)
        end = (begin + (k == 1) * random.uniform(0, 3, shape)).astype(np.float32)
        alpha = np.where(random.random(shape) < 0.2, 1, random.uniform(0.1, 0.9, shape)).astype(np.float32)
        begin[:, : camera.width // 3] = end[:, : camera.width // 3] = np.inf
        made.append((begin, end, alpha))
    return made


def stacked(layers: Any) -> Surfaces:
    return surfaces_of(*(np.stack(parts, axis=2).astype(np.float64) for parts in zip(*layers, strict=True)))


def wall(camera: Camera, depth: float | NDArray[Any], alpha: float = 1.0) -> Surfaces:
    """One surface in each pixel."""
    begin = np.broadcast_to(np.float64(depth), (camera.height, camera.width))[:, :, None]
    return surfaces_of(begin, begin, np.full(begin.shape, alpha))


def in_front(gaussians: Gaussians, camera: Camera, depth: float) -> Gaussians:
    """The model without what is not in front of a depth; the same number of Gaussians, so that ids stay."""
    depths = (gaussians.means.astype(np.float64) @ camera.rotation.T + camera.translation)[:, 2]
    return replace(gaussians, opacity_logits=np.where(depths < depth, gaussians.opacity_logits, -20).astype(np.float32))


def test_against_the_twin(shaped_device: Device) -> None:
    gaussians, camera = CLOUD
    layers = layered(camera)
    got = Renderer(shaped_device).render(gaussians, camera, BACKGROUND, holdout=stacked(layers))
    plain = Renderer(shaped_device).render(gaussians, camera, BACKGROUND)
    forward = reference.forward(gaussians, camera)
    image, alpha = twin.held_out(forward.projected, camera.width, camera.height, layers, BACKGROUND)
    sure = forward.blended.margin > 1e-4
    assert sure.mean() > 0.9 and np.abs(plain.alpha - alpha)[sure].max() > 0.5
    # Sums of a few dozen float32 products, as of the picture itself.
    assert_close(got.image[sure], image[sure], absolute=2e-5)
    assert_close(got.alpha[sure], alpha[sure], absolute=2e-5)
    free = np.s_[:, : camera.width // 3]  # no surface
    assert_same_bits(np.ascontiguousarray(got.image[free]), np.ascontiguousarray(plain.image[free]))
    assert_same_bits(np.ascontiguousarray(got.alpha[free]), np.ascontiguousarray(plain.alpha[free]))


@pytest.mark.slow
@EVERY_SHAPE
def test_the_same_bits_in_every_shape(device: Device, every: bool) -> None:
    gaussians, camera = CLOUD
    surfaces = stacked(layered(camera))
    drawn = []
    for shape in shapes_of(device, (4, 1), every=every):
        picture, made = Renderer(shaped(device, *shape)).render_channels(gaussians, camera, holdout=surfaces)
        drawn.append([picture.image, picture.alpha, *made.values()])
    for others in drawn[1:]:
        for got, wanted in zip(others, drawn[0], strict=True):
            assert_same_bits(got, wanted)


def test_one_gaussian_and_one_surface(default_device: Device) -> None:
    gaussians, camera = scenes.one()
    renderer = Renderer(default_device)
    plain = renderer.render(gaussians, camera)
    depth = float(reference.forward(gaussians, camera).projected.depths[0])
    near, far = depth - 0.5, depth + 0.5
    behind = renderer.render(gaussians, camera, holdout=wall(camera, far))
    assert_same_bits(behind.image, plain.image)
    assert_same_bits(behind.alpha, plain.alpha)
    for surface in (near, float(np.float32(depth))):  # what is at a surface's own depth is behind it
        gone = renderer.render(gaussians, camera, BACKGROUND, holdout=wall(camera, surface))
        assert not gone.image.any() and not gone.alpha.any()
    through = renderer.render(gaussians, camera, holdout=wall(camera, near, 0.25))
    assert_close(through.alpha, 0.75 * plain.alpha, absolute=1e-7)
    assert_close(through.image, 0.75 * plain.image, absolute=1e-7)
    shape = (camera.height, camera.width, 1)
    within = surfaces_of(np.full(shape, depth - 0.5), np.full(shape, depth + 1.0), np.full(shape, 0.875))
    third = renderer.render(gaussians, camera, holdout=within)  # a third of the length in front: half of the light
    assert_close(third.alpha, 0.5 * plain.alpha, absolute=1e-6)


@pytest.mark.parametrize("depth", [3.0, 4.5])
def test_a_wall_shows_the_model_cut_there(default_device: Device, depth: float) -> None:
    """Every channel is that of the model without what is behind the wall."""
    gaussians, camera = CLOUD
    renderer = Renderer(default_device)
    got = drawn_by(renderer, gaussians, cut=Cut(Holdout(wall(camera, depth), 0, 0, (70, 50))))(camera, EVERYTHING)
    wanted = drawn_by(renderer, in_front(gaussians, camera, depth))(camera, EVERYTHING)
    # A pixel ends where the whole list would: at most 1e-4 of its light is behind that.
    same = (got["count"] == wanted["count"]) & (np.abs(got["alpha"] - wanted["alpha"]) < 1e-6)
    assert same.mean() > 0.99 and (wanted["count"] > 0).mean() > 0.1
    assert_close(got["alpha"], wanted["alpha"], absolute=1.1e-4)
    for name in EVERYTHING:
        # the sum of weights and one minus the product of what they leave: a few roundings each; depths are up to 10
        assert_close(got[name][same], wanted[name][same], absolute=1e-5 if name in ("depth", "position") else 2e-6)


@pytest.mark.slow
def test_windows_strips_and_little_memory_change_no_bit() -> None:
    gaussians, camera = scenes.random_cloud(20_000, 4, 300, 200, degree=1)
    names = ("rgb", "alpha", "depth")
    cut = Cut(Holdout(stacked(layered(camera)), 0, 0, (300, 200)))
    draw = drawn_by(Renderer(), gaussians, cut=cut)
    whole = draw(camera, names)
    part, striped = draw(camera.cropped(37, 21, 100, 60), names), in_strips(draw, 64)(camera, names)
    larger = draw(camera.cropped(-16, -8, 340, 216), names)
    limit = 14 << 20
    renderer = Renderer(open_device(None, limit))
    little = drawn_by(renderer, gaussians, cut=cut)(camera, names)
    assert renderer.device.memory.peak <= limit
    for name in names:
        for got, wanted in (
            (part[name], whole[name][21:81, 37:137]),
            (striped[name], whole[name]),
            (little[name], whole[name]),
            (larger[name][8:208, 16:316], whole[name]),
        ):
            assert_same_bits(np.ascontiguousarray(got), np.ascontiguousarray(wanted))


def test_supersampling_takes_each_pixels_own(default_device: Device) -> None:
    gaussians, camera = CLOUD
    depth = np.where(np.arange(camera.width) % 2 == 0, 1.0, np.inf)[None].repeat(camera.height, axis=0)
    cut, framing = Cut(Holdout(wall(camera, depth), 0, 0, (70, 50))), FramingConfig(supersample=3)
    got = supersampled(drawn_by(Renderer(default_device), gaussians, cut=cut), framing)(camera, ("rgb", "alpha"))
    wanted = supersampled(drawn_by(Renderer(default_device), gaussians), framing)(camera, ("rgb", "alpha"))
    for name in ("rgb", "alpha"):
        assert not got[name][:, ::2].any() and wanted[name][:, ::2].any()
        assert_same_bits(np.ascontiguousarray(got[name][:, 1::2]), np.ascontiguousarray(wanted[name][:, 1::2]))


def test_depths_are_along_the_axis_where_kernels_have_distances(default_device: Device) -> None:
    """Gaussians at z = 2 and a wall just behind and in front of it: at the corners their distances are 2.9."""
    camera = replace(scenes.straight_camera(64, 64), fx=43.0, fy=43.0, cx=32.0, cy=32.0)
    across = np.linspace(-1.4, 1.4, 29)
    local = np.stack([*(axis.ravel() for axis in np.meshgrid(across, across)), np.full(29 * 29, 2.0)], axis=1)
    count = len(local)
    gaussians = scenes.make_gaussians(
        (local - camera.translation) @ camera.rotation,
        np.tile([1.0, 0, 0, 0], (count, 1)),
        np.full((count, 3), np.log(0.01)),
        np.full(count, 0.9),
        np.zeros((count, 1, 3)),
    )
    gaussians.by_rays, camera = True, camera.along_rays(True)
    plain = Renderer(default_device).render(gaussians, camera)
    drawn = {}
    for depth in (1.9, 2.1):  # a pixel of the corner is 1 % of the distance away from the Gaussian's mean
        cut = Cut(Holdout(wall(camera, depth), 0, 0, (64, 64)))
        drawn[depth] = drawn_by(Renderer(default_device), gaussians, cut=cut)(camera, ("alpha",))["alpha"]
    assert not drawn[1.9].any() and plain.alpha.mean() > 0.1
    assert_same_bits(np.ascontiguousarray(drawn[2.1]), plain.alpha)
