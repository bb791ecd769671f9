# SPDX-License-Identifier: Apache-2.0
"""Similarity of a render to its photograph: PSNR, SSIM, and LPIPS if the optional extra is installed.

Images are (H, W, 3), clamped to [0, 1] and compared in float64. A mask `counts` (H, W) is True for compared pixels.
"""

from __future__ import annotations

import contextlib
import functools
import sys
from collections.abc import Callable
from importlib import import_module
from importlib.util import find_spec
from typing import Any

import numpy as np
from numpy.typing import NDArray

from clsplat.errors import ClsplatError, InputError
from clsplat.evaluation import lpips_weights

MIN_SQUARED_ERROR = 1e-12
"""Minimum of the mean squared error. Equal images get 120 dB: JSON cannot store their infinite PSNR."""
SSIM_WINDOW_PX = 11
"""Side of SSIM's Gaussian window in pixels."""

Image = NDArray[Any]


def psnr(image: Image, truth: Image, counts: NDArray[np.bool_] | None = None) -> float:
    """Peak signal-to-noise ratio in dB, at most 120. Raises ValueError for images of different shapes.

    counts: (H, W), True for pixels to compare; None for all.
    """
    a, b = _pair(image, truth)
    squares = np.square(a - b) if counts is None else np.square(a - b)[counts]
    return float(-10 * np.log10(max(float(np.mean(squares)), MIN_SQUARED_ERROR)))


def psnr_corrected(image: Image, truth: Image, counts: NDArray[np.bool_] | None = None) -> float:
    """PSNR in dB of the image after the affine fit of colours by `corrected`, with a peak of 1.

    Both images are clamped to [0, most], where `most` is the photograph's largest value, but at least 1.

    counts: (H, W), True for pixels to compare; None for all.
    """
    most = max(1.0, float(truth.max() if counts is None else truth[counts].max(initial=1.0)))
    fitted = corrected(image, truth, counts)
    squares = np.square(np.clip(fitted, 0, most) - np.clip(truth.astype(np.float64), 0, most))
    squares = squares if counts is None else squares[counts]
    return float(-10 * np.log10(max(float(np.mean(squares)), MIN_SQUARED_ERROR)))


def corrected(image: Image, truth: Image, counts: NDArray[np.bool_] | None = None) -> Image:
    """Return the image (H, W, 3) after the affine transform of colours that fits `truth` best, by least squares.

    counts: (H, W), True for pixels that the fit uses; None for all.
    """
    colours, wanted = (np.asarray(each, np.float64).reshape(-1, 3) for each in (image, truth))
    known = np.hstack([colours, np.ones((len(colours), 1))])
    rows = slice(None) if counts is None else counts.ravel()
    fit: NDArray[Any] = np.linalg.lstsq(known[rows], wanted[rows], rcond=None)[0]
    fitted: Image = (known @ fit).reshape(image.shape)
    return fitted


def ssim(image: Image, truth: Image, counts: NDArray[np.bool_] | None = None) -> float:
    """Mean structural similarity over pixels and channels, by the 11x11 Gaussian window of Wang et al. 2004, sigma 1.5.

    counts: mask (H, W), None for all pixels. Pixels outside the mask are black in both images. The mean is over the
        windows centred on pixels in the mask.

    Raises InputError for images smaller than the window, ValueError for images of different shapes.
    """
    structural_similarity: Any = import_module("skimage.metrics").structural_similarity  # slow to import
    a, b = _pair(image, truth)
    height, width = a.shape[:2]
    if min(height, width) < SSIM_WINDOW_PX:
        raise InputError(f"an image of {width}x{height} pixels is too small for SSIM, expected at least 11x11")
    similarity = functools.partial(
        structural_similarity,
        channel_axis=2,
        gaussian_weights=True,
        sigma=1.5,
        use_sample_covariance=False,
        data_range=1.0,
    )
    if counts is None:
        return float(similarity(a, b))
    a, b = (np.where(counts[:, :, None], picture, 0.0) for picture in (a, b))
    _, values = similarity(a, b, full=True)
    return float(values[counts].mean())


def lpips(image: Image, truth: Image) -> float | None:
    """LPIPS (VGG, as in the 3DGS paper), or None if it is not available; `lpips_missing` returns the reason."""
    model = _lpips_model()
    return None if isinstance(model, str) else model(*_pair(image, truth))


def lpips_missing() -> str | None:
    """Reason why LPIPS is not available; None if it is available."""
    model = _lpips_model()
    return model if isinstance(model, str) else None


@functools.cache
def prepare_lpips() -> str | None:
    """Download the weights of LPIPS's network if they are missing. Does not load the network.

    Returns None, or the reason why LPIPS cannot be used, with advice.
    """
    for name in ("lpips", "torch"):
        if find_spec(name) is None:
            return f"the optional extra is not installed (no {name}): pip install 'clsplat[lpips]'"
    try:
        lpips_weights.fetch()
    except ClsplatError as error:
        return str(error)
    return None


@functools.cache
def _lpips_model() -> Callable[[Image, Image], float] | str:
    """Return LPIPS as a function of two images, or the reason why it is not available."""
    if reason := prepare_lpips():
        return reason
    try:
        with contextlib.redirect_stdout(sys.stderr):  # keep standard output for results
            package: Any = import_module("lpips")
            torch: Any = import_module("torch")
            network = package.LPIPS(net="vgg", verbose=False).eval()
    except Exception as error:  # noqa: BLE001  # an evaluation continues without LPIPS
        return f"LPIPS's network could not be loaded ({' '.join(str(error).split())[:100]})"

    def measure(a: Image, b: Image) -> float:
        tensors = [torch.from_numpy(x.astype(np.float32)).permute(2, 0, 1)[None] * 2 - 1 for x in (a, b)]
        with torch.no_grad():
            return float(network(*tensors))

    return measure


def _pair(image: Image, truth: Image) -> tuple[NDArray[np.float64], NDArray[np.float64]]:
    """Convert both images to float64 and clamp them to [0, 1]. Raises ValueError unless both are (H, W, 3)."""
    if image.shape != truth.shape or image.ndim != 3 or image.shape[2] != 3:
        raise ValueError(f"image has the shape {image.shape} and truth {truth.shape}, expected (H, W, 3) for both")
    return np.clip(image.astype(np.float64), 0, 1), np.clip(truth.astype(np.float64), 0, 1)
