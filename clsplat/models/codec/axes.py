# SPDX-License-Identifier: Apache-2.0
"""Axes of the formats, to ours and back, and transforms of nodes."""

from __future__ import annotations

import numpy as np

from clsplat.arrays import Float32, Float64
from clsplat.errors import InputError
from clsplat.gaussians import Gaussians
from clsplat.models.edit import transform
from clsplat.spherical_harmonics import sh_basis

Signs = tuple[int, int, int]

UP_BACK: Signs = (1, -1, -1)
"""Between our x right, y down, z forward and x right, y up, z backward (RUB), either way: half a turn about x."""
LEFT_UP: Signs = (-1, -1, 1)
"""Between ours and x left, y up, z forward (LUF), either way: half a turn about z."""

SLACK = 1e-4
"""Most that a node's axes may be off right angles or equal lengths: matrices are written with few digits."""


def sh_signs(signs: Signs) -> Float32:
    """(16,): what the coefficients are multiplied by when axes change their sign."""
    direction = np.array([[1.0, 2.0, 4.0]]) / 21**0.5  # where none of them is 0
    return np.asarray(np.sign(sh_basis(direction, 3) * sh_basis(direction * signs, 3))[0], np.float32)


def quaternion_signs(signs: Signs) -> Float32:
    """(4,), for w x y z, when axes change their sign: of the world and of the Gaussian alike, which is the same
    ellipsoid as turning it, and exact. Right for a mirrored axis too."""
    handedness = int(np.prod(signs))
    return np.array([1, *(handedness * sign for sign in signs)], np.float32)


def flip(gaussians: Gaussians, signs: Signs) -> None:
    """Change the signs of axes, in place and exactly."""
    gaussians.means *= np.array(signs, np.float32)
    gaussians.quaternions *= quaternion_signs(signs)
    gaussians.sh *= sh_signs(signs)[: gaussians.sh.shape[1], None]
    gaussians.origin = gaussians.origin * np.array(signs, np.float64)


def place(gaussians: Gaussians, matrix: Float64, where: str) -> Gaussians:
    """Moved by the matrix (4, 4) of a node (`edit.transform`). Raises InputError, which begins with `where`, for a
    matrix that Gaussians and their colours cannot follow."""
    if np.array_equal(matrix, np.eye(4)):
        return gaussians
    try:
        return transform(gaussians, matrix, slack=SLACK)
    except InputError as error:
        raise InputError(f"{where}: has {error}") from None
