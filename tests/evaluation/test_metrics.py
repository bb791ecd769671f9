# SPDX-License-Identifier: Apache-2.0
"""PSNR and SSIM against closed forms and against SSIM written out."""

import numpy as np
import pytest
from calls import refuses
from scipy.ndimage import correlate1d

from clsplat.evaluation import metrics


def images(height: int = 20, width: int = 31) -> tuple[np.ndarray, np.ndarray]:
    rng = np.random.default_rng(0)
    truth = rng.random((height, width, 3))
    return np.clip(truth + 0.1 * rng.standard_normal(truth.shape), 0, 1), truth


def test_psnr_of_a_known_error() -> None:
    truth = np.full((4, 5, 3), 0.5, np.float32)
    assert metrics.psnr(truth + np.float32(0.125), truth) == pytest.approx(-20 * np.log10(0.125), abs=1e-9)


def test_psnr_of_equal_images_is_finite() -> None:
    image, _ = images()
    assert metrics.psnr(image, image) == 120


def test_values_outside_are_clamped() -> None:
    truth = np.ones((12, 12, 3))
    assert metrics.psnr(truth + 3, truth) == 120
    assert metrics.ssim(truth + 3, truth) == pytest.approx(1)


def test_ssim_against_its_definition() -> None:
    """An 11-tap Gaussian of sigma 1.5, population moments, borders of half a window left out."""
    image, truth = images()
    taps = np.exp(-0.5 * np.square(np.arange(-5, 6) / 1.5))
    taps /= taps.sum()

    def blur(x: np.ndarray) -> np.ndarray:
        return correlate1d(correlate1d(x, taps, axis=0), taps, axis=1)[5:-5, 5:-5]

    ma, mb = blur(image), blur(truth)
    va, vb, vab = blur(image * image) - ma * ma, blur(truth * truth) - mb * mb, blur(image * truth) - ma * mb
    c1, c2 = 0.01**2, 0.03**2
    ratio = (2 * ma * mb + c1) * (2 * vab + c2) / ((ma**2 + mb**2 + c1) * (va + vb + c2))
    assert metrics.ssim(image, truth) == pytest.approx(ratio.mean(), abs=1e-12)
    assert metrics.ssim(truth, truth) == pytest.approx(1)


def test_single_precision_is_widened() -> None:
    image, truth = images()
    narrow, wide = image.astype(np.float32), image.astype(np.float32).astype(np.float64)
    assert metrics.ssim(narrow, truth) == metrics.ssim(wide, truth)
    assert metrics.psnr(narrow, truth) == metrics.psnr(wide, truth)


def test_too_small_or_different() -> None:
    refuses("10x20 pixels is too small", metrics.ssim, np.zeros((20, 10, 3)), np.zeros((20, 10, 3)))
    refuses("expected", metrics.psnr, np.zeros((20, 10, 3)), np.zeros((10, 20, 3)), error=ValueError)


def test_lpips_or_the_reason_why_not() -> None:
    image, truth = images(64, 64)
    value, reason = metrics.lpips(image, truth), metrics.lpips_missing()
    assert (value is None) == (reason is not None)
    if value is None:
        assert reason is not None
        assert "\n" not in reason
    else:
        assert 0 <= value < 2
