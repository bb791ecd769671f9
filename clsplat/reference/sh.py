# SPDX-License-Identifier: Apache-2.0
"""The derivative of real spherical harmonics up to degree 4. Their values are in `clsplat.spherical_harmonics`."""

from __future__ import annotations

import numpy as np

from clsplat.arrays import Float64
from clsplat.spherical_harmonics import SH_C1, SH_C2, SH_C3, SH_C4


def sh_basis_grad(directions: Float64, degree: int) -> Float64:
    """Return dY_k / d(x, y, z) at directions (N, 3), with x, y, z as independent variables: (N, (degree + 1)^2, 3).

    The polynomials are differentiated as `sh_basis` writes them. Other polynomials with the same values on the unit
    sphere have derivatives that differ only along the direction, a component that eq. (40) of docs/gradients.md
    removes.
    """
    x, y, z = directions.T
    zero = np.zeros_like(x)
    one = np.ones_like(x)
    rows = [(zero, zero, zero)]
    if degree >= 1:
        rows += [(zero, -SH_C1 * one, zero), (zero, zero, SH_C1 * one), (-SH_C1 * one, zero, zero)]
    if degree >= 2:
        rows += [
            (SH_C2[0] * y, SH_C2[0] * x, zero),
            (zero, SH_C2[1] * z, SH_C2[1] * y),
            (-2 * SH_C2[2] * x, -2 * SH_C2[2] * y, 4 * SH_C2[2] * z),
            (SH_C2[3] * z, zero, SH_C2[3] * x),
            (2 * SH_C2[4] * x, -2 * SH_C2[4] * y, zero),
        ]
    if degree >= 3:
        rows += [
            (6 * SH_C3[0] * x * y, 3 * SH_C3[0] * (x * x - y * y), zero),
            (SH_C3[1] * y * z, SH_C3[1] * x * z, SH_C3[1] * x * y),
            (-2 * SH_C3[2] * x * y, SH_C3[2] * (4 * z * z - x * x - 3 * y * y), 8 * SH_C3[2] * y * z),
            (-6 * SH_C3[3] * x * z, -6 * SH_C3[3] * y * z, SH_C3[3] * (6 * z * z - 3 * x * x - 3 * y * y)),
            (SH_C3[4] * (4 * z * z - 3 * x * x - y * y), -2 * SH_C3[4] * x * y, 8 * SH_C3[4] * x * z),
            (2 * SH_C3[5] * x * z, -2 * SH_C3[5] * y * z, SH_C3[5] * (x * x - y * y)),
            (3 * SH_C3[6] * (x * x - y * y), -6 * SH_C3[6] * x * y, zero),
        ]
    if degree >= 4:
        xx, yy, zz = x * x, y * y, z * z
        rows += [
            (SH_C4[0] * y * (3 * xx - yy), SH_C4[0] * x * (xx - 3 * yy), zero),
            (6 * SH_C4[1] * x * y * z, 3 * SH_C4[1] * z * (xx - yy), SH_C4[1] * y * (3 * xx - yy)),
            (SH_C4[2] * y * (6 * zz - 3 * xx - yy), SH_C4[2] * x * (6 * zz - xx - 3 * yy), 12 * SH_C4[2] * x * y * z),
            (
                -6 * SH_C4[3] * x * y * z,
                SH_C4[3] * z * (4 * zz - 3 * xx - 9 * yy),
                SH_C4[3] * y * (12 * zz - 3 * xx - 3 * yy),
            ),
            (
                SH_C4[4] * x * (12 * (xx + yy) - 48 * zz),
                SH_C4[4] * y * (12 * (xx + yy) - 48 * zz),
                SH_C4[4] * z * (32 * zz - 48 * (xx + yy)),
            ),
            (
                SH_C4[5] * z * (4 * zz - 9 * xx - 3 * yy),
                -6 * SH_C4[5] * x * y * z,
                SH_C4[5] * x * (12 * zz - 3 * xx - 3 * yy),
            ),
            (4 * SH_C4[6] * x * (3 * zz - xx), -4 * SH_C4[6] * y * (3 * zz - yy), 12 * SH_C4[6] * z * (xx - yy)),
            (3 * SH_C4[7] * z * (xx - yy), -6 * SH_C4[7] * x * y * z, SH_C4[7] * x * (xx - 3 * yy)),
            (4 * SH_C4[8] * x * (xx - 3 * yy), 4 * SH_C4[8] * y * (yy - 3 * xx), zero),
        ]
    return np.stack([np.stack(row, axis=1) for row in rows], axis=1)
