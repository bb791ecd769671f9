# SPDX-License-Identifier: Apache-2.0
"""The gradient by a camera's lens against the float64 twin, and the twin against central differences of pictures."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
import pytest
import scenes
from compare import assert_same_bits
from pipeline import BACKGROUND, Pipeline
from quick import quick
from test_gradients_of_projections import CAMERAS, direction_of_loss

from clsplat.camera import Camera
from clsplat.device.buffers import Workspace, allocate, upload
from clsplat.device.context import Device
from clsplat.gaussians import Gaussians
from clsplat.layouts.columns import POSE_ROWS
from clsplat.reference import render as reference
from clsplat.selftest.harness import planes_of
from clsplat.stages.device_gaussians import allocate_gaussians
from clsplat.stages.pose import LENS_NUMBERS, lens_rows, sum_of, sums_of

STEPS = np.array([1e-6, 1e-6, 1e-5, 1e-5])
"""Of the logs of the focal lengths, and of the principal point in pixels."""
KINDS = ("perspective", "off its centre", "wide", "antialiased", "antialiased, wide", "orthographic")


def subject(kind: str, count: int) -> tuple[Gaussians, Camera]:
    """Gaussians and a camera. wide: some reach far into the picture from beyond the clamp of the ratios."""
    gaussians, camera = scenes.overlap(count=count)
    if "wide" in kind:
        camera = replace(camera, fx=4 * camera.fx, fy=4 * camera.fy)
        gaussians.log_scales = gaussians.log_scales + np.float32(1.5)
    if kind == "off its centre":
        camera = replace(camera, cx=camera.cx + 9.5, cy=camera.cy - 4.25, fy=1.1 * camera.fy)
    if kind == "orthographic":
        camera = CAMERAS[kind]
    return replace(gaussians, antialiased="antialiased" in kind), camera


def beyond(gaussians: Gaussians, camera: Camera) -> int:
    """Gaussians before the camera whose ratio is clamped."""
    x, y, z = (gaussians.means @ camera.rotation.T + camera.translation).T
    ratios = np.stack([x, y], axis=1)[z > 0.01] / z[z > 0.01, None]
    low, high = camera.frustum_limits
    return int(((ratios < low) | (ratios > high)).any(axis=1).sum())


@pytest.mark.parametrize("kind", quick(KINDS, "perspective", "antialiased, wide"))
def test_the_twin_by_central_differences(kind: str) -> None:
    gaussians, camera = subject(kind, 40)
    model = scenes.in_float64(gaussians)
    assert kind == "orthographic" or beyond(model, camera) > 3
    d_image = direction_of_loss(model, camera, 2e-4)
    found = reference.render_lens_grad(model, camera, d_image, BACKGROUND)

    def loss(by: np.ndarray) -> float:
        focal = {"fx": camera.fx * np.exp(by[0]), "fy": camera.fy * np.exp(by[1])}
        other = replace(camera, **focal, cx=camera.cx + by[2], cy=camera.cy + by[3])
        return float((reference.render(model, other, BACKGROUND)[0] * d_image).sum())

    slopes = np.array([(loss(step) - loss(-step)) / 2 / step.sum() for step in np.diag(STEPS)])
    for part in (slice(2), slice(2, 4)):  # of 12 digits that a loss of about 100 has, such steps leave 6
        assert np.linalg.norm(found[part] - slopes[part]) <= 1e-5 * np.linalg.norm(found[part])


@pytest.mark.parametrize("kind", quick(KINDS, "perspective"))
def test_the_kernels_against_the_twin(shaped_device: Device, kind: str) -> None:
    gaussians, camera = subject(kind, 200)
    d_image = direction_of_loss(gaussians, camera, 3e-4)
    wanted = reference.render_lens_grad(gaussians, camera, d_image, BACKGROUND)
    pipeline = Pipeline.run(shaped_device, (gaussians, camera))
    rasterizer, model, frame = pipeline.rasterizer, pipeline.gaussians, pipeline.frame
    of = (rasterizer.device, model.count, model.coefficients)
    plain, gradients = (allocate_gaussians(*of, zero=True) for _ in range(2))
    by_lens = allocate(rasterizer.device, (model.count, LENS_NUMBERS), np.float32)
    by_lens.fill(np.nan)  # rows that are not seen are not read
    image_gradient = upload(rasterizer.device, planes_of(d_image))
    rasterizer.backward(model, frame, image_gradient, plain)
    rasterizer.backward(model, frame, image_gradient, gradients, by_lens=by_lens)
    for group, array in plain.arrays.items():  # the model's gradients are what they are without
        assert_same_bits(array.get(), gradients[group].get())
    sums = sums_of(rasterizer.work, model.count, LENS_NUMBERS)
    lens_rows(rasterizer.device, frame.projected.tile_counts, by_lens, sums)
    got = sum_of(rasterizer.device, rasterizer.work, sums).get()[0]
    for part in (slice(2), slice(2, 4)):
        assert np.linalg.norm(got[part] - wanted[part]) <= 1e-4 * np.linalg.norm(wanted[part])


@pytest.mark.parametrize("count", [1, POSE_ROWS, POSE_ROWS + 1, POSE_ROWS**2 + 1])
def test_sums_at_the_seams(device: Device, count: int) -> None:
    """In two parts, of a model that is not on the device at once; every third row is not seen."""
    rows = np.random.default_rng(count).standard_normal((count, LENS_NUMBERS)).astype(np.float32)
    seen = np.arange(count) % 3 != 1
    rows[~seen] = np.nan
    work, counts, by_lens = Workspace(device), upload(device, seen.astype(np.uint32)), upload(device, rows)
    sums = sums_of(work, count, LENS_NUMBERS)
    sums.fill(np.nan)
    for start in range(0, count, POSE_ROWS):
        stop = min(start + POSE_ROWS, count)
        lens_rows(device, counts.rows(start, stop), by_lens.rows(start, stop), sums, start)
    wanted = rows[seen].sum(axis=0, dtype=np.float64)
    # the terms are of either sign: the sum of 4000 is 60 times a term, and off by the rounding of partial sums
    assert np.abs(sum_of(device, work, sums).get()[0] - wanted).max() <= 2e-6 * count**0.5


def test_another_lens_sees_from_the_same_place() -> None:
    camera = scenes.tilted_camera(40, 30)
    other = camera.refocused(float(np.log(2)), 0.0625, -0.125)
    assert (other.fx, other.fy) == (pytest.approx(2 * camera.fx), pytest.approx(2 * camera.fy))
    assert (other.cx, other.cy) == (camera.cx + 0.0625 * camera.fx, camera.cy - 0.125 * camera.fy)
    assert (other.rotation == camera.rotation).all()
    assert (other.translation == camera.translation).all()
