# SPDX-License-Identifier: Apache-2.0
"""Nearness, the sum of weight over depth, its loss and the gradient of both, against the float64 twins."""

from __future__ import annotations

from dataclasses import replace
from typing import Any

import numpy as np
import pytest
import scenes
from compare import assert_close, assert_close_gradients, assert_same_bits, assert_slopes
from pipeline import BACKGROUND
from quick import quick
from test_gradients_of_projections import CAMERAS, subject

from clsplat.arrays import Float64
from clsplat.camera import Camera
from clsplat.device.buffers import upload
from clsplat.device.context import Device
from clsplat.gaussians import Gaussians
from clsplat.layouts.columns import SlotFields
from clsplat.reference import every_pixel
from clsplat.reference.depth import depth_loss
from clsplat.reference.loss import alpha_loss, l1_dssim
from clsplat.reference.render import forward, render_grad
from clsplat.rendering.rasterizer import Rasterizer
from clsplat.selftest.harness import planes_of
from clsplat.stages.device_gaussians import allocate_gaussians, download_gaussians, upload_gaussians
from clsplat.stages.loss import loss
from clsplat.stages.loss_terms import AlphaTerm, DepthTerm, RenderTerms
from clsplat.stages.target import target

NEAR = SlotFields(nearness=True)
EVERY_FIELD = SlotFields(absolute=True, contributions=True, nearness=True)


def aims_of(camera: Camera, margin: Float64) -> tuple[Float64, Float64]:
    """Nearness and weights, of a half of the pixels, that are well known."""
    rng = np.random.default_rng(9)
    size = (camera.height, camera.width)
    aims, weights = rng.uniform(0.05, 0.6, size), rng.uniform(0.2, 1, size) * (rng.random(size) < 0.5)
    return aims, np.where(margin < 1e-4, 0.0, weights)


def stepped(
    device: Device, subject: tuple[Gaussians, Camera], photograph: np.ndarray, alpha_weight: float, fields: SlotFields
) -> dict[str, Any]:
    """The results of a step for a photograph and the aims, with a loss of depth alone beside that of colour."""
    gaussians, camera = subject
    rasterizer = Rasterizer(device)
    model = upload_gaussians(device, gaussians)
    frame = rasterizer.forward(model, camera, upload(device, np.array(BACKGROUND, np.float32)), nearness=True)
    blended, size = frame.blended, (camera.width, camera.height)
    assert blended.nearness is not None
    seen = forward(gaussians, camera, BACKGROUND).blended
    aims, weights = aims_of(camera, seen.margin)
    depth = DepthTerm(planes_of(np.stack([aims, weights], axis=2)), 0.02)
    planes = target(device, rasterizer.work, photograph, frame.background, blended, alpha=alpha_weight > 0)
    further = RenderTerms(blended, (*([AlphaTerm(alpha_weight)] if alpha_weight else []), depth))
    result = loss(device, rasterizer.work, blended.image, planes, size, 0.2, further=further)
    gradients = allocate_gaussians(device, gaussians.means.shape[0], gaussians.sh.shape[1], zero=True)
    rasterizer.backward(model, frame, result.gradient, gradients, fields=fields)
    nearness = blended.nearness.get()[: camera.height, : camera.width]
    return {"nearness": nearness, "gradients": download_gaussians(gradients), "loss": result.read()[0]}


def truth(subject: tuple[Gaussians, Camera], photograph: np.ndarray, alpha_weight: float) -> tuple[Float64, Any, float]:
    gaussians, camera = subject
    seen = forward(gaussians, camera, BACKGROUND).blended
    alpha = photograph[:, :, 3].astype(float)
    behind = alpha[:, :, None] * photograph[:, :, :3] + (1 - alpha[:, :, None]) * np.array(BACKGROUND)
    value, d_image = l1_dssim(seen.image, behind)
    of_alpha, d_t = alpha_loss(seen.transmittance, alpha, np.ones_like(alpha), alpha_weight)
    aims, weights = aims_of(camera, seen.margin)
    of_depth, d_nearness = depth_loss(seen.nearness, aims, weights, 0.02)
    how = {"d_transmittance": d_t, "d_nearness": d_nearness}
    return seen.nearness, render_grad(gaussians, camera, d_image, BACKGROUND, **how), value + of_alpha + of_depth


def picture(camera: Camera) -> np.ndarray:
    return np.random.default_rng(3).random((camera.height, camera.width, 4)).astype(np.float32)


@pytest.mark.parametrize("alpha_weight", quick([0.0, 0.3], 0.3))
@pytest.mark.parametrize("fields", quick([NEAR, EVERY_FIELD], EVERY_FIELD))
def test_gradients_are_the_twins(shaped_device: Device, alpha_weight: float, fields: SlotFields) -> None:
    subject = scenes.NAMED["overlap"]()
    photograph = picture(subject[1])
    got = stepped(shaped_device, subject, photograph, alpha_weight, fields)
    nearness, wanted, value = truth(subject, photograph, alpha_weight)
    seen = forward(*subject, BACKGROUND).blended
    sure = seen.margin > 1e-4
    assert np.abs(got["nearness"] - nearness)[sure].max() < 1e-5 * nearness.max()
    assert_close(got["loss"], value, relative=1e-5)
    assert_close_gradients(got["gradients"].arrays(), wanted.parameters, 1e-4)


@pytest.mark.parametrize("name", quick(CAMERAS, "orthographic", "panorama", "bent fisheye"))
def test_the_twins_slopes(name: str) -> None:
    """The twin's gradient of nearness against central differences."""
    gaussians, camera = subject(name, 40)
    model = scenes.in_float64(gaussians)
    picture = every_pixel.render(model, camera, BACKGROUND)
    aims, weights = aims_of(camera, np.where(picture.margin < 1e-3, 0.0, 1.0))
    d_nearness = depth_loss(picture.nearness, aims, weights, 1.0)[1]
    nothing = np.zeros((camera.height, camera.width, 3))
    gradients = every_pixel.render_grad(model, camera, nothing, BACKGROUND, d_nearness).parameters
    assert not gradients.pop("sh").any()

    def loss(arrays: dict[str, np.ndarray]) -> float:
        return depth_loss(every_pixel.render(replace(model, **arrays), camera).nearness, aims, weights, 1.0)[0]

    assert_slopes(loss, model.arrays(), gradients, step=1e-7, tolerance=1e-5)


@pytest.mark.slow
@pytest.mark.parametrize("name", CAMERAS)
def test_other_projections(default_device: Device, name: str) -> None:
    gaussians, camera = subject(name, 200)
    picture = every_pixel.render(gaussians, camera, BACKGROUND)
    aims, weights = aims_of(camera, picture.margin)
    d_nearness = depth_loss(picture.nearness, aims, weights, 0.02)[1]
    nothing = np.zeros((camera.height, camera.width, 3))
    wanted = every_pixel.render_grad(gaussians, camera, nothing, BACKGROUND, d_nearness)
    rasterizer, model = Rasterizer(default_device), upload_gaussians(default_device, gaussians)
    rasterizer.antialias(on=gaussians.antialiased)
    background = upload(default_device, np.array(BACKGROUND, np.float32))
    frame = rasterizer.forward(model, camera, background, nearness=True)
    gradients = allocate_gaussians(default_device, model.count, model.coefficients, zero=True)
    planes = planes_of(np.dstack([nothing, d_nearness]))
    rasterizer.backward(model, frame, upload(default_device, planes), gradients, fields=NEAR)
    got = download_gaussians(gradients)
    assert not wanted.parameters.pop("sh").any()
    assert_close_gradients(got.arrays(), wanted.parameters, 1e-4)


def test_colour_and_its_gradient_stay_what_they_are(shaped_device: Device) -> None:
    """Nearness beside them, with no weight, changes no bit."""
    gaussians, camera = scenes.NAMED["overlap"]()
    model = upload_gaussians(shaped_device, gaussians)
    d_image = np.random.default_rng(1).normal(size=(camera.height, camera.width, 3)) * 1e-3
    rasterizer, made = Rasterizer(shaped_device), []
    background = upload(shaped_device, np.array(BACKGROUND, np.float32))
    for fields in (SlotFields(), NEAR):
        frame = rasterizer.forward(model, camera, background, nearness=fields.nearness)
        planes = planes_of(np.dstack([d_image, *([np.zeros(d_image.shape[:2])] if fields.nearness else [])]))
        gradients = allocate_gaussians(shaped_device, model.count, model.coefficients, zero=True)
        rasterizer.backward(model, frame, upload(shaped_device, planes), gradients, fields=fields)
        made.append((frame.blended.image.get(), download_gaussians(gradients)))
    assert_same_bits(made[1][0], made[0][0], "image")
    for name, values in made[0][1].arrays().items():
        np.testing.assert_allclose(getattr(made[1][1], name), values, rtol=2e-5, atol=1e-9)
