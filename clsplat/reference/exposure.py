# SPDX-License-Identifier: Apache-2.0
"""Colour model `exposure`, gains of photographs, and its gradient: float64 twin of kernels/exposure.cl."""

from __future__ import annotations

import numpy as np

from clsplat.arrays import Float64


def developed(photograph: Float64, entries: Float64, lens: Float64, squared: Float64) -> Float64:  # noqa: ARG001
    """Divide the photograph (H, W, 3) by its gains 2^entries (3,). lens, squared: not used by this colour model."""
    result: Float64 = photograph / np.exp2(entries)
    return result


def terms(image: Float64, by_image: Float64, squared: Float64) -> Float64:  # noqa: ARG001
    """Return each pixel's term (H, W, 3) of the gradient of a loss with respect to the entries, where they are 0.

    The loss is a function of image * 2^entries.

    by_image: (H, W, 3), gradient of the loss with respect to this product. squared: not used by this colour model.
    """
    result: Float64 = np.log(2) * image * by_image
    return result
