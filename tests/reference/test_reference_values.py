# SPDX-License-Identifier: Apache-2.0
"""The float64 twins of splats and values: finite differences, closed forms and the twin of blending."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
import pytest
from compare import assert_close, assert_close_gradient
from flat import cloud

from clsplat.reference import splats as splats_twin
from clsplat.reference import values as twin

WIDTH, HEIGHT, DEPTH = 24, 18, 4


def test_one_gaussian_has_a_formula() -> None:
    flat = cloud(1, WIDTH, HEIGHT, DEPTH).twin
    one = replace(flat, means2d=np.array([[5.5, 4.5]]), opacities=np.array([0.5]), drawn=np.array([True]))
    one = replace(one, conics=np.array([[0.2, 0.05, 0.1]]))
    got = twin.blend_values(one, WIDTH, HEIGHT, np.full(DEPTH, 0.25))
    alpha = 0.5 * np.exp(-0.5 * (0.2 * 4 + 0.1) - 0.05 * 2)  # two to the right, one down
    assert_close(got.transmittance[5, 7], 1 - alpha, relative=1e-14)  # a few roundings
    assert_close(got.image[5, 7], alpha * one.values[0] + (1 - alpha) * 0.25, relative=1e-14)  # as above


@pytest.mark.parametrize("name", ["means2d", "conics", "opacities", "values", "background"])
def test_gradients_by_finite_differences(name: str) -> None:
    flat, rng = cloud(12, WIDTH, HEIGHT, DEPTH, seed=4, opaque=0.0).twin, np.random.default_rng(7)
    background = rng.uniform(0, 1, DEPTH)
    sure = twin.blend_values(flat, WIDTH, HEIGHT, background).margin > 1e-3  # steps move what decides by less
    assert sure.mean() > 0.8
    d_image = np.where(sure[:, :, None], rng.normal(size=(HEIGHT, WIDTH, DEPTH)), 0)
    d_alpha = np.where(sure, rng.normal(size=(HEIGHT, WIDTH)), 0)
    given = background if name == "background" else getattr(flat, name)

    def loss(moved: np.ndarray) -> float:  # type: ignore[type-arg]  # of any shape
        behind = moved if name == "background" else background
        there = flat if name == "background" else replace(flat, **{name: moved})
        got = twin.blend_values(there, WIDTH, HEIGHT, behind)
        return float((got.image * d_image).sum() + ((1 - got.transmittance) * d_alpha).sum())

    wanted, step = np.zeros_like(given), 1e-6
    for index in np.ndindex(given.shape):
        ahead, back = given.copy(), given.copy()
        ahead[index] += step
        back[index] -= step
        wanted[index] = (loss(ahead) - loss(back)) / (2 * step)
    got = getattr(twin.blend_values_grad(flat, WIDTH, HEIGHT, background, d_image, d_alpha), name)
    assert_close_gradient(
        got, wanted, 1e-6, name=name
    )  # central differences: 1e-12 of a third derivative, 1e-10 of rounding


def test_splats_are_of_the_same_ellipse() -> None:
    flat = cloud(50, WIDTH, HEIGHT).twin
    got = splats_twin.splats(flat.conics, flat.opacities, np.full((50, 2), 9, np.int32))
    w11, w12, w22 = got.whitenings[got.drawn].T
    assert_close(
        np.stack([w11 * w11, w11 * w12, w12 * w12 + w22 * w22], axis=1), flat.conics[got.drawn], relative=1e-12
    )
    half = got.half_extents[got.drawn]  # on the box's right side alpha is 1/255 at one point, and less elsewhere
    a, b, c = flat.conics[got.drawn].T
    dy = -b / c * half[:, 0]
    alpha = flat.opacities[got.drawn] * np.exp(-0.5 * (a * half[:, 0] ** 2 + c * dy * dy) - b * half[:, 0] * dy)
    assert_close(alpha, np.full(len(alpha), 1 / 255), relative=1e-9)  # of a conic that float32 has rounded


def test_moments_have_the_gradients_of_pixels() -> None:
    flat, rng = cloud(20, WIDTH, HEIGHT, DEPTH, seed=2).twin, np.random.default_rng(0)
    flat = replace(flat, drawn=np.ones(20, np.bool_), opacities=np.maximum(flat.opacities, 0.1))
    x, y = rng.normal(size=(2, 20, 40)) * 3
    g = rng.normal(size=(20, 40))
    whitenings = splats_twin.splats(flat.conics, flat.opacities, np.full((20, 2), 9, np.int32)).whitenings
    w11, w12, w22 = whitenings.T[:, :, None]
    u, v = w11 * x + w12 * y, w22 * y
    moments = np.stack([(g * of).sum(axis=1) for of in (np.ones_like(u), u, v, u * u, u * v, v * v)], axis=1)
    got = splats_twin.splats_grad(flat.conics, flat.opacities, moments)
    a, b, c = flat.conics.T[:, :, None]
    by_mean = np.stack([(-g * (a * x + b * y)).sum(axis=1), (-g * (b * x + c * y)).sum(axis=1)], axis=1)
    by_conic = np.stack(
        [-0.5 * (g * x * x).sum(axis=1), -(g * x * y).sum(axis=1), -0.5 * (g * y * y).sum(axis=1)], axis=1
    )
    assert_close_gradient(got.means2d, by_mean, 1e-12)  # roundings of sums
    assert_close_gradient(got.conics, by_conic, 1e-10)  # and of what a lean ellipse cancels
    assert_close_gradient(got.opacities, g.sum(axis=1) / flat.opacities, 1e-12)  # as the first
