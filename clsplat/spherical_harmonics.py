# SPDX-License-Identifier: Apache-2.0
"""Real spherical harmonics up to degree 4. Constants and signs follow 3DGS files up to degree 3, and gsplat above."""

from __future__ import annotations

import numpy as np

from clsplat.arrays import Float64

SH_C0 = 0.28209479177387814
SH_C1 = 0.4886025119029199
SH_C2 = (1.0925484305920792, -1.0925484305920792, 0.31539156525252005, -1.0925484305920792, 0.5462742152960396)
SH_C3 = (
    -0.5900435899266435,
    2.890611442640554,
    -0.4570457994644658,
    0.3731763325901154,
    -0.4570457994644658,
    1.445305721320277,
    -0.5900435899266435,
)
SH_C4 = (
    2.5033429417967046,
    -1.7701307697799304,
    0.9461746957575601,
    -0.6690465435572892,
    0.10578554691520431,
    -0.6690465435572892,
    0.47308734787878004,
    -1.7701307697799304,
    0.6258357354491761,
)


def sh_basis(directions: Float64, degree: int) -> Float64:
    """Values (N, (degree + 1)^2) of the spherical harmonics Y_k: eq. (12) of docs/gradients.md.

    directions: (N, 3), unit vectors from the camera to the mean.
    """
    x, y, z = directions.T
    columns = [np.full_like(x, SH_C0)]
    if degree >= 1:
        columns += [-SH_C1 * y, SH_C1 * z, -SH_C1 * x]
    if degree >= 2:
        columns += [
            SH_C2[0] * x * y,
            SH_C2[1] * y * z,
            SH_C2[2] * (2 * z * z - x * x - y * y),
            SH_C2[3] * x * z,
            SH_C2[4] * (x * x - y * y),
        ]
    if degree >= 3:
        columns += [
            SH_C3[0] * y * (3 * x * x - y * y),
            SH_C3[1] * x * y * z,
            SH_C3[2] * y * (4 * z * z - x * x - y * y),
            SH_C3[3] * z * (2 * z * z - 3 * x * x - 3 * y * y),
            SH_C3[4] * x * (4 * z * z - x * x - y * y),
            SH_C3[5] * z * (x * x - y * y),
            SH_C3[6] * x * (x * x - 3 * y * y),
        ]
    if degree >= 4:
        xx, yy, zz = x * x, y * y, z * z
        columns += [
            SH_C4[0] * x * y * (xx - yy),
            SH_C4[1] * y * z * (3 * xx - yy),
            SH_C4[2] * x * y * (6 * zz - xx - yy),
            SH_C4[3] * y * z * (4 * zz - 3 * xx - 3 * yy),
            SH_C4[4] * (8 * zz * zz - 24 * zz * (xx + yy) + 3 * (xx + yy) ** 2),
            SH_C4[5] * x * z * (4 * zz - 3 * xx - 3 * yy),
            SH_C4[6] * (xx - yy) * (6 * zz - xx - yy),
            SH_C4[7] * x * z * (xx - 3 * yy),
            SH_C4[8] * (xx * (xx - 3 * yy) - yy * (3 * xx - yy)),
        ]
    return np.stack(columns, axis=1)
