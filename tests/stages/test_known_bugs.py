# SPDX-License-Identifier: Apache-2.0
"""What has gone wrong in other programs of this kind, a test each that the suite would not have by another name.

docs/numerics.md has the tests elsewhere; docs/never-a-nan.md those of values that are not finite.
"""

from __future__ import annotations

from dataclasses import replace

import numpy as np
import pytest
import scenes
from compare import assert_close_gradient, assert_close_images, assert_same_arrays, assert_same_bits
from pipeline import BACKGROUND, Pipeline, assert_gradients

from clsplat.config.rasterizer import BenchSwitches, RasterizerConfig
from clsplat.device.context import Device
from clsplat.errors import InputError
from clsplat.gaussians import Gaussians
from clsplat.layouts.columns import SlotFields
from clsplat.reference import render as reference
from clsplat.reference.blend import BLEND_ALPHA_MAX
from clsplat.reference.tiles import touched_tiles
from clsplat.rendering.renderer import Renderer


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


def with_row(model: Gaussians, row: int, **values: object) -> Gaussians:
    """A copy in which one Gaussian is another."""
    arrays = {name: array.copy() for name, array in model.arrays().items()}
    for name, value in values.items():
        arrays[name][row] = value
    return Gaussians(**arrays)


def assert_finite(run: Pipeline) -> None:
    """Every number of the frame and of its gradients."""
    assert np.isfinite(run.image).all()
    gradients, _ = run.backward(np.ones(run.image.shape))
    assert all(np.isfinite(values).all() for values in gradients.arrays().values())


def assert_as_if_absent(device: Device, model: Gaussians, row: int, config: RasterizerConfig | None = None) -> None:
    """Frame and gradients of the others have the bits that they have without this one, which has no gradient."""
    without = Gaussians(**{name: np.delete(array, row, axis=0) for name, array in model.arrays().items()})
    there, absent = (Pipeline.run(device, (each, scenes.overlap()[1]), config=config) for each in (model, without))
    assert not there.visible[row]
    assert_same_bits(there.image, absent.image)
    (got, _), (wanted, _) = (run.backward(image_gradient(run)) for run in (there, absent))
    assert not any(values[row].any() for values in got.arrays().values())
    assert_same_arrays({name: np.delete(values, row, axis=0) for name, values in got.arrays().items()}, wanted.arrays())


@pytest.fixture
def model() -> Gaussians:
    return scenes.overlap()[0]


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
    assert run.backward(image_gradient(run))[0].opacity_logits.any()
    assert_gradients(run, scene)


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


@pytest.mark.parametrize(
    "quaternion",
    [
        *(0.0, 1e-42, 1e-30, 1e30, np.inf, np.nan),
        *([0.0, 0.0, 0.0, 1e-30], [1e-30, 0.0, 0.0, 0.0], [1e-42, 0.0, 0.0, 0.0], [1e30, 0.0, 1e30, 0.0]),
    ],
    ids=str,
)
def test_quaternions_without_a_direction_are_culled_alone(device: Device, model: Gaussians, quaternion: object) -> None:
    """Of no length, too short or too long to square."""
    assert_as_if_absent(device, with_row(model, 7, quaternions=quaternion), 7)


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
    assert not any(values[2:].any() for values in got.arrays().values())


def test_after_an_opacity_reset_the_whole_ellipse_learns(device: Device) -> None:
    """At 0.01 alpha falls to 1/255 at 1.37 sigma: what is within has its gradient, up to the edge."""
    gaussians, camera = scenes.overlap()
    scene = replace(gaussians, opacity_logits=np.full(len(gaussians), np.log(0.01 / 0.99), np.float32)), camera
    run = Pipeline.run(device, scene)
    assert (run.backward(image_gradient(run))[0].opacity_logits != 0).sum() > 20
    assert_gradients(run, scene)


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
    assert_close_images(run.image, forward.blended.image, 1e-5, ignore=forward.blended.margin < 1e-4)
    assert_gradients(run, scene)


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


@pytest.mark.parametrize("tiles", [1, 2, 4, 8, 16])
def test_tile_keys_have_bits_enough_when_tiles_are_a_power_of_two(device: Device, tiles: int) -> None:
    """One Gaussian in each tile, the last one's key being all ones."""
    width, height = 16 * min(tiles, 4), 16 * max(tiles // 4, 1)
    camera = scenes.straight_camera(width, height, 100.0)
    x, y = np.meshgrid(np.arange(8.0, width, 16), np.arange(8.0, height, 16))
    means = np.stack([(x.ravel() - width / 2) / 100 * 2, (y.ravel() - height / 2) / 100 * 2, np.full(tiles, 2.0)], 1)
    one = np.ones((tiles, 1))
    sh = np.linspace(0.5, 1.5, tiles)[:, None, None] * np.ones((1, 1, 3))
    scene = scenes.make_gaussians(means, one * [1.0, 0, 0, 0], np.log(0.03) * one * np.ones(3), 0.9 * one[:, 0], sh)
    run = Pipeline.run(device, (scene, camera))
    assert [tile for reached in run.tiles_of() for tile in sorted(reached)] == list(range(tiles))
    wanted, _ = reference.render(scene, camera, BACKGROUND)
    assert np.abs(run.image - wanted).max() < 1e-5  # float32 against float64, far from any pixel's edge


@pytest.mark.parametrize("depth", [0.0, -1e-3, -3.0, -1e7])
def test_behind_the_camera_there_are_no_ghosts(
    device: Device, default_device: Device, model: Gaussians, depth: float
) -> None:
    """A negative depth's bits are larger than any positive one's as an unsigned key."""
    camera = scenes.overlap()[1]
    at = np.asarray(camera.rotation.T @ (np.array([0.0, 0.0, depth]) - camera.translation), np.float32)
    ways = (None, BenchSwitches(depth_sort="pairs"), BenchSwitches(frustum_cull=False))
    for config in ways if device is default_device else ways[:1]:  # each is a build
        assert_as_if_absent(device, with_row(model, 7, means=at), 7, config)


@pytest.mark.parametrize("word", ["", "1", "0xffffffff"])
def test_what_nobody_sees_leaves_no_output_unwritten(
    shaped_device: Device, model: Gaussians, monkeypatch: pytest.MonkeyPatch, word: str
) -> None:
    """An image that is all background, and gradients that are all zero, in memory full of something else."""
    monkeypatch.setenv("CLSPLAT_POISON", word)
    hidden = replace(model, means=model.means * np.float32([1, 1, -100]))
    run = Pipeline.run(shaped_device, (hidden, scenes.overlap()[1]))
    assert not run.visible.any()
    assert_same_bits(run.image, np.broadcast_to(np.float32(BACKGROUND), run.image.shape).copy())
    gradients, _ = run.backward(np.ones(run.image.shape))
    assert not any(values.any() for values in gradients.arrays().values())


@pytest.mark.parametrize("log_scale", [45.0, 88.0, 89.0, 1e4, 3e38, np.inf, np.nan, -np.inf])
def test_an_infinite_scale_spoils_nothing(device: Device, model: Gaussians, log_scale: float) -> None:
    """No radius that is NaN, no key that nobody wrote."""
    for others in (-2.0, log_scale):
        changed = with_row(model, 7, log_scales=[log_scale, others, log_scale])
        if log_scale == -np.inf:  # a needle without thickness: drawn or not
            assert_finite(Pipeline.run(device, (changed, scenes.overlap()[1])))
        else:
            assert_as_if_absent(device, changed, 7)


@pytest.mark.parametrize("place", [np.nan, np.inf, -np.inf])
def test_a_mean_that_is_no_place_is_culled_alone(device: Device, model: Gaussians, place: float) -> None:
    assert_as_if_absent(device, with_row(model, 7, means=place), 7)


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


@pytest.mark.slow
def test_opacities_about_the_least_visible_one(device: Device, default_device: Device, model: Gaussians) -> None:
    """Under it the logarithm of what is left of the extent would be negative."""
    least = -np.log(np.float64(254.0))
    ways = (None, BenchSwitches(extent="constant"))
    for logit in (-np.inf, np.nan, -100.0, -20.0, least - 1e-3):
        for config in ways if device is default_device else ways[:1]:  # each is a build
            assert_as_if_absent(device, with_row(model, 7, opacity_logits=logit), 7, config)
    for step in range(-3, 4):
        logit = np.float32(least)
        for _ in range(abs(step)):
            logit = np.nextafter(logit, np.float32(np.sign(step) * 100))
        assert_finite(Pipeline.run(device, (with_row(model, 7, opacity_logits=logit), scenes.overlap()[1])))


def test_negative_colours_are_black_and_have_no_gradient(device: Device, model: Gaussians) -> None:
    black = with_row(model, 7, sh=-5.0 * np.eye(model.sh.shape[1], 1, dtype=np.float32) * np.ones((1, 3), np.float32))
    for value in (-1e8, -1e30, -np.inf):
        changed = with_row(model, 7, sh=black.sh[7] * np.float32(1))
        changed.sh[7, 0] = value
        there, wanted = (Pipeline.run(device, (each, scenes.overlap()[1])) for each in (changed, black))
        assert there.visible[7]
        assert_same_bits(there.image, wanted.image)
        gradients, _ = there.backward(np.ones(there.image.shape))
        assert not gradients.sh[7].any()


@pytest.mark.parametrize("value", [np.nan, np.inf, 1e30, 3e38, 4e9])
def test_a_colour_that_is_too_large_or_nan_is_not_drawn(device: Device, model: Gaussians, value: float) -> None:
    """It is not black either: max(0, NaN) would be."""
    assert_finite(
        Pipeline.run(device, (with_row(model, 7, sh=value), scenes.overlap()[1]))
    )  # or black by its direction
    for channel in range(3):
        changed = with_row(model, 7)
        changed.sh[7, 0, channel] = value
        for config in (None, BenchSwitches(frustum_cull=False)):
            assert_as_if_absent(device, changed, 7, config)


def test_a_colour_that_no_picture_has_but_that_is_finite_is_drawn(device: Device, model: Gaussians) -> None:
    changed = with_row(model, 7)
    changed.sh[7, 0] = 1e6
    run = Pipeline.run(device, (changed, scenes.overlap()[1]))
    assert run.visible[7]
    assert run.image.max() > 1e3
    assert np.isfinite(run.image).all()


@pytest.mark.parametrize("background", [(np.nan, 0.0, 0.0), (0.0, np.inf, 0.0), (0.0, 0.0, 1e39), (0.5, 0.5)])
def test_a_background_that_is_no_colour(model: Gaussians, background: tuple[float, ...]) -> None:
    with pytest.raises(InputError, match=r"background \(.*\): expected three finite numbers"):
        Renderer().render(model, scenes.overlap()[1], background)
