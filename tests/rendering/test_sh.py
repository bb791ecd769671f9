# SPDX-License-Identifier: Apache-2.0
"""Which SH bands can be left out: the bounds hold, are no larger than need be, and zero is zero."""

from __future__ import annotations

import numpy as np
import pytest
from calls import refuses
from numpy.typing import NDArray

from clsplat.arrays import Float64
from clsplat.rendering.sh_storage import change_bounds, check_half, coefficients_in_use, needed_degrees
from clsplat.spherical_harmonics import sh_basis


def directions(count: int, seed: int = 0) -> Float64:
    found = np.random.default_rng(seed).normal(size=(count, 3))
    unit: Float64 = found / np.linalg.norm(found, axis=1, keepdims=True)
    return unit


def coefficients(count: int = 50, degree: int = 3) -> NDArray[np.float32]:
    return np.random.default_rng(2).normal(size=(count, (degree + 1) ** 2, 3)).astype(np.float32)


def band_of(values: NDArray[np.float32], degree: int) -> NDArray[np.float32]:
    return values[:, degree**2 : (degree + 1) ** 2]


@pytest.mark.parametrize("degree", [1, 2, 3])
def test_bound_of_a_band(degree: int) -> None:
    band = band_of(coefficients(), degree)
    basis = sh_basis(directions(5000), 3)[:, degree**2 : (degree + 1) ** 2]
    bounds = change_bounds(band, degree)
    most = np.abs(np.einsum("dk,nkc->dnc", basis, band)).max(axis=0)
    assert np.all(most <= bounds)
    assert np.all(most > 0.5 * bounds), "of the right size: a random function comes near its norm somewhere"
    parallel = np.repeat(basis[:50, :, None], 3, axis=2)  # where Cauchy-Schwarz is an equality
    value = np.einsum("nk,nkc->nc", basis[:50], parallel)
    np.testing.assert_allclose(change_bounds(parallel, degree), value, rtol=1e-7)  # the constants have 16 digits


@pytest.mark.parametrize("tolerance", [0.05, 0.5, 3.0])
def test_bands_left_out_change_less_than_the_tolerance(tolerance: float) -> None:
    sh = coefficients(400) * np.random.default_rng(3).uniform(0, 1, (400, 16, 1)).astype(np.float32) ** 4
    needed = needed_degrees(sh, tolerance)
    assert 0 < needed.mean() < 3
    basis = sh_basis(directions(2000), 3)
    for degree in range(3):
        rows = needed <= degree
        rest = sh[rows, (degree + 1) ** 2 :]
        assert np.abs(np.einsum("dk,nkc->dnc", basis[:, (degree + 1) ** 2 :], rest)).max(initial=0) <= tolerance
    for degree in range(1, 4):  # and none is kept that need not be
        rows = needed == degree
        bounds = sum(change_bounds(band_of(sh[rows], above), above) for above in range(degree, 4))
        assert np.all(np.max(bounds, axis=1) > tolerance)


def test_without_a_tolerance_only_zeros_are_left_out() -> None:
    sh = coefficients(6)
    sh[0, 1:] = 0
    sh[1, 4:] = -0.0
    sh[2, 9:] = 0
    sh[3, 9:] = 0
    sh[3, 12, 1] = 1e-38  # its square is no float32
    sh[4, 4:9] = 0
    np.testing.assert_array_equal(needed_degrees(sh, 0.0), [0, 1, 2, 3, 3, 3])
    np.testing.assert_array_equal(needed_degrees(sh, 1e-30), [0, 1, 2, 2, 3, 3])
    np.testing.assert_array_equal(needed_degrees(sh[:, :4], 0.0), [0, 1, 1, 1, 1, 1])
    np.testing.assert_array_equal(needed_degrees(sh[:, :1], 0.5), np.zeros(6))
    assert needed_degrees(sh[:0], 0.0).shape == (0,)


def test_what_is_not_a_number_is_not_left_out() -> None:
    sh = np.zeros((2, 16, 3), np.float32)
    sh[1, 9] = np.nan
    for tolerance in (0.0, 1.0):
        np.testing.assert_array_equal(needed_degrees(sh, tolerance), [0, 3])


def test_degrees_of_their_own_where_half_falls_away() -> None:
    degrees = np.array([0] * 49 + [3] * 51, np.uint8)
    assert coefficients_in_use(degrees) == (16, False)
    assert coefficients_in_use(degrees[:90]) == (16, True)
    assert coefficients_in_use(np.full(5, 2, np.uint8)) == (9, False)
    assert coefficients_in_use(np.zeros(5, np.uint8)) == (1, False)
    assert coefficients_in_use(np.zeros(0, np.uint8)) == (1, False)


def test_a_coefficient_that_no_half_holds() -> None:
    sh = np.zeros((3, 4, 3), np.float32)
    sh[:, 0] = 1e6  # the constant stays a float
    check_half(sh)
    check_half(sh[:, :1])
    sh[2, 3, 1] = -65504
    check_half(sh)
    for value in (-65536, 7e4, np.nan):
        sh[2, 3, 1] = value
        refuses(r"--rasterizer.sh-storage half: the model has .*, expected at most 65504", check_half, sh)
