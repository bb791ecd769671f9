# SPDX-License-Identifier: Apache-2.0
"""The kernels' gradients against central differences of the twin's frames, and how far each Gaussian's is off."""

from __future__ import annotations

from functools import cache

import numpy as np
import pytest
import scenes
from compare import assert_close_gradients, assert_same_bits
from pipeline import BACKGROUND, Pipeline, shaped
from quick import quick

from clsplat.device.context import Device
from clsplat.gaussians import Gaussians
from clsplat.layouts.columns import PLAIN_SLOTS, SlotFields
from clsplat.reference.blend import blend
from clsplat.reference.project import project
from clsplat.reference.render import forward, parameters, render_grad
from clsplat.selftest.harness import planes_of

GROUPS = ("means", "quaternions", "log_scales", "opacity_logits", "sh")
BAND = 1e-4
MOST_IN_BAND = {"many_per_tile": 0.03}
"""Of the pixels: some hundred layers have a decision each, of which 2e-4 are in the band; elsewhere there are few."""
QUICK = ("overlap", "saturating", "off_frustum", "needles")
STEP = 1e-8
"""Next to the near plane a step of 1e-6 moves a Gaussian by a hundredth of a pixel, and some across the band. The loss,
of a size of 100, is rounded to 1e-14, a slope so to 1e-6 of gradients of a size of 1 to 1000."""
SLOPE_TOLERANCE = 1e-4
"""Error allowed of a kernel's gradient along a random direction, as in the tests of the twins. It is relative to the
gradient's norm: a random direction sees this norm times a normal number."""
GRADIENT_TOLERANCE = 1e-4
"""Error allowed of a parameter group's gradient, relative to the twin's (`assert_close_gradients`)."""
GAUSSIAN_TOLERANCE = 1e-3
"""Error allowed of one Gaussian's gradient, relative to its norm, for 999 of 1000 Gaussians."""


@cache
def subject(name: str) -> tuple[tuple[Gaussians, scenes.Camera], np.ndarray]:
    """Scene and the image's gradient, which is 0 where float32 may decide otherwise."""
    gaussians, camera = scenes.NAMED[name]()
    margin = forward(gaussians, camera, BACKGROUND).blended.margin
    band = margin < BAND
    assert band.mean() <= MOST_IN_BAND.get(name, 0.005), "the band hides more than its share"
    d_image = np.random.default_rng(5).standard_normal((camera.height, camera.width, 3))
    d_image[band] = 0
    return (gaussians, camera), d_image


def loss(arrays: dict[str, np.ndarray], camera: scenes.Camera, d_image: np.ndarray) -> float:
    projected = project(**arrays, camera=camera, sh_degree=3)
    return float((blend(projected, camera.width, camera.height, BACKGROUND).image * d_image).sum())


@pytest.mark.parametrize("group", GROUPS)
@pytest.mark.parametrize("name", quick(["overlap", "many_per_tile", "saturating", "off_frustum", "needles"], *QUICK))
def test_slopes_along_random_directions(default_device: Device, name: str, group: str) -> None:
    (gaussians, camera), d_image = subject(name)
    got, _ = Pipeline.run(default_device, (gaussians, camera)).backward(d_image)
    gradient = getattr(got, group).astype(np.float64)
    arrays, rng = parameters(gaussians), np.random.default_rng(6)
    found, wanted = [], []
    for _ in range(6):
        direction = rng.standard_normal(gradient.shape)
        slopes = []
        for step in (STEP, -STEP):
            moved = {**arrays, group: arrays[group] + step * direction}
            slopes.append(loss(moved, camera, d_image))
        wanted.append((slopes[0] - slopes[1]) / (2 * STEP))
        found.append(float((gradient * direction).sum()))
    error = np.abs(np.subtract(found, wanted)).max()
    assert error <= SLOPE_TOLERANCE * np.linalg.norm(gradient), (found, wanted)


@pytest.mark.slow
@pytest.mark.parametrize("fields", [PLAIN_SLOTS, SlotFields(absolute=True, contributions=True)])
def test_groups_of_32_to_256_items_have_one_order_of_sums(default_device: Device, fields: SlotFields) -> None:
    scene, d_image = subject("needles")
    pipelines = [Pipeline.run(shaped(default_device, 1, items), scene) for items in (64, 32, 128, 256)]
    first, *others = (each.slots(planes_of(d_image), fields) for each in pipelines)
    assert np.count_nonzero(first)
    for each in others:
        assert_same_bits(each, first)


def test_999_of_a_thousand_gaussians(default_device: Device) -> None:
    """Of each Gaussian's own gradient, over scenes of a thousand and more."""
    errors: dict[str, list[np.ndarray]] = {group: [] for group in GROUPS}
    for name in scenes.NAMED:
        if name == "one":
            continue
        scene, d_image = subject(name)
        got, _ = Pipeline.run(default_device, scene).backward(d_image)
        wanted = render_grad(*scene, d_image, BACKGROUND).parameters
        assert_close_gradients(got.arrays(), wanted, GRADIENT_TOLERANCE)
        for group in GROUPS:
            found, want = getattr(got, group).reshape(len(scene[0]), -1), wanted[group].reshape(len(scene[0]), -1)
            size = np.linalg.norm(want, axis=1)
            errors[group].append(np.linalg.norm(found - want, axis=1)[size > 0] / size[size > 0])
    for group, parts in errors.items():
        every = np.concatenate(parts)
        assert len(every) > 900
        assert np.quantile(every, 0.999, method="lower") <= GAUSSIAN_TOLERANCE, group
