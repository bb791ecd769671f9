# SPDX-License-Identifier: Apache-2.0
"""Rotations as matrices and as quaternions in the order w x y z (wxyz)."""

from __future__ import annotations

import numpy as np

from clsplat.arrays import Float64


def rotation_from_quaternion(quaternion: Float64) -> Float64:
    """Rotation matrix (3, 3) of a unit quaternion (4,), w x y z."""
    w, x, y, z = quaternion
    return np.array(
        [
            [1 - 2 * (y * y + z * z), 2 * (x * y - w * z), 2 * (x * z + w * y)],
            [2 * (x * y + w * z), 1 - 2 * (x * x + z * z), 2 * (y * z - w * x)],
            [2 * (x * z - w * y), 2 * (y * z + w * x), 1 - 2 * (x * x + y * y)],
        ]
    )


def quaternion_of(rotation: Float64) -> Float64:
    """Unit quaternion w x y z, with w at least 0, of a rotation (3, 3)."""
    from scipy.spatial.transform import Rotation

    x, y, z, w = Rotation.from_matrix(rotation).as_quat()
    quaternion = np.array([w, x, y, z])
    return quaternion if w >= 0 else -quaternion
