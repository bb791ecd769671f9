# SPDX-License-Identifier: Apache-2.0
"""What has gone wrong in other programs of this kind, a test each that the suite would not have by another name.

docs/numerics.md lists those that are tested elsewhere.
"""

from __future__ import annotations

from dataclasses import replace

import numpy as np
import pytest
import scenes
from compare import assert_close_gradient, assert_close_images, assert_same_bits
from pipeline import BACKGROUND, Pipeline

from clsplat.device.context import Device
from clsplat.gaussians import Gaussians
from clsplat.layouts.columns import TILE, SlotFields
from clsplat.reference import render as reference
from clsplat.reference.blend import BLEND_ALPHA_MAX
from clsplat.reference.tiles import touched_tiles

GROUPS = ("means", "quaternions", "log_scales", "opacity_logits", "sh")


def flat(opacity: float, count: int = 1) -> tuple[Gaussians, scenes.Camera]:
    """Gaussians so wide that alpha is their opacity all over a small image."""
    return scenes.make_gaussians(
        np.tile([0.0, 0.0, 2.0], (count, 1)) + np.arange(count)[:, None] * [0, 0, 0.1],
        np.tile([1.0, 0.1, 0.2, 0.3], (count, 1)),
        np.tile(np.log([30.0, 40.0, 60.0]), (count, 1)),
        np.full(count, opacity),
        scenes.random_sh(np.random.default_rng(1), count, 1),
    ), scenes.straight_camera(12, 9)


def image_gradient(run: Pipeline, seed: int = 1) -> np.ndarray:
    return np.random.default_rng(seed).standard_normal((run.camera.height, run.camera.width, 3))


def test_alpha_at_its_cap_passes_a_colour_gradient_alone(device: Device) -> None:
    """A cap of another value in the gradient than in the frame; a gradient through what is capped."""
    run = Pipeline.run(device, flat(0.999))
    assert_same_bits(run.frame.blended.transmittance.get()[:9, :12], np.full((9, 12), np.float32(1) - np.float32(0.99)))
    got, screen = run.backward(image_gradient(run))
    assert got.sh.any()
    for group in ("quaternions", "log_scales", "opacity_logits"):
        assert not getattr(got, group).any(), group
    assert not screen.any()


def test_alpha_just_under_its_cap_passes_all(device: Device) -> None:
    scene = flat(0.9 * BLEND_ALPHA_MAX)
    run = Pipeline.run(device, scene)
    d_image = image_gradient(run)
    got, _ = run.backward(d_image)
    wanted = reference.render_grad(*scene, d_image, BACKGROUND)
    assert got.opacity_logits.any()
    for group in GROUPS:
        assert_close_gradient(getattr(got, group), wanted.parameters[group], 1e-4, name=group)


@pytest.mark.parametrize("length", [1e-3, 0.5, 30.0])
def test_the_gradient_of_a_quaternion_falls_with_its_length(device: Device, length: float) -> None:
    """The normalisation left out of the gradient: it would be the same whatever the length."""
    gaussians, camera = scenes.overlap()
    unit = gaussians.quaternions / np.linalg.norm(gaussians.quaternions, axis=1, keepdims=True)
    found = []
    for factor in (1.0, length):
        run = Pipeline.run(device, (replace(gaussians, quaternions=(factor * unit).astype(np.float32)), camera))
        found.append(run.backward(image_gradient(run))[0].quaternions * factor)
    assert_close_gradient(found[1], found[0], 1e-5)


@pytest.mark.parametrize("raw", [0.0, 1e-42, 1e-30, 1e30, np.inf])
def test_quaternions_without_a_direction_are_culled_alone(device: Device, raw: float) -> None:
    gaussians, camera = scenes.overlap()
    quaternions = gaussians.quaternions.copy()
    quaternions[5] = raw
    run = Pipeline.run(device, (replace(gaussians, quaternions=quaternions), camera))
    assert not run.visible[5]
    got, _ = run.backward(image_gradient(run))
    for group in GROUPS:
        assert np.isfinite(getattr(got, group)).all()
        assert not getattr(got, group)[5].any()


def test_transmittance_recovered_by_division_ends_at_one(shaped_device: Device) -> None:
    """Two expressions for one alpha, fused in one kernel and not in the other: what is recovered overshoots 1."""
    run = Pipeline.run(shaped_device, scenes.saturating())
    _, screen = run.screened(image_gradient(run), SlotFields(contributions=True))
    assert screen.contributions is not None
    weights = screen.contributions.get()[run.visible].astype(np.float64).sum()
    left = run.crop(run.frame.blended.transmittance.get()).astype(np.float64).sum()
    pixels = run.camera.width * run.camera.height
    assert abs(weights + left - pixels) <= 1e-5 * pixels


def test_the_last_contributor_is_the_frame_s_own(device: Device) -> None:
    """The Gaussian that would end a pixel is in neither frame nor gradient; what is behind it in neither, too."""
    scene = flat(0.98, count=5)  # 0.02^2 = 4e-4 goes on, 0.02^3 = 8e-6 would be under 1e-4
    run = Pipeline.run(device, scene)
    got, _ = run.backward(image_gradient(run))
    assert all(got.sh[i].any() for i in (0, 1))
    assert not any(getattr(got, group)[2:].any() for group in GROUPS)


def test_after_an_opacity_reset_the_whole_ellipse_learns(device: Device) -> None:
    """At 0.01 alpha falls to 1/255 at 1.37 sigma: what is within has its gradient, up to the edge."""
    gaussians, camera = scenes.overlap()
    scene = replace(gaussians, opacity_logits=np.full(len(gaussians), np.log(0.01 / 0.99), np.float32)), camera
    run = Pipeline.run(device, scene)
    forward = reference.forward(*scene)
    d_image = image_gradient(run)
    d_image[forward.blended.margin < 1e-4] = 0
    got, _ = run.backward(d_image)
    wanted = reference.render_grad(*scene, d_image, BACKGROUND)
    assert (wanted.parameters["opacity_logits"] != 0).sum() > 20
    for group in GROUPS:
        assert_close_gradient(getattr(got, group), wanted.parameters[group], 1e-4, name=group)


@pytest.mark.parametrize("cx", [-0.6, 0.1, 0.9, 1.6])
def test_clamps_follow_an_off_centre_principal_point(device: Device, cx: float) -> None:
    """The Jacobian's ratios clamped as if the principal point were in the middle."""
    gaussians, camera = scenes.overlap()
    moved = replace(camera, cx=cx * camera.width, cy=(1 - cx) * camera.height)
    pixels = np.random.default_rng(3).uniform(-0.8, 1.8, (len(gaussians), 2)) * (moved.width, moved.height)
    depths = np.random.default_rng(4).uniform(2, 5, len(gaussians))
    means = scenes.world_from_pixels(moved, pixels, depths).astype(np.float32)
    scene = replace(gaussians, means=means, log_scales=gaussians.log_scales + np.float32(1.5)), moved
    run = Pipeline.run(device, scene)
    forward = reference.forward(*scene, BACKGROUND)
    band = forward.blended.margin < 1e-4
    assert_close_images(run.image, forward.blended.image, 1e-5, ignore=band)
    d_image = image_gradient(run)
    d_image[band] = 0
    got, _ = run.backward(d_image)
    wanted = reference.render_grad(*scene, d_image, BACKGROUND)
    for group in GROUPS:
        assert_close_gradient(getattr(got, group), wanted.parameters[group], 1e-4, name=group)


@pytest.mark.parametrize("tiles", [1, 2, 4, 8])
def test_numbers_of_tiles_that_are_powers_of_two(device: Device, tiles: int) -> None:
    """Keys a bit too narrow for the last tile."""
    scene = scenes.random_cloud(200, 5, TILE * tiles, TILE)
    run = Pipeline.run(device, scene)
    forward = reference.forward(*scene, BACKGROUND)
    assert_close_images(run.image, forward.blended.image, 1e-5, ignore=forward.blended.margin < 1e-4)
    assert run.frame.listed.lists.ranges.shape[0] == tiles


@pytest.mark.parametrize("depth", [-1e-3, -1.0, -1e7])
def test_behind_the_camera_there_are_no_ghosts(device: Device, depth: float) -> None:
    """A negative depth whose bits, taken for an integer, sort behind all others; an ellipse seen through the lens."""
    gaussians, camera = scenes.one()
    camera = replace(camera, translation=np.array([0.0, 0.0, depth - 4.0]))
    run = Pipeline.run(device, (gaussians, camera))
    assert not run.visible.any()
    np.testing.assert_array_equal(run.image, np.broadcast_to(np.float32(BACKGROUND), run.image.shape))


@pytest.mark.parametrize("corner", [(0.5, 0.5), (16.5, 0.5), (0.5, 16.5), (16.5, 16.5), (15.5, 15.5), (16.0, 16.0)])
def test_means_on_the_corner_of_a_tile(device: Device, corner: tuple[float, float]) -> None:
    """A tile test with a side of the mean chosen by a sign, which is 0 here."""
    rng = np.random.default_rng(2)
    camera = scenes.straight_camera(64, 64)
    means = scenes.world_from_pixels(camera, np.tile(corner, (60, 1)), np.full(60, 2.0))
    sizes = np.exp(rng.uniform(np.log(0.3), np.log(40.0), (60, 3)))
    scene = scenes.make_gaussians(
        means, rng.normal(size=(60, 4)), np.log(sizes * 2 / 64), rng.uniform(0.01, 0.9, 60), scenes.random_sh(rng, 60)
    )
    run = Pipeline.run(device, (scene, camera))
    wanted = reference.forward(scene, camera).projected
    for found, needed in zip(run.tiles_of(), touched_tiles(wanted, 64, 64, threshold=(1 + 1e-5) / 255), strict=True):
        assert found.issuperset(needed.tolist())


def test_a_view_without_gaussians_has_no_gradients(shaped_device: Device) -> None:
    """No tile begins, no group is launched, nothing is read that nobody wrote."""
    gaussians, camera = scenes.overlap()
    away = replace(camera, rotation=np.diag([-1.0, 1.0, -1.0]) @ camera.rotation)
    run = Pipeline.run(shaped_device, (gaussians, replace(away, translation=np.array([0.0, 0.0, -100.0]))))
    assert not run.visible.any()
    got, _ = run.backward(image_gradient(run))
    for group in GROUPS:
        assert not getattr(got, group).any()


def test_infinite_scales_are_culled(device: Device) -> None:
    """A radius that is NaN, and keys for tiles that nobody writes."""
    gaussians, camera = scenes.overlap()
    log_scales = gaussians.log_scales.copy()
    log_scales[3], log_scales[4], log_scales[5] = np.inf, 3e38, np.nan
    run = Pipeline.run(device, (replace(gaussians, log_scales=log_scales), camera))
    assert not run.visible[3:6].any()
    assert np.isfinite(run.image).all()


def test_faint_gaussians_are_culled_before_their_logarithm(device: Device) -> None:
    """log(255 o) of o < 1/255 is negative, and its root NaN."""
    gaussians, camera = scenes.overlap()
    logits = np.full(len(gaussians), -np.log(254), np.float32)
    logits[::2] -= np.float32(1e-4)
    logits[1::2] += np.float32(1e-4)
    run = Pipeline.run(device, (replace(gaussians, opacity_logits=logits), camera))
    assert not run.visible[::2].any()
    halves = run.splat("HALF_W", "HALF_H")[run.visible]
    assert len(halves) > 0
    assert np.isfinite(halves).all()


def test_colours_far_below_zero_are_black(device: Device) -> None:
    gaussians, camera = scenes.overlap()
    sh = gaussians.sh.copy()
    sh[:, 0] = -1e30
    run = Pipeline.run(device, (replace(gaussians, sh=sh), camera))
    assert np.isfinite(run.image).all()
    assert run.image.min() >= 0
    got, _ = run.backward(image_gradient(run))
    assert not got.sh.any()


def test_colours_beyond_floats_have_a_ceiling(device: Device) -> None:
    """Infinity times a weight of 0 in a pixel that the Gaussian does not reach."""
    gaussians, camera = scenes.overlap()
    sh = gaussians.sh.copy()
    sh[3], sh[4] = np.inf, 3e38
    run = Pipeline.run(device, (replace(gaussians, sh=sh), camera))
    assert np.isfinite(run.image).all()
    got, _ = run.backward(image_gradient(run))
    for group in GROUPS:
        assert np.isfinite(getattr(got, group)).all(), group
