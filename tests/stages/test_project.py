# SPDX-License-Identifier: Apache-2.0
"""project.cl and project_grad.cl against the float64 twin."""

from __future__ import annotations

import numpy as np
import pytest
import scenes
from compare import assert_close, assert_close_gradient
from pipeline import Pipeline, assert_gradients
from quick import quick

from clsplat.device.context import Device
from clsplat.layouts.columns import SlotFields
from clsplat.reference import render as reference

WHITEN = np.sqrt(np.log2(np.e) / 2)
EVERY = {**scenes.NAMED, **scenes.ANTIALIASED}
PROJECTED = EVERY | {
    f"orthographic {name}": lambda name=name: scenes.orthographic(scenes.NAMED[name]())
    for name in ("overlap", "needles", "off_frustum")
}


@pytest.mark.smoke
@pytest.mark.parametrize("name", PROJECTED)
def test_projection(device: Device, name: str) -> None:
    scene = PROJECTED[name]()
    run, wanted = Pipeline.run(device, scene), reference.forward(*scene).projected
    shown = run.visible
    # Every Gaussian with a tile is visible to the twin; the twin also keeps those that reach no tile.
    assert shown.any() and not np.any(shown & ~wanted.visible)
    means2d = run.splat("PIXEL_X", "PIXEL_Y").astype(np.float64) + run.splat("SUB_X", "SUB_Y")
    # Carried in two floats: what is left is the rounding of the part below a pixel, and of far-off pixels.
    assert_close(means2d[shown], wanted.means2d[shown], relative=1e-7, absolute=1e-6)
    assert_close(run.splat("DEPTH")[shown, 0], wanted.depths[shown], relative=1e-6)
    assert_close(run.splat("RED", "GREEN", "BLUE")[shown], wanted.colors[shown], absolute=2e-6)
    # Antialiased, the root of a quotient of two determinants of some ten roundings each.
    relative = 1e-5 if scene[0].antialiased else 2e-6
    assert_close(2 ** run.splat("LOG2O")[shown, 0], wanted.opacities[shown], relative=relative)
    # Relative to the row's own size: l12 passes through zero.
    whitening = wanted.whitening[shown]
    scale = np.abs(whitening).max(axis=1, keepdims=True)
    # Some twenty roundings of 6e-8 each; a needle's too, as nothing of its size is subtracted.
    assert_close(run.splat("L11", "L12", "L22")[shown] / WHITEN / scale, whitening / scale, absolute=1e-5)


WAYS = (SlotFields(), SlotFields(absolute=True), SlotFields(absolute=True, contributions=True))
"""Fields of slots: the plain ones, and those that density control may want."""


@pytest.mark.smoke
@pytest.mark.parametrize("name", EVERY)
def test_gradients(device: Device, name: str) -> None:
    run = Pipeline.run(device, scene := EVERY[name]())
    for fields in WAYS:
        assert_gradients(run, scene, fields)


@pytest.mark.parametrize(
    "name", quick([name for name in EVERY if name.split()[-1] in scenes.SHAPE_MATTERS], *scenes.SHAPE_MATTERS)
)
def test_gradients_in_every_shape(shaped_device: Device, name: str) -> None:
    run = Pipeline.run(shaped_device, scene := EVERY[name]())
    for fields in WAYS:
        assert_gradients(run, scene, fields)


@pytest.mark.parametrize("degree", [0, 1, 2, 3])
def test_every_sh_degree(device: Device, degree: int) -> None:
    scene = scenes.random_cloud(60, 11, 40, 30, degree=degree)
    run = Pipeline.run(device, scene)
    wanted = reference.forward(*scene).projected
    assert_close(run.splat("RED", "GREEN", "BLUE")[run.visible], wanted.colors[run.visible], absolute=2e-6)
    d_image = np.ones((30, 40, 3))
    got, _ = run.backward(d_image)
    assert_close_gradient(got.sh, reference.render_grad(*scene, d_image, (0.1, 0.2, 0.3)).parameters["sh"], 1e-4)


def test_culled_gaussians_get_no_gradient(device: Device) -> None:
    scene = scenes.off_frustum()
    run = Pipeline.run(device, scene)
    got, _ = run.backward(np.ones((run.camera.height, run.camera.width, 3)))
    hidden = ~run.visible
    assert hidden.any()
    assert not any(values[hidden].any() for values in got.arrays().values())


def test_radial_quaternion_gradient_is_zero(device: Device) -> None:
    gaussians, camera = scenes.overlap()
    run = Pipeline.run(device, (gaussians, camera))
    got, _ = run.backward(np.random.default_rng(3).standard_normal((camera.height, camera.width, 3)))
    radial = np.abs((got.quaternions * gaussians.quaternions).sum(axis=1))
    size = np.linalg.norm(got.quaternions, axis=1) * np.linalg.norm(gaussians.quaternions, axis=1)
    assert np.all(radial <= 1e-5 * size + 1e-7)
