# SPDX-License-Identifier: Apache-2.0
"""values.cl, values_grad.cl and pixels.cl in every shape, against the float64 twin."""

from __future__ import annotations

import numpy as np
import pytest
from compare import assert_close, assert_close_gradient, assert_same_bits
from flat import cloud
from pipeline import EVERY_SHAPE, shaped, shapes_of

from clsplat.device.context import Device
from clsplat.reference import values as twin
from clsplat.stages.values import most_gradients, most_values, passes

WIDTH, HEIGHT = 51, 37


def test_passes_are_all_values_once() -> None:
    assert list(passes(3, 3, 32)) == []
    assert list(passes(3, 4, 32)) == [(3, 1)]
    assert list(passes(0, 32, 32)) == [(0, 32)]
    assert list(passes(0, 33, 32)) == [(0, 32), (32, 1)]


def test_pictures_and_gradients_against_the_twin(shaped_device: Device) -> None:
    """Of two passes of the picture, and of the gradient."""
    depth = most_gradients(shaped_device) + 4
    flat, rng = cloud(150, WIDTH, HEIGHT, depth, seed=depth, opaque=0.3), np.random.default_rng(depth)
    background = rng.uniform(0, 1, depth).astype(np.float32)
    wanted = twin.blend_values(flat.twin, WIDTH, HEIGHT, background)
    sure = wanted.margin > 1e-4
    assert sure.mean() > 0.9
    d_image = np.where(sure[:, :, None], rng.normal(size=(HEIGHT, WIDTH, depth)), 0).astype(np.float32)
    d_alpha = np.where(sure, rng.normal(size=(HEIGHT, WIDTH)), 0).astype(np.float32)
    pixels = flat.pixels(shaped_device, WIDTH, HEIGHT, background=background)
    # alpha is good to 2e-7 of itself in each of a few layers
    assert_close(pixels.image[sure], wanted.image[sure], absolute=1e-6)
    assert_close(pixels.alpha[sure], 1 - wanted.transmittance[sure], absolute=1e-6)
    got = pixels.gradient(d_image, d_alpha, absolute=True)
    of = twin.blend_values_grad(flat.twin, WIDTH, HEIGHT, background, d_image, d_alpha)
    names = {"colours": "values"}
    for name, array in got.items():
        # sums of up to some hundred pixels, of transmittances that are recovered by division
        assert_close_gradient(array, getattr(of, names.get(name, name)), 5e-6, name=name)


@pytest.mark.slow
@EVERY_SHAPE
def test_the_same_pictures_in_every_shape(device: Device, every: bool) -> None:
    flat, pictures = cloud(400, 90, 60, 4, opaque=0.2), []
    for shape in shapes_of(device, (4, 1), every=every):
        pixels = flat.pixels(shaped(device, *shape), 90, 60)
        pictures.append((pixels.image.copy(), pixels.alpha.copy()))
    for image, alpha in pictures[1:]:
        assert_same_bits(image, pictures[0][0])
        assert_same_bits(alpha, pictures[0][1])


def test_the_first_three_of_more_values_are_a_picture_of_three(device: Device) -> None:
    flat = cloud(200, WIDTH, HEIGHT, 5)
    image = flat.pixels(device, WIDTH, HEIGHT).image
    swapped = cloud(200, WIDTH, HEIGHT, 5)
    swapped.colours[:] = swapped.colours[:, [3, 4, 2, 0, 1]]
    others = swapped.pixels(device, WIDTH, HEIGHT).image
    assert_same_bits(others[:, :, [3, 4, 2, 0, 1]], image)  # by blend and by values, with the same weights


def test_a_pass_fits_a_group(shaped_device: Device) -> None:
    assert 1 <= most_values(shaped_device) <= 32
    assert 4 <= most_gradients(shaped_device) <= 32
