# SPDX-License-Identifier: Apache-2.0
"""The derivative of real spherical harmonics up to degree 4."""

from __future__ import annotations

import numpy as np

from clsplat.arrays import Float64
from clsplat.spherical_harmonics import C1, C2, C3, C4


def sh_basis_grad(directions: Float64, degree: int) -> Float64:
    """dY_k / d(x, y, z) with x, y, z taken as free: (N, 3) -> (N, (degree + 1)^2, 3).

    The polynomials of `sh_basis` are continued off the unit sphere as they are written; any other continuation
    differs along the direction only, which eq. (40) projects out.
    """
    x, y, z = directions.T
    zero = np.zeros_like(x)
    one = np.ones_like(x)
    rows = [(zero, zero, zero)]
    if degree >= 1:
        rows += [(zero, -C1 * one, zero), (zero, zero, C1 * one), (-C1 * one, zero, zero)]
    if degree >= 2:
        rows += [
            (C2[0] * y, C2[0] * x, zero),
            (zero, C2[1] * z, C2[1] * y),
            (-2 * C2[2] * x, -2 * C2[2] * y, 4 * C2[2] * z),
            (C2[3] * z, zero, C2[3] * x),
            (2 * C2[4] * x, -2 * C2[4] * y, zero),
        ]
    if degree >= 3:
        rows += [
            (6 * C3[0] * x * y, 3 * C3[0] * (x * x - y * y), zero),
            (C3[1] * y * z, C3[1] * x * z, C3[1] * x * y),
            (-2 * C3[2] * x * y, C3[2] * (4 * z * z - x * x - 3 * y * y), 8 * C3[2] * y * z),
            (-6 * C3[3] * x * z, -6 * C3[3] * y * z, C3[3] * (6 * z * z - 3 * x * x - 3 * y * y)),
            (C3[4] * (4 * z * z - 3 * x * x - y * y), -2 * C3[4] * x * y, 8 * C3[4] * x * z),
            (2 * C3[5] * x * z, -2 * C3[5] * y * z, C3[5] * (x * x - y * y)),
            (3 * C3[6] * (x * x - y * y), -6 * C3[6] * x * y, zero),
        ]
    if degree >= 4:
        xx, yy, zz = x * x, y * y, z * z
        rows += [
            (C4[0] * y * (3 * xx - yy), C4[0] * x * (xx - 3 * yy), zero),
            (6 * C4[1] * x * y * z, 3 * C4[1] * z * (xx - yy), C4[1] * y * (3 * xx - yy)),
            (C4[2] * y * (6 * zz - 3 * xx - yy), C4[2] * x * (6 * zz - xx - 3 * yy), 12 * C4[2] * x * y * z),
            (-6 * C4[3] * x * y * z, C4[3] * z * (4 * zz - 3 * xx - 9 * yy), C4[3] * y * (12 * zz - 3 * xx - 3 * yy)),
            (
                C4[4] * x * (12 * (xx + yy) - 48 * zz),
                C4[4] * y * (12 * (xx + yy) - 48 * zz),
                C4[4] * z * (32 * zz - 48 * (xx + yy)),
            ),
            (C4[5] * z * (4 * zz - 9 * xx - 3 * yy), -6 * C4[5] * x * y * z, C4[5] * x * (12 * zz - 3 * xx - 3 * yy)),
            (4 * C4[6] * x * (3 * zz - xx), -4 * C4[6] * y * (3 * zz - yy), 12 * C4[6] * z * (xx - yy)),
            (3 * C4[7] * z * (xx - yy), -6 * C4[7] * x * y * z, C4[7] * x * (xx - 3 * yy)),
            (4 * C4[8] * x * (xx - 3 * yy), 4 * C4[8] * y * (yy - 3 * xx), zero),
        ]
    return np.stack([np.stack(row, axis=1) for row in rows], axis=1)
