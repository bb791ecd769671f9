# SPDX-License-Identifier: Apache-2.0
"""The low-pass with compensated opacity, in project.cl, project_grad.cl and project_rays.cl, against the twins."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
import pytest
import scenes
from compare import assert_close, assert_close_gradient, assert_close_images
from pipeline import Pipeline

from clsplat.camera import focal_length
from clsplat.device.context import Device
from clsplat.reference import every_pixel
from clsplat.reference import render as reference
from clsplat.rendering.renderer import Renderer

BACKGROUND = (0.1, 0.2, 0.3)


def antialiased(name: str) -> scenes.Scene:
    gaussians, camera = scenes.NAMED[name]()
    return replace(gaussians, antialiased=True), camera


def assert_gradients(device: Device, scene: scenes.Scene) -> None:
    run, forward = Pipeline.run(device, scene, BACKGROUND), reference.forward(*scene, BACKGROUND)
    d_image = np.random.default_rng(1).standard_normal((run.camera.height, run.camera.width, 3))
    d_image[forward.blended.margin < 1e-4] = 0  # a threshold may fall the other way in float32
    got, screen = run.backward(d_image)
    wanted = reference.render_grad(*scene, d_image, BACKGROUND)
    for group in ("means", "quaternions", "log_scales", "opacity_logits", "sh"):
        assert_close_gradient(getattr(got, group), wanted.parameters[group], 1e-4, name=group)
    assert_close_gradient(screen[run.visible], wanted.means2d[run.visible], 1e-4)


@pytest.mark.smoke
@pytest.mark.parametrize("name", scenes.NAMED)
def test_projection_and_gradients(device: Device, name: str) -> None:
    scene = antialiased(name)
    run, wanted = Pipeline.run(device, scene), reference.forward(*scene).projected
    shown = run.visible
    assert not np.any(shown & ~wanted.visible)
    # the root of a quotient of two determinants of some ten roundings each
    assert_close(2 ** run.splat("LOG2O")[shown, 0], wanted.opacities[shown], relative=1e-5)
    assert_gradients(device, scene)


@pytest.mark.slow
@pytest.mark.parametrize("name", scenes.SHAPE_MATTERS)
def test_gradients_in_every_shape(shaped_device: Device, name: str) -> None:
    assert_gradients(shaped_device, antialiased(name))


def test_a_small_ball_keeps_its_area(default_device: Device) -> None:
    """Closed form: the picture has 2 pi sigma^2 of a ball, times its opacity; without the filter it has the low-pass's
    too."""
    gaussians, camera = scenes.one()
    sigma, opacity = 0.5, 1 / (1 + np.exp(-4.0))  # pixels
    depth = float((gaussians.means @ camera.rotation.T + camera.translation)[0, 2])
    ball = replace(
        gaussians,
        log_scales=np.full((1, 3), np.log(sigma * depth / camera.fx), np.float32),
        opacity_logits=np.full(1, 4.0, np.float32),
    )
    square, renderer = replace(camera, fy=camera.fx), Renderer(default_device)
    areas = [renderer.render(replace(ball, antialiased=on), square).alpha.sum() for on in (True, False)]
    # 0.6 % is under 1/255 and not drawn; the grid of pixels makes 0.4 %; the ball is off the axis, and so no circle
    assert_close(areas[0], 2 * np.pi * sigma**2 * opacity, relative=0.05)
    assert_close(areas[1], 2 * np.pi * (sigma**2 + 0.3) * opacity, relative=0.05)


@pytest.mark.parametrize("projection", ["fisheye", "equirectangular"])
def test_rays(device: Device, projection: str) -> None:
    gaussians, camera = scenes.overlap()
    focal = focal_length(np.deg2rad(120), camera.width, projection)
    around = replace(camera, fx=focal, fy=focal, projection=projection)
    smooth = replace(gaussians, antialiased=True)
    got, wanted = Renderer(device).render(smooth, around), every_pixel.render(smooth, around)
    assert_close_images(
        got.image, wanted.image, 2e-5, ignore=wanted.margin < 3e-4
    )  # as tests/stages/test_project_rays.py
    plain = Renderer(device).render(gaussians, around)
    assert np.abs(got.image - plain.image).max() > 0.01


def test_a_renderer_takes_turns(default_device: Device) -> None:
    """Models with and without the filter, one after the other, in one renderer."""
    gaussians, camera = scenes.overlap()
    smooth, renderer = replace(gaussians, antialiased=True), Renderer(default_device)
    first, second, third = (renderer.render(model, camera).image for model in (gaussians, smooth, gaussians))
    assert np.array_equal(first, third)
    assert not np.array_equal(first, second)
    assert np.array_equal(second, Renderer(default_device).render(smooth, camera).image)
