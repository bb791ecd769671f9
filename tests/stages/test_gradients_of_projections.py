# SPDX-License-Identifier: Apache-2.0
"""The gradient of orthographic, fisheye and equirectangular pictures, and of perspective ones along rays: the twin
against central differences, and the kernels against the twin."""

from __future__ import annotations

from dataclasses import replace
from functools import cache

import numpy as np
import pytest
import scenes
from compare import assert_close_gradient, assert_close_gradients, assert_same_arrays, assert_same_bits, assert_slopes
from pipeline import BACKGROUND, Pipeline, shaped, shapes_of
from quick import quick
from test_project_rays import all_around, fisheye, panorama, pinhole

from clsplat.camera import Camera
from clsplat.device.context import Device
from clsplat.gaussians import Gaussians
from clsplat.layouts.columns import PLAIN_SLOTS, WIDEST_SLOTS, SlotFields
from clsplat.reference import every_pixel
from clsplat.selftest.harness import planes_of

BENT = (0.04, -0.012, 0.004, -0.0006)
CAMERAS: dict[str, Camera] = {
    "orthographic": replace(scenes.tilted_camera(50, 40), fx=14.0, fy=15.0, projection="orthographic"),
    "panorama": panorama(70, 35),
    "half a turn": panorama(64, 40, np.pi),
    "fisheye of 190 degrees": fisheye(60, 50, 190),
    "fisheye of 300 degrees": fisheye(60, 60, 300),
    "bent fisheye": replace(fisheye(60, 50, 190), radial=BENT),
    "fisheye that folds over": replace(fisheye(60, 50, 150), radial=(-0.06, 0.0, 0.0, 0.0)),
    "perspective": pinhole(60, 50, 70),
    "perspective of 150 degrees": pinhole(60, 50, 150),
    "antialiased panorama": panorama(70, 35),
    "antialiased perspective": pinhole(60, 50, 110),
    "antialiased fisheye": replace(fisheye(60, 50, 190), radial=BENT),
}
"""By name; what begins with antialiased is, with Gaussians small enough that the low-pass tells."""
QUICK = ("orthographic", "panorama", "bent fisheye")
"""Each kind of kernels once: these are made by projection."""
BAND = 3e-4
STEP = 1e-7


def subject(name: str, count: int) -> tuple[Gaussians, Camera]:
    if name == "orthographic":
        return scenes.overlap(count=count)[0], CAMERAS[name]
    gaussians = all_around(count, 5)
    if name.startswith("antialiased"):
        gaussians = replace(gaussians, antialiased=True, log_scales=gaussians.log_scales - np.float32(1.0))
    return gaussians, CAMERAS[name]


def direction_of_loss(gaussians: Gaussians, camera: Camera, band: float) -> np.ndarray:
    """The image's gradient, which is 0 where float32 or a step may decide otherwise."""
    d_image = np.random.default_rng(5).standard_normal((camera.height, camera.width, 3))
    d_image[every_pixel.render(gaussians, camera, BACKGROUND).margin < band] = 0
    return d_image


@cache
def wanted(name: str) -> tuple[np.ndarray, every_pixel.GradientsTwin]:
    gaussians, camera = subject(name, 200)
    d_image = direction_of_loss(gaussians, camera, BAND)
    assert (d_image != 0).mean() > 0.8
    return d_image, every_pixel.render_grad(gaussians, camera, d_image, BACKGROUND)


@pytest.mark.parametrize("name", quick(CAMERAS, "orthographic", "antialiased fisheye"))
def test_the_twin_by_central_differences(name: str) -> None:
    gaussians, camera = subject(name, 40)
    model = scenes.in_float64(gaussians)
    d_image = direction_of_loss(model, camera, 2e-4)
    gradients = every_pixel.render_grad(model, camera, d_image, BACKGROUND).parameters

    def loss(arrays: dict[str, np.ndarray]) -> float:
        return float((every_pixel.render(replace(model, **arrays), camera, BACKGROUND).image * d_image).sum())

    assert_slopes(loss, model.arrays(), gradients, step=STEP, tolerance=2e-6)


@pytest.mark.parametrize(
    ("name", "absolute"),
    [
        *(pytest.param(name, False, marks=() if name in QUICK else pytest.mark.slow) for name in CAMERAS),
        *(pytest.param(name, True, marks=pytest.mark.slow) for name in QUICK),
    ],
)
def test_the_kernels_against_the_twin(shaped_device: Device, name: str, absolute: bool) -> None:
    (gaussians, camera), (d_image, exact) = subject(name, 200), wanted(name)
    got, screen = Pipeline.run(shaped_device, (gaussians, camera)).backward(d_image, absolute=absolute)
    assert_close_gradients(got.arrays(), exact.parameters, 1e-4)
    on_image = exact.abs_means2d if absolute else exact.means2d
    shown = np.abs(on_image).sum(axis=1) > 0
    assert shown.sum() > 20
    assert_close_gradient(screen[shown], on_image[shown], 1e-4, name="screen")


@pytest.mark.parametrize("name", quick(["panorama", "bent fisheye"], "bent fisheye"))
def test_contributions(default_device: Device, name: str) -> None:
    (gaussians, camera), (d_image, exact) = subject(name, 200), wanted(name)
    _, screen = Pipeline.run(default_device, (gaussians, camera)).screened(d_image, SlotFields(contributions=True))
    assert screen.contributions is not None
    shown = exact.contributions > 0
    assert_close_gradient(screen.contributions.get()[shown], exact.contributions[shown], 1e-4, name=name)


@pytest.mark.slow
@pytest.mark.parametrize(
    ("name", "fields", "items"),
    [("bent fisheye", WIDEST_SLOTS, 32), ("panorama", PLAIN_SLOTS, 128), ("perspective", WIDEST_SLOTS, 256)],
    ids=lambda value: {PLAIN_SLOTS: "plain", WIDEST_SLOTS: "all"}.get(value, str(value)),
)
def test_groups_of_32_to_256_items_have_one_order_of_sums(
    default_device: Device, name: str, fields: SlotFields, items: int
) -> None:
    """Along rays each pixel has its own v, which warps that share half a tile leave each other."""
    scene = subject(name, 200)
    by_image = np.random.default_rng(2).standard_normal((scene[1].height, scene[1].width, 3 + fields.nearness))
    wanted, got = (
        Pipeline.run(shaped(default_device, 1, size), scene).slots(planes_of(by_image), fields) for size in (64, items)
    )
    assert np.count_nonzero(wanted.any(axis=1)) > 100, "pairs that have a gradient"
    assert_same_bits(got, wanted)


@pytest.mark.slow
def test_the_same_bits_twice_in_every_shape(device: Device) -> None:
    scene, (d_image, _) = subject("bent fisheye", 200), wanted("bent fisheye")
    for shape in shapes_of(device):
        first, second = (Pipeline.run(shaped(device, *shape), scene).backward(d_image)[0] for _ in range(2))
        assert_same_arrays(first.arrays(), second.arrays())


@pytest.mark.parametrize("name", quick(CAMERAS, "bent fisheye"))
def test_poisoned_memory_changes_no_bit(default_device: Device, monkeypatch: pytest.MonkeyPatch, name: str) -> None:
    scene, (d_image, _) = subject(name, 200), wanted(name)
    got = []
    for word in ("1", "0xff800000"):
        monkeypatch.setenv("CLSPLAT_POISON", word)
        got.append(Pipeline.run(default_device, scene).backward(d_image, absolute=True))
    first, second = (gradients.arrays() for gradients, _ in got)
    assert all(np.isfinite(values).all() for values in first.values())
    assert_same_arrays(first, second)


@pytest.mark.parametrize("name", quick(CAMERAS, "bent fisheye"))
def test_extreme_gaussians_have_finite_gradients(shaped_device: Device, name: str) -> None:
    """Needles, discs, specks and giants, some next to the camera, at a pole, straight behind or not numbers at all."""
    (gaussians, camera), (d_image, _) = subject(name, 200), wanted(name)
    rng = np.random.default_rng(8)
    arrays = {group: values.copy() for group, values in gaussians.arrays().items()}
    arrays["log_scales"] += rng.uniform(-20, 5, arrays["log_scales"].shape).astype(np.float32)
    arrays["log_scales"][:20] = [-30.0, -30.0, 1.0]
    arrays["log_scales"][20:40] = [-30.0, 1.0, 1.0]
    arrays["quaternions"][::7] *= np.float32(1e-9)
    arrays["quaternions"][1::7] *= np.float32(1e9)
    position = camera.position.astype(np.float32)
    axis = camera.rotation.astype(np.float32)
    for row, place in enumerate((axis[1], -axis[1], axis[2], -axis[2], 0.011 * axis[2], 1e6 * axis[0])):
        arrays["means"][50 + row] = position + place
    arrays["means"][60], arrays["log_scales"][61], arrays["quaternions"][62] = np.nan, np.nan, 0.0
    arrays["means"][63], arrays["log_scales"][64], arrays["opacity_logits"][65] = np.inf, 40.0, np.nan
    run = Pipeline.run(shaped_device, (Gaussians(**arrays, near=gaussians.near), camera))
    got, screen = run.backward(d_image, absolute=True)
    assert run.visible.sum() > 30
    for values in (*got.arrays().values(), screen):
        assert np.isfinite(values[run.visible]).all()
