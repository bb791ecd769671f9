# SPDX-License-Identifier: Apache-2.0
"""The order in which Gaussians are blended: float64 twin of kernels/sort*.cl."""

from __future__ import annotations

import numpy as np
from numpy.typing import NDArray

from clsplat.arrays import Float64


def depth_order(depths: Float64, visible: NDArray[np.bool_]) -> NDArray[np.int64]:
    """Indices of the visible Gaussians front to back: by depth rounded to float32, ties by index.

    depths: (N,), z in the camera's axes. Kernels compute depths in float32. Pass the kernels' depths to get their exact
    order: rounded float64 depths may differ in the last bits, so that neighbours swap.
    """
    rows = np.flatnonzero(visible)
    keys = depths[rows].astype(np.float32)
    return rows[np.argsort(keys, kind="stable")]
