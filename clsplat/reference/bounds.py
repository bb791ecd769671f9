# SPDX-License-Identifier: Apache-2.0
"""Bounds of the means and scales in each chunk of a model: NumPy twin of kernels/bounds.cl."""

from __future__ import annotations

import numpy as np

from clsplat.arrays import Float32, Float64
from clsplat.layouts.columns import CHUNK_ROWS


def bounds(means: Float32, log_scales: Float32) -> Float64:
    """Return the bounds (chunks, 7) of each chunk's Gaussians: least and greatest x y z, greatest log scale.

    NaNs are ignored. A chunk in which a column has only NaNs gets inf as least value, -inf as greatest.
    """
    starts = np.arange(0, len(means), CHUNK_ROWS)
    least = np.fmin.reduceat(means, starts)
    found = np.hstack([least, np.fmax.reduceat(means, starts), np.fmax.reduceat(log_scales, starts).max(1)[:, None]])
    empty = np.array([*3 * [np.inf], *4 * [-np.inf]])
    return np.where(np.isnan(found), empty, found)
