# SPDX-License-Identifier: Apache-2.0
"""Nearness, the sum of weight over depth, its loss and the gradient of both, against the float64 twins."""

from __future__ import annotations

from typing import Any

import numpy as np
import pytest
import scenes
from compare import assert_close, assert_close_gradient, assert_same_bits
from pipeline import BACKGROUND
from quick import quick
from test_gradients_of_projections import CAMERAS, subject

from clsplat.arrays import Float64
from clsplat.camera import Camera
from clsplat.device.buffers import upload
from clsplat.device.context import Device
from clsplat.gaussians import Gaussians
from clsplat.layouts.columns import TILE, SlotFields
from clsplat.reference import every_pixel
from clsplat.reference.depth import depth_loss
from clsplat.reference.loss import alpha_loss, l1_dssim
from clsplat.reference.render import forward, render_grad
from clsplat.rendering.rasterizer import Rasterizer
from clsplat.stages.device_gaussians import allocate_gaussians, download_gaussians, upload_gaussians
from clsplat.stages.loss import loss
from clsplat.stages.loss_terms import AlphaTerm, DepthTerm
from clsplat.stages.target import target

GROUPS = ("means", "quaternions", "log_scales", "opacity_logits", "sh")
NEAR = SlotFields(nearness=True)
EVERY_FIELD = SlotFields(absolute=True, contributions=True, nearness=True)


def aims_of(camera: Camera, margin: Float64) -> tuple[Float64, Float64]:
    """Nearness and weights, of a half of the pixels, that are well known."""
    rng = np.random.default_rng(9)
    size = (camera.height, camera.width)
    aims, weights = rng.uniform(0.05, 0.6, size), rng.uniform(0.2, 1, size) * (rng.random(size) < 0.5)
    return aims, np.where(margin < 1e-4, 0.0, weights)


def padded(camera: Camera, *planes: Float64) -> np.ndarray:
    rows, stride = (-(-side // TILE) * TILE for side in (camera.height, camera.width))
    made = np.zeros((len(planes), rows, stride), np.float32)
    made[:, : camera.height, : camera.width] = planes
    return made


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
    depth = DepthTerm(padded(camera, aims, weights), 0.02)
    planes = target(device, rasterizer.work, photograph, frame.background, blended, alpha=alpha_weight > 0)
    terms = (*([AlphaTerm(alpha_weight)] if alpha_weight else []), depth)
    result = loss(device, rasterizer.work, blended.image, planes, *size, 0.2, blended=blended, terms=terms)
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


@pytest.mark.slow_in_groups
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
    for group in GROUPS:
        assert_close_gradient(getattr(got["gradients"], group), wanted.parameters[group], 1e-4)


@pytest.mark.parametrize("name", quick(CAMERAS, "orthographic", "panorama", "bent fisheye"))
def test_the_twins_slopes(name: str) -> None:
    """The twin's gradient of nearness against central differences."""
    (gaussians, camera), step = subject(name, 40), 1e-7
    arrays = {group: np.asarray(values, np.float64) for group, values in gaussians.arrays().items()}
    model = Gaussians(**arrays, near=gaussians.near)
    picture = every_pixel.render(model, camera, BACKGROUND)
    aims, weights = aims_of(camera, np.where(picture.margin < 1e-3, 0.0, 1.0))
    d_nearness = depth_loss(picture.nearness, aims, weights, 1.0)[1]
    nothing = np.zeros((camera.height, camera.width, 3))
    gradients = every_pixel.render_grad(model, camera, nothing, BACKGROUND, d_nearness).parameters
    rng = np.random.default_rng(6)
    for group in GROUPS[:-1]:
        direction = rng.standard_normal(arrays[group].shape)
        moved = [Gaussians(**{**arrays, group: arrays[group] + by * direction}) for by in (step, -step)]
        ends = [depth_loss(every_pixel.render(one, camera).nearness, aims, weights, 1.0)[0] for one in moved]
        slope = (ends[0] - ends[1]) / (2 * step)
        error = abs(slope - (gradients[group] * direction).sum())
        assert error <= 1e-5 * np.linalg.norm(gradients[group]), group
    assert not gradients["sh"].any()


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
    planes = padded(camera, *np.zeros((3, camera.height, camera.width)), d_nearness)
    rasterizer.backward(model, frame, upload(default_device, planes), gradients, fields=NEAR)
    got = download_gaussians(gradients)
    for group in GROUPS[:-1]:
        assert_close_gradient(getattr(got, group), wanted.parameters[group], 1e-4, name=group)


@pytest.mark.slow_in_groups
def test_colour_and_its_gradient_stay_what_they_are(shaped_device: Device) -> None:
    """Nearness beside them, with no weight, changes no bit."""
    gaussians, camera = scenes.NAMED["overlap"]()
    model = upload_gaussians(shaped_device, gaussians)
    d_image = np.random.default_rng(1).normal(size=(3, camera.height, camera.width)) * 1e-3
    rasterizer, made = Rasterizer(shaped_device), []
    background = upload(shaped_device, np.array(BACKGROUND, np.float32))
    for fields in (SlotFields(), NEAR):
        frame = rasterizer.forward(model, camera, background, nearness=fields.nearness)
        planes = padded(camera, *d_image, *([np.zeros(d_image.shape[1:])] if fields.nearness else []))
        gradients = allocate_gaussians(shaped_device, model.count, model.coefficients, zero=True)
        rasterizer.backward(model, frame, upload(shaped_device, planes), gradients, fields=fields)
        made.append((frame.blended.image.get(), download_gaussians(gradients)))
    assert_same_bits(made[1][0], made[0][0], "image")
    for group in GROUPS:
        np.testing.assert_allclose(getattr(made[1][1], group), getattr(made[0][1], group), rtol=2e-5, atol=1e-9)
