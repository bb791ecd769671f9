# SPDX-License-Identifier: Apache-2.0
"""The spherical harmonics of a model that matter, and the part of them to store. Policy only: no OpenCL."""

from __future__ import annotations

import numpy as np
from numpy.typing import NDArray

from clsplat.errors import InputError

WORTHWHILE = 0.5
"""Share of the coefficients above band 0 that has to fall away before each Gaussian has a degree of its own: where a
frame takes no longer with them than without (docs/performance.md)."""

_HALF_MAX = float(np.finfo(np.float16).max)


def change_bounds(band: NDArray[np.float32], degree: int) -> NDArray[np.float64]:
    """The most that leaving a band out changes each channel, over all directions: band (n, 2 degree + 1, 3) -> (n, 3).

    Cauchy-Schwarz between coefficients c and basis Y at a direction, and Unsöld's theorem, by which the sum of the
    squares of a band's Y is (2 degree + 1) / 4 pi at every one: |sum of c Y| <= sqrt((2 degree + 1) / 4 pi) |c|.
    """
    squares = np.square(band, dtype=np.float64).sum(axis=1)
    bounds: NDArray[np.float64] = np.sqrt((2 * degree + 1) / (4 * np.pi) * squares)
    return bounds


def needed_degrees(sh: NDArray[np.float32], tolerance: float) -> NDArray[np.uint8]:
    """The lowest degree of each Gaussian (n) such that leaving out the bands above it changes no channel, before the
    floor at 0, by more than `tolerance`, by `change_bounds`; at 0 all those bands are zero. sh (n, K, 3)."""
    degrees = np.zeros(len(sh), np.uint8)
    undecided = np.arange(len(sh))
    left_out = np.zeros((len(sh), 3))
    for degree in range(round(sh.shape[1] ** 0.5) - 1, 0, -1):
        band = sh[:, degree**2 : (degree + 1) ** 2]
        band = band if len(undecided) == len(sh) else band[undecided]
        if tolerance > 0:
            left_out = left_out + change_bounds(band, degree)
            falls_away = left_out.max(axis=1) <= tolerance
        else:  # not by the norm: squares of small numbers are zero
            falls_away = ~band.any(axis=(1, 2))
        degrees[undecided[~falls_away]] = degree
        undecided, left_out = undecided[falls_away], left_out[falls_away]
    return degrees


def coefficients_in_use(degrees: NDArray[np.uint8]) -> tuple[int, bool]:
    """Coefficients of each channel, by the Gaussian that has the most; and True if enough of the others' are left out
    that it is worth while to look at each one's degree."""
    coefficients = (int(degrees.max(initial=0)) + 1) ** 2
    if coefficients == 1:
        return 1, False
    by_degree = np.bincount(degrees, minlength=4)
    used = sum(int(count) * ((degree + 1) ** 2 - 1) for degree, count in enumerate(by_degree))
    return coefficients, used < (1 - WORTHWHILE) * len(degrees) * (coefficients - 1)


def check_half(sh: NDArray[np.float32]) -> None:
    """Raise InputError where a coefficient above band 0 is more than float16 holds. sh (n, K, 3)."""
    rest = sh[:, 1:]
    largest = max(float(rest.max(initial=0)), -float(rest.min(initial=0)))
    if not largest <= _HALF_MAX:
        raise InputError(
            f"--rasterizer.sh-storage half: the model has an SH coefficient of {largest:g}, expected at most "
            f"{_HALF_MAX:g}; use float"
        )
