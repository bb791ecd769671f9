# SPDX-License-Identifier: Apache-2.0
"""Compositing of the slices of deep pictures (bins, H, W, 5), all of them or up to a depth, in float64."""

from __future__ import annotations

from typing import Any

import numpy as np
from numpy.typing import NDArray

from clsplat.arrays import Float64


def flattened(slices: NDArray[Any]) -> Float64:
    """Red, green, blue and alpha (H, W, 4) of all slices over each other, from front to back."""
    flat = np.zeros((*slices.shape[1:3], 4))
    for each in slices.astype(np.float64):
        flat += (1 - flat[:, :, 3:]) * each[:, :, :4]
    return flat


def in_front(slices: NDArray[Any], depth: float) -> Float64:
    """Alpha (H, W) of the slices in front of a depth. The slices may have more axes before these."""
    left = np.where(slices[..., 4] < depth, 1 - slices[..., 3].astype(np.float64), 1.0)
    return np.asarray(1 - left.prod(axis=-3))
