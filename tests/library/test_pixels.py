# SPDX-License-Identifier: Apache-2.0
"""Pixels from arrays against dense compositing in float64, and what a session keeps."""

from __future__ import annotations

import gc
from dataclasses import replace

import numpy as np
import pytest
from calls import refuses
from compare import assert_close, assert_close_gradient, assert_same_bits
from flat import cloud

from clsplat.device.buffers import from_host, hosted, upload
from clsplat.device.context import Device
from clsplat.errors import CapacityError
from clsplat.library import pixels as pixels_module
from clsplat.library.session import session_of
from clsplat.reference import values as twin

WIDTH, HEIGHT = 45, 35
NAMES = {"colours": "values"}


@pytest.mark.parametrize(
    ("depth", "alpha_max"),
    [
        *((1, 0.99), (3, 0.999), (40, 0.99)),
        *(pytest.param(*each, marks=pytest.mark.slow) for each in ((2, 0.99), (3, 0.99), (4, 0.999), (32, 0.99))),
    ],
)
def test_pictures_and_gradients_against_dense_compositing(device: Device, depth: int, alpha_max: float) -> None:
    flat, rng = cloud(120, WIDTH, HEIGHT, depth, seed=depth, opaque=0.3), np.random.default_rng(depth)
    background, cap = rng.uniform(0, 1, depth).astype(np.float32), float(np.float32(alpha_max))
    wanted = twin.blend_values(flat.twin, WIDTH, HEIGHT, background, cap)
    sure = wanted.margin > 1e-4
    assert sure.mean() > 0.9
    d_image = np.where(sure[:, :, None], rng.normal(size=(HEIGHT, WIDTH, depth)), 0).astype(np.float32)
    d_alpha = np.where(sure, rng.normal(size=(HEIGHT, WIDTH)), 0).astype(np.float32)
    pixels = flat.pixels(device, WIDTH, HEIGHT, background=background, alpha_max=alpha_max)
    # alpha is good to 2e-7 of itself in each of a few layers
    assert_close(pixels.image[sure], wanted.image[sure], absolute=1e-6)
    assert_close(pixels.alpha[sure], 1 - wanted.transmittance[sure], absolute=1e-6)
    of = twin.blend_values_grad(flat.twin, WIDTH, HEIGHT, background, d_image, d_alpha, cap)
    # sums of up to some hundred pixels; recovered by division, a transmittance of layers at the cap loses the more
    for name, array in pixels.gradient(d_image, d_alpha, absolute=True).items():
        assert_close_gradient(array, getattr(of, NAMES.get(name, name)), 5e-6, name=name)
    of = twin.blend_values_grad(flat.twin, WIDTH, HEIGHT, background, d_image, np.zeros_like(d_alpha), cap)
    plain = pixels.gradient(d_image)
    assert set(plain) == {"means2d", "conics", "opacities", "colours", "background"}
    for name, array in plain.items():
        assert_close_gradient(array, getattr(of, NAMES.get(name, name)), 5e-6, name=name)  # as above


def test_the_cap_is_asked_for(default_device: Device) -> None:
    flat = cloud(1, 5, 5)
    flat = replace(flat, means2d=np.full((1, 2), 2.5, np.float32), opacities=np.ones(1, np.float32))
    flat = replace(flat, radii=np.full((1, 2), 5, np.int32))
    for alpha_max in (0.99, 0.999, 0.5):
        alpha = flat.pixels(default_device, 5, 5, alpha_max=alpha_max).alpha
        assert_close(alpha[2, 2], alpha_max, absolute=1e-7)  # 1 - (1 - alpha), rounded twice


@pytest.mark.parametrize("depth", [3, 6])
def test_nothing_to_see(device: Device, depth: int) -> None:
    background = np.linspace(0.1, 0.9, depth, dtype=np.float32)
    for flat in (
        cloud(0, WIDTH, HEIGHT, depth),
        replace(cloud(9, WIDTH, HEIGHT, depth), radii=np.zeros((9, 2), np.int32)),
    ):
        pixels = flat.pixels(device, WIDTH, HEIGHT, background=background)
        assert_same_bits(pixels.image, np.broadcast_to(background, (HEIGHT, WIDTH, depth)))
        assert not pixels.alpha.any()
        assert not pixels.tile_counts.any()
        got = pixels.gradient(np.ones((HEIGHT, WIDTH, depth), np.float32), np.ones((HEIGHT, WIDTH), np.float32))
        assert_close(got.pop("background"), np.full(depth, WIDTH * HEIGHT), relative=1e-6)  # one rounding
        assert not any(array.any() for array in got.values())


@pytest.mark.parametrize("depth", [3, 7])
def test_passes_keep_what_their_gradients_need(default_device: Device, depth: int) -> None:
    d_image = np.random.default_rng(0).normal(size=(HEIGHT, WIDTH, depth)).astype(np.float32)
    first, second = (cloud(n, WIDTH, HEIGHT, depth, seed=n) for n in (80, 300))
    alone = first.pixels(default_device, WIDTH, HEIGHT).gradient(d_image)
    kept = first.pixels(default_device, WIDTH, HEIGHT)
    other = second.pixels(default_device, WIDTH, HEIGHT)
    other.gradient(d_image)
    for name, array in kept.gradient(d_image).items():
        assert_same_bits(array, alone[name], name)
    for name, array in kept.gradient(d_image).items():  # more than once
        assert_same_bits(array, alone[name], name)


@pytest.mark.slow
def test_memory_of_a_pass_that_is_gone_is_used_again(default_device: Device) -> None:
    session, flat = session_of(default_device), cloud(50, WIDTH, HEIGHT)
    works = {id(flat.pixels(default_device, WIDTH, HEIGHT)._work) for _ in range(3)}  # what is tested
    gc.collect()
    assert len(works) == 1
    assert session is session_of(default_device)


def test_arrays_in_any_order_of_memory_and_on_the_device(default_device: Device) -> None:
    flat = cloud(60, WIDTH, HEIGHT, 4)
    image = flat.pixels(default_device, WIDTH, HEIGHT).image
    turned = [np.asfortranarray(array) for array in flat.arrays]
    turned[0] = np.repeat(flat.means2d, 2, axis=0)[::2].astype(np.float64)
    on_device = [upload(default_device, array) for array in flat.arrays]
    for arrays in (turned, on_device):
        gaussians = pixels_module.screen_gaussians(default_device, *arrays)
        got = pixels_module.PixelPass(session_of(default_device), gaussians, (WIDTH, HEIGHT))
        assert_same_bits(got.image, image)


def test_more_pairs_than_there_is_room_for(default_device: Device, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(pixels_module, "MAX_PAIRS_PER_BAND", 10)
    refuses("has room for 10", cloud(60, WIDTH, HEIGHT).pixels, default_device, WIDTH, HEIGHT, error=CapacityError)


@pytest.mark.parametrize("pretend", ["", "gpu"])
def test_arrays_of_the_host(default_device: Device, pretend: str, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setenv("CLSPLAT_PRETEND", pretend)
    device = default_device.with_shape()  # opened anew
    assert device.shares_memory == (not pretend and default_device.shares_memory)
    given = np.arange(12, dtype=np.float32).reshape(3, 4)
    assert_same_bits(from_host(device, given).get(), given)
    assert_same_bits(from_host(device, given.T).get(), np.ascontiguousarray(given.T))
    for shape in ((3, 5), (0, 5), (7,)):
        room = hosted(device, shape)
        room.array.fill(3.0)
        assert_same_bits(room.get(), np.full(shape, 3, np.float32))
        room.array.fill(4.0)
        assert_same_bits(room.get(), np.full(shape, 4, np.float32))


@pytest.mark.parametrize("depth", [3, 6])
def test_a_pass_that_is_dropped_keeps_its_arrays_until_it_is_done(default_device: Device, depth: int) -> None:
    flat = cloud(500, WIDTH, HEIGHT, depth)
    for _ in range(3):
        pixels = flat.pixels(default_device, WIDTH, HEIGHT)
        pixels.gradient_on_device(np.ones((HEIGHT, WIDTH, depth), np.float32))
        del pixels
        assert default_device.under_way
    default_device.finish()
    assert not default_device.under_way
