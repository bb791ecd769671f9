# SPDX-License-Identifier: Apache-2.0
"""Bugs that other implementations have had with values that are not finite, or that nobody wrote: a test for each."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
import pytest
from compare import assert_same_bits
from pipeline import BACKGROUND, Pipeline
from scenes import make_gaussians, overlap, straight_camera

from clsplat.config.rasterizer import BenchSwitches, RasterizerConfig
from clsplat.config.training import DensityConfig
from clsplat.device.context import Device
from clsplat.errors import InputError
from clsplat.gaussians import Gaussians
from clsplat.reference.render import render
from clsplat.rendering.renderer import Renderer
from clsplat.training.density.adaptive import split_halves

FIELDS = ("means", "quaternions", "log_scales", "opacity_logits", "sh")


def with_row(model: Gaussians, row: int, **values: object) -> Gaussians:
    """A copy in which one Gaussian is another."""
    arrays = {name: getattr(model, name).copy() for name in FIELDS}
    for name, value in values.items():
        arrays[name][row] = value
    return Gaussians(**arrays)


def without(model: Gaussians, row: int) -> Gaussians:
    return Gaussians(**{name: np.delete(getattr(model, name), row, axis=0) for name in FIELDS})


def assert_as_if_absent(device: Device, model: Gaussians, row: int, config: RasterizerConfig | None = None) -> None:
    """Frame and gradients of the others have the bits that they have without this one, which has no gradient."""
    camera = overlap()[1]
    there, absent = (Pipeline.run(device, (each, camera), config=config) for each in (model, without(model, row)))
    assert not there.visible[row]
    assert_same_bits(there.image, absent.image)
    d_image = np.random.default_rng(0).standard_normal(there.image.shape)
    (got, _), (wanted, _) = there.backward(d_image), absent.backward(d_image)
    for name in FIELDS:
        assert not getattr(got, name)[row].any(), name
        assert_same_bits(np.delete(getattr(got, name), row, axis=0), getattr(wanted, name), name)


@pytest.fixture
def model() -> Gaussians:
    return overlap()[0]


def test_zero_quaternions_are_not_drawn_and_have_no_gradient(device: Device, model: Gaussians) -> None:
    for length in (0.0, 1e-30, 1e-42):
        assert_as_if_absent(device, with_row(model, 7, quaternions=[length, 0.0, 0.0, 0.0]), 7)


def test_quaternions_too_long_to_square_are_not_drawn(device: Device, model: Gaussians) -> None:
    assert_as_if_absent(device, with_row(model, 7, quaternions=[1e30, 0.0, 1e30, 0.0]), 7)


def test_splitting_a_zero_quaternion_gives_finite_halves() -> None:
    means, log_scales = split_halves(
        DensityConfig(),
        means=np.ones((4, 3), np.float32),
        quaternions=np.array([[0, 0, 0, 0], [1e-42, 0, 0, 0], [1, 0, 0, 0], [0, 0, 0, 1e-20]], np.float32),
        log_scales=np.zeros((4, 3), np.float32),
        rng=np.random.default_rng(0),
    )
    assert np.isfinite(means).all()
    assert np.isfinite(log_scales).all()


def test_what_is_behind_the_camera_is_not_drawn_and_disturbs_no_order(
    device: Device, default_device: Device, model: Gaussians
) -> None:
    """A negative depth's bits are larger than any positive one's as an unsigned key."""
    camera = overlap()[1]
    behind = np.asarray(camera.rotation.T @ (np.array([0.0, 0.0, -3.0]) - camera.translation), np.float32)
    ways = (None, BenchSwitches(depth_sort="pairs"), BenchSwitches(frustum_cull=False))
    for at in (behind, camera.position.astype(np.float32)):
        for config in ways if device is default_device else ways[:1]:  # each is a build
            assert_as_if_absent(device, with_row(model, 7, means=at), 7, config)


@pytest.mark.parametrize("tiles", [1, 2, 4, 8, 16])
def test_tile_keys_have_bits_enough_when_tiles_are_a_power_of_two(device: Device, tiles: int) -> None:
    """One Gaussian in each tile, the last one's key being all ones."""
    width, height = 16 * min(tiles, 4), 16 * max(tiles // 4, 1)
    camera = straight_camera(width, height, 100.0)
    x, y = np.meshgrid(np.arange(8.0, width, 16), np.arange(8.0, height, 16))
    means = np.stack([(x.ravel() - width / 2) / 100 * 2, (y.ravel() - height / 2) / 100 * 2, np.full(tiles, 2.0)], 1)
    one = np.ones((tiles, 1))
    sh = np.linspace(0.5, 1.5, tiles)[:, None, None] * np.ones((1, 1, 3))
    scene = make_gaussians(means, one * [1.0, 0, 0, 0], np.log(0.03) * one * np.ones(3), 0.9 * one[:, 0], sh)
    run = Pipeline.run(device, (scene, camera))
    assert [tile for reached in run.tiles_of() for tile in sorted(reached)] == list(range(tiles))
    wanted, _ = render(scene, camera, BACKGROUND)
    assert np.abs(run.image - wanted).max() < 1e-5  # float32 against float64, far from any pixel's edge


@pytest.mark.parametrize("word", ["1", "0xffffffff"])
def test_what_nobody_sees_leaves_no_output_unwritten(
    device: Device, model: Gaussians, monkeypatch: pytest.MonkeyPatch, word: str
) -> None:
    """An image that is all background, and gradients that are all zero, in memory full of something else."""
    monkeypatch.setenv("CLSPLAT_POISON", word)
    hidden = replace(model, means=model.means * np.float32([1, 1, -100]))
    run = Pipeline.run(device, (hidden, overlap()[1]))
    assert not run.visible.any()
    assert_same_bits(run.image, np.broadcast_to(np.float32(BACKGROUND), run.image.shape).copy())
    gradients, _ = run.backward(np.ones(run.image.shape))
    assert not any(getattr(gradients, name).any() for name in FIELDS)


@pytest.mark.parametrize("log_scale", [45.0, 88.0, 89.0, 1e4, np.inf, np.nan, -np.inf])
def test_an_infinite_scale_spoils_nothing(device: Device, model: Gaussians, log_scale: float) -> None:
    """No radius that is NaN, no key that nobody wrote."""
    changed = with_row(model, 7, log_scales=[log_scale, -2.0, log_scale])
    if log_scale == -np.inf:  # a needle without thickness: drawn or not
        run = Pipeline.run(device, (changed, overlap()[1]))
        assert np.isfinite(run.image).all()
        gradients, _ = run.backward(np.ones(run.image.shape))
        assert all(np.isfinite(getattr(gradients, name)).all() for name in FIELDS)
        return
    assert_as_if_absent(device, changed, 7)


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
        run = Pipeline.run(device, (with_row(model, 7, opacity_logits=logit), overlap()[1]))
        assert np.isfinite(run.image).all()
        gradients, _ = run.backward(np.ones(run.image.shape))
        assert all(np.isfinite(getattr(gradients, name)).all() for name in FIELDS), step


def test_negative_colours_are_black_and_have_no_gradient(device: Device, model: Gaussians) -> None:
    black = with_row(model, 7, sh=-5.0 * np.eye(model.sh.shape[1], 1, dtype=np.float32) * np.ones((1, 3), np.float32))
    for value in (-1e8, -1e30, -np.inf):
        changed = with_row(model, 7, sh=black.sh[7] * np.float32(1))
        changed.sh[7, 0] = value
        there, wanted = (Pipeline.run(device, (each, overlap()[1])) for each in (changed, black))
        assert there.visible[7]
        assert_same_bits(there.image, wanted.image)
        gradients, _ = there.backward(np.ones(there.image.shape))
        assert not gradients.sh[7].any()


def test_a_colour_that_is_nan_is_not_drawn(device: Device, model: Gaussians) -> None:
    """It is not black either: max(0, NaN) would be."""
    for value in (np.nan, np.inf, 1e30, 4e9):
        for channel in range(3):
            changed = with_row(model, 7)
            changed.sh[7, 0, channel] = value
            assert_as_if_absent(device, changed, 7)
            assert_as_if_absent(device, changed, 7, BenchSwitches(frustum_cull=False))


def test_a_colour_that_no_picture_has_but_that_is_finite_is_drawn(device: Device, model: Gaussians) -> None:
    changed = with_row(model, 7)
    changed.sh[7, 0] = 1e6
    run = Pipeline.run(device, (changed, overlap()[1]))
    assert run.visible[7]
    assert run.image.max() > 1e3
    assert np.isfinite(run.image).all()


@pytest.mark.parametrize("background", [(np.nan, 0.0, 0.0), (0.0, np.inf, 0.0), (0.0, 0.0, 1e39), (0.5, 0.5)])
def test_a_background_that_is_no_colour(model: Gaussians, background: tuple[float, ...]) -> None:
    with pytest.raises(InputError, match=r"background \(.*\): expected three finite numbers"):
        Renderer().render(model, overlap()[1], background)
