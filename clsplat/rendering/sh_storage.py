# SPDX-License-Identifier: Apache-2.0
"""Storage of a model's SH coefficients for rendering: only bands that change colours visibly, as float32 or float16.

Policy only: no OpenCL.
"""

from __future__ import annotations

import numpy as np
from numpy.typing import NDArray

from clsplat.errors import InputError

MIN_DROPPED_SH_FRACTION = 0.5
"""Each Gaussian gets its own SH degree if more than this fraction of the coefficients above band 0 is then left out.

From this fraction on, a frame takes no longer with a degree for each Gaussian than without (docs/performance.md).
"""

_HALF_MAX = float(np.finfo(np.float16).max)


def change_bounds(band: NDArray[np.float32], degree: int) -> NDArray[np.float64]:
    """Upper bounds (n, 3) of how much a colour changes, in any direction, without a band (n, 2 degree + 1, 3) of SH.

    Cauchy-Schwarz bounds the sum of coefficients c times basis Y in a direction. By Unsöld's theorem the squares of a
    band's Y sum to (2 degree + 1) / 4 pi in every direction. So |sum of c Y| <= sqrt((2 degree + 1) / 4 pi) |c|.
    """
    squares = np.square(band, dtype=np.float64).sum(axis=1)
    bounds: NDArray[np.float64] = np.sqrt((2 * degree + 1) / (4 * np.pi) * squares)
    return bounds


def needed_degrees(sh: NDArray[np.float32], tolerance: float) -> NDArray[np.uint8]:
    """The lowest degree (n,) of each Gaussian above which all bands can be left out within `tolerance`.

    sh: (n, K, 3).
    tolerance: largest change of a colour channel, before the floor at 0, as bounded by `change_bounds`. A tolerance of
    0 leaves out only bands of zeros.
    """
    degrees = np.zeros(len(sh), np.uint8)
    undecided = np.arange(len(sh))
    left_out = np.zeros((len(sh), 3))
    for degree in range(round(sh.shape[1] ** 0.5) - 1, 0, -1):
        band = sh[:, degree**2 : (degree + 1) ** 2]
        band = band if len(undecided) == len(sh) else band[undecided]
        if tolerance > 0:
            left_out = left_out + change_bounds(band, degree)
            falls_away = left_out.max(axis=1) <= tolerance
        else:  # without `change_bounds`: a square of a small coefficient may underflow to 0
            falls_away = ~band.any(axis=(1, 2))
        degrees[undecided[~falls_away]] = degree
        undecided, left_out = undecided[falls_away], left_out[falls_away]
    return degrees


def coefficients_in_use(degrees: NDArray[np.uint8]) -> tuple[int, bool]:
    """Return the number of coefficients per channel up to the highest needed degree; and True if each Gaussian should
    store only the bands up to its own degree.

    The flag is True if more than MIN_DROPPED_SH_FRACTION of the coefficients above band 0 are then left out.

    degrees: (n,), the degree that each Gaussian needs.
    """
    coefficients = (int(degrees.max(initial=0)) + 1) ** 2
    if coefficients == 1:
        return 1, False
    by_degree = np.bincount(degrees, minlength=4)
    used = sum(int(count) * ((degree + 1) ** 2 - 1) for degree, count in enumerate(by_degree))
    return coefficients, used < (1 - MIN_DROPPED_SH_FRACTION) * len(degrees) * (coefficients - 1)


def check_half(sh: NDArray[np.float32]) -> None:
    """Raise InputError if a coefficient above band 0 is too large for float16. sh: (n, K, 3)."""
    rest = sh[:, 1:]
    largest = max(float(rest.max(initial=0)), -float(rest.min(initial=0)))
    if not largest <= _HALF_MAX:
        raise InputError(
            f"--rasterizer.sh-storage half: the model has an SH coefficient of {largest:g}, expected at most "
            f"{_HALF_MAX:g}; use float"
        )
