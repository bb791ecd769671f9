# SPDX-License-Identifier: Apache-2.0
"""The order in which Gaussians are blended: float64 twin of kernels/sort*.cl."""

from __future__ import annotations

import numpy as np
from numpy.typing import NDArray

from clsplat.arrays import Float64


def depth_order(depths: Float64, visible: NDArray[np.bool_]) -> NDArray[np.int64]:
    """Return indices of the visible Gaussians front to back: by depth rounded to float32, equal depths by index.

    depths: (N,), as in `Seen`. Pass a kernel's float32 depths to get the kernel's exact order: float64 depths may round
    to other bits, so that neighbours swap.
    """
    rows = np.flatnonzero(visible)
    keys = depths[rows].astype(np.float32)
    return rows[np.argsort(keys, kind="stable")]
