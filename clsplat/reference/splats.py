# SPDX-License-Identifier: Apache-2.0
"""Splats for blending from arrays of projected Gaussians as in gsplat, and their gradient.

Float64 twin of kernels/splats.cl and splats_grad.cl. Equation numbers refer to docs/gradients.md.
"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from clsplat.arrays import Float64
from clsplat.reference.project import ALPHA_MIN


@dataclass(frozen=True, eq=False)
class Splats:
    """Ellipses of projected Gaussians. Rows of culled Gaussians are 0.

    whitenings: (n, 3), w11, w12, w22 of W, where W^T W is the conic.
    half_extents: (n, 2), in pixels, of the bounding box of the ellipse where alpha is 1/255.
    drawn: (n,), False for culled Gaussians.
    """

    whitenings: Float64
    half_extents: Float64
    drawn: NDArray[np.bool_]


def splats(conics: Float64, opacities: Float64, radii: NDArray[np.int32]) -> Splats:
    """Compute splats from positive definite conics (n, 3), opacities (n,) and radii (n, 2): eqs. (170) to (172)."""
    a, b, c = conics.T
    det = a * c - b * b
    drawn = (radii > 0).all(axis=1) & (opacities > ALPHA_MIN)
    budget = 2 * np.log(np.where(drawn, opacities / ALPHA_MIN, 1.0))
    whitenings = np.stack([np.sqrt(a), b / np.sqrt(a), np.sqrt(det / a)], axis=1)
    half_extents = np.sqrt(np.stack([budget * c / det, budget * a / det], axis=1))
    return Splats(np.where(drawn[:, None], whitenings, 0.0), np.where(drawn[:, None], half_extents, 0.0), drawn)


@dataclass(frozen=True, eq=False)
class SplatGradients:
    """Gradients of a loss with respect to means2d (n, 2), conics (n, 3) and opacities (n,)."""

    means2d: Float64
    conics: Float64
    opacities: Float64


def splats_grad(conics: Float64, opacities: Float64, moments: Float64) -> SplatGradients:
    """Compute the gradients of a loss with respect to projected Gaussians: eqs. (173) to (175).

    moments: (n, 6), sums of g, g u, g v, g u^2, g u v, g v^2 over a Gaussian's pixels. Here g is alpha dL/dalpha, and
        (u, v) is W d, with W the whitening and d the vector from the pixel to the mean.
    """
    a, b, c = conics.T
    l11, l12, l22 = np.sqrt(a), b / np.sqrt(a), np.sqrt((a * c - b * b) / a)
    g, gu, gv, guu, guv, gvv = moments.T
    lean = l12 / l22
    by_means = np.stack([-l11 * gu, -(l12 * gu + l22 * gv)], axis=1)
    xx = (guu - 2 * lean * guv + lean**2 * gvv) / l11**2
    xy, yy = (guv - lean * gvv) / (l11 * l22), gvv / l22**2
    return SplatGradients(by_means, np.stack([-xx / 2, -xy, -yy / 2], axis=1), g / opacities)
