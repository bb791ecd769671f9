# SPDX-License-Identifier: Apache-2.0
"""Frames of a model that is held: fewer SH bands, and halves."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
import pytest
import scenes
from compare import assert_same_bits
from numpy.typing import NDArray
from quick import quick

from clsplat.arrays import Float32
from clsplat.camera import Camera
from clsplat.config.rasterizer import BenchSwitches
from clsplat.device.context import Device
from clsplat.errors import InputError
from clsplat.gaussians import Gaussians
from clsplat.rendering.renderer import Renderer, held_sh
from clsplat.rendering.sh_storage import needed_degrees
from clsplat.stages.device_gaussians import DeviceGaussians, HostGaussians, upload_gaussians


def cloud(count: int = 1000) -> scenes.Scene:
    return scenes.random_cloud(count, 8, 100, 70)


def frame(device: Device, gaussians: Gaussians, camera: Camera, **settings: object) -> Float32:
    """By a new Renderer."""
    config = replace(BenchSwitches(), **settings)  # type: ignore[arg-type]
    return Renderer(device, config=config).render(gaussians, camera).image


def whole(device: Device, gaussians: Gaussians, camera: Camera) -> Float32:
    """With every coefficient looked at."""
    return Renderer(device).render(upload_gaussians(device, gaussians), camera).image


def with_sh(gaussians: Gaussians, sh: Float32) -> Gaussians:
    return replace(gaussians, sh=np.ascontiguousarray(sh, np.float32))


def cut(gaussians: Gaussians, degrees: NDArray[np.uint8]) -> Gaussians:
    """The bands above each Gaussian's degree as zeros."""
    band = np.repeat(np.arange(4), 2 * np.arange(4) + 1)
    return with_sh(gaussians, np.where(band[None, :, None] <= degrees[:, None, None], gaussians.sh, 0))


def held(renderer: Renderer) -> DeviceGaussians | HostGaussians:
    assert renderer._held is not None
    return renderer._held


@pytest.mark.parametrize("shares", [(1, 0, 0, 0), (0, 1, 0, 0), (0.2, 0.2, 0.6, 0), (0.6, 0.1, 0.1, 0.2)], ids=str)
def test_bands_that_are_zero_keep_the_bits(device: Device, shares: tuple[float, ...]) -> None:
    gaussians, camera = cloud()
    degrees = np.random.default_rng(1).choice(4, len(gaussians), p=shares).astype(np.uint8)
    gaussians = cut(gaussians, degrees)
    renderer = Renderer(device)
    assert_same_bits(renderer.render(gaussians, camera).image, whole(device, gaussians, camera))
    assert held(renderer).coefficients == (degrees.max() + 1) ** 2
    assert ("sh_degrees" in held(renderer).arrays) == (shares[0] == 0.6)


def test_degrees_are_those_of_the_gaussians(shaped_device: Device) -> None:
    """Not of zero bands: each Gaussian's other coefficients are there, and would show."""
    gaussians, camera = cloud()
    degrees = np.random.default_rng(1).integers(0, 4, len(gaussians)).astype(np.uint8)
    storage = replace(held_sh(gaussians, BenchSwitches()), degrees=degrees)
    renderer = Renderer(shaped_device)
    got = renderer.render(upload_gaussians(shaped_device, gaussians, storage), camera).image
    assert_same_bits(got, whole(shaped_device, cut(gaussians, degrees), camera))


@pytest.mark.parametrize("limit", quick([0, 1, 2], 1))
def test_degrees_and_the_limit_of_all(default_device: Device, limit: int) -> None:
    gaussians, camera = cloud()
    degrees = np.random.default_rng(1).choice(4, len(gaussians), p=(0.6, 0.1, 0.1, 0.2)).astype(np.uint8)
    gaussians = cut(gaussians, degrees)
    wanted = whole(default_device, cut(gaussians, np.full(len(gaussians), limit, np.uint8)), camera)
    assert_same_bits(frame(default_device, gaussians, camera, sh_degree_limit=limit), wanted)


@pytest.mark.parametrize("tolerance", [0.05, 0.3, 0.8])
def test_tolerance(default_device: Device, tolerance: float) -> None:
    """A pixel's weights add up to at most 1, so that its error is at most that of a Gaussian's colour."""
    gaussians, camera = cloud()
    renderer = Renderer(default_device, config=BenchSwitches(sh_tolerance=tolerance))
    got, wanted = renderer.render(gaussians, camera).image, whole(default_device, gaussians, camera)
    difference = np.abs(got - wanted).max()
    assert difference <= tolerance + 1e-6  # rounding of colours up to 2
    degrees = needed_degrees(gaussians.sh, tolerance)
    if tolerance > 0.5:
        assert difference > 0, "it does something"
        assert held(renderer).arrays["sh_degrees"].get().tolist() == degrees.tolist()
        assert_same_bits(got, whole(default_device, cut(gaussians, degrees), camera))
    if tolerance < 0.1:
        assert "sh_degrees" not in held(renderer).arrays, "too few fall away for it to be worth while"


@pytest.mark.parametrize("degree", [0, 1, 2, 3])
def test_halves(default_device: Device, degree: int) -> None:
    gaussians, camera = scenes.random_cloud(1000, 8, 100, 70, degree=degree)
    rounded = gaussians.sh.copy()
    rounded[:, 1:] = rounded[:, 1:].astype(np.float16)
    renderer = Renderer(default_device, config=BenchSwitches(sh_storage="half"))
    got = renderer.render(gaussians, camera).image
    assert_same_bits(got, whole(default_device, with_sh(gaussians, rounded), camera))
    assert held(renderer)["sh_rest"].nbytes == 2 * gaussians.sh[:, 1:].size
    wanted = whole(default_device, gaussians, camera)
    # half a unit of a half's last digit, up to 2^-12 of each coefficient, which |Y| < 1.5 times 15 of them, 0.5 large
    assert np.abs(got - wanted).max() <= 2**-12 * 0.5 * 15 * 1.5
    assert degree == 0 or not np.array_equal(got, wanted)


def test_halves_in_every_shape(shaped_device: Device, default_device: Device) -> None:
    gaussians, camera = cloud()
    got = frame(shaped_device, gaussians, camera, sh_storage="half", sh_tolerance=0.8)
    assert_same_bits(got, frame(default_device, gaussians, camera, sh_storage="half", sh_tolerance=0.8))


def test_what_no_half_holds(default_device: Device) -> None:
    gaussians, camera = cloud(10)
    gaussians.sh[3, 5, 1] = 1e5
    with pytest.raises(InputError, match="coefficient of 100000, expected at most 65504; use float"):
        frame(default_device, gaussians, camera, sh_storage="half")


def test_frames_do_not_depend_on_those_before(default_device: Device) -> None:
    gaussians, camera = cloud()
    renderer = Renderer(default_device)
    for index in range(4):
        each = replace(camera, translation=camera.translation - np.array([0.02 * index, 0, 0]))
        assert_same_bits(renderer.render(gaussians, each).image, whole(default_device, gaussians, each))


# In less memory


@pytest.mark.parametrize("share", [1.5, 0.9, 0.55])
@pytest.mark.parametrize("settings", [{"sh_storage": "half"}, {"sh_tolerance": 0.8}, {"frustum_cull": False}], ids=str)
def test_a_frame_in_less_memory(default_device: Device, settings: dict[str, object], share: float) -> None:
    gaussians, camera = cloud(6000)
    free = default_device.with_memory_limit(None)
    wanted = frame(free, gaussians, camera, **settings)
    limit = int(share * free.memory.peak)
    device = default_device.with_memory_limit(limit)
    renderer = Renderer(device, config=replace(BenchSwitches(), **settings))  # type: ignore[arg-type]
    for _ in range(2):
        assert_same_bits(renderer.render(gaussians, camera).image, wanted)
    assert device.memory.peak <= limit
    assert isinstance(held(renderer), HostGaussians) == (share < 1)


def test_halves_take_less_memory(default_device: Device) -> None:
    gaussians, camera = cloud(6000)
    peaks = []
    for storage in ("float", "half"):
        device = default_device.with_memory_limit(None)
        frame(device, gaussians, camera, sh_storage=storage)
        peaks.append(device.memory.peak)
    assert peaks[0] - peaks[1] == pytest.approx(6000 * 90, abs=64)
    # What fits as halves and not as floats is held on the device all the same.
    device = default_device.with_memory_limit(peaks[0] - 6000 * 60)
    renderer = Renderer(device, config=BenchSwitches(sh_storage="half"))
    renderer.render(gaussians, camera)
    assert isinstance(held(renderer), DeviceGaussians)
