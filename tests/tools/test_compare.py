# SPDX-License-Identifier: Apache-2.0
"""The comparison helpers themselves: what must pass, and above all what must fail."""

from __future__ import annotations

import numpy as np
import pytest
from calls import refuses
from compare import assert_close, assert_close_gradient, assert_close_images, assert_same_bits, relative_error


def test_close_passes_within_and_fails_beyond() -> None:
    assert_close([1.0, 100.0], [1.0, 100.9], relative=0.01)
    assert_close(np.zeros((0, 3)), np.zeros((0, 3)))
    with pytest.raises(AssertionError, match=r"means: 1 of 2 .* worst at \(1,\): got 100, wanted 101.1"):
        assert_close([1.0, 100.0], [1.0, 101.1], relative=0.01, name="means")


@pytest.mark.parametrize("bad", [np.nan, np.inf])
def test_values_that_are_not_finite_fail(bad: float) -> None:
    image = np.zeros((2, 2))
    broken = image.copy()
    broken[1, 1] = bad
    for got, wanted in ((broken, image), (image, broken), (broken, broken)):
        refuses("finite", assert_close, got, wanted, absolute=1e9, error=AssertionError)
        refuses("finite", assert_close_images, got, wanted, 1e9, flips=1.0, error=AssertionError)
        refuses("finite", assert_close_gradient, got, wanted, 1e9, error=AssertionError)


def test_shapes_must_agree_without_broadcasting() -> None:
    with pytest.raises(AssertionError, match=r"got shape \(1,\), wanted \(3,\)"):
        assert_close([1.0], [1.0, 1.0, 1.0], absolute=9.0)
    refuses("shape", assert_close_images, np.zeros((2, 2, 1)), np.zeros((2, 2, 3)), 1.0, error=AssertionError)


def test_image_flips_are_bounded_in_number_and_size() -> None:
    wanted = np.zeros((10, 10, 3))
    got = wanted.copy()
    got[3, 4, 1] = 0.01
    assert_close_images(got, wanted, 1e-4, flips=0.01, flip_tolerance=0.02)
    refuses(r"1 of 100 pixels .* \(3, 4\)", assert_close_images, got, wanted, 1e-4, error=AssertionError)
    with pytest.raises(AssertionError, match="may not exceed"):
        assert_close_images(got, wanted, 1e-4, flips=0.01, flip_tolerance=0.005)
    got[5, 5] = 0.01
    refuses("2 of 100", assert_close_images, got, wanted, 1e-4, flips=0.01, flip_tolerance=0.02, error=AssertionError)


def test_image_mask_hides_only_what_it_names() -> None:
    wanted = np.zeros((4, 4))
    got = wanted.copy()
    got[0, 0] = 1.0
    mask = np.zeros((4, 4), np.bool_)
    mask[0, 0] = True
    assert_close_images(got, wanted, 1e-6, ignore=mask)
    with pytest.raises(AssertionError, match="1 of 16"):
        assert_close_images(got, wanted, 1e-6, ignore=~mask & (np.arange(16).reshape(4, 4) > 3))
    with pytest.raises(AssertionError, match="hides every pixel"):
        assert_close_images(got, wanted, 1e-6, ignore=np.ones((4, 4), np.bool_))
    refuses("together", assert_close_images, got, wanted, 1e-6, flips=0.1, ignore=mask, error=AssertionError)


def test_gradient_in_norm() -> None:
    wanted = np.array([3.0, 4.0])
    assert_close_gradient(wanted * (1 + 1e-6), wanted, 1.1e-6)
    refuses("relative error 2", assert_close_gradient, -wanted, wanted, 1.0, error=AssertionError)
    refuses("zero everywhere", assert_close_gradient, [0.0, 0.0], [0.0, 0.0], 1.0, error=AssertionError)
    assert relative_error([0.0], [0.0]) == 0.0
    assert relative_error([1e-9], [0.0]) == np.inf


def test_same_bits_sees_what_equality_does_not() -> None:
    nan = np.array([np.nan, 1.0], np.float32)
    assert_same_bits(nan, nan.copy())
    with pytest.raises(AssertionError, match="1 of 1 elements"):
        assert_same_bits(np.array([0.0], np.float32), np.array([-0.0], np.float32))
    refuses("float64", assert_same_bits, np.zeros(1), np.zeros(1, np.float32), error=AssertionError)
    one_up = np.nextafter(np.float32(1), np.float32(2))
    refuses(r"first at \(1,\)", assert_same_bits, np.array([np.nan, one_up], np.float32), nan, error=AssertionError)
