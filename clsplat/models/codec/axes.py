# SPDX-License-Identifier: Apache-2.0
"""Conversion between clsplat's axes and the axes of model formats, and transformation of models by scene nodes."""

from __future__ import annotations

import numpy as np

from clsplat.arrays import Float32, Float64
from clsplat.errors import InputError
from clsplat.gaussians import Gaussians
from clsplat.models.edit import transform
from clsplat.spherical_harmonics import sh_basis

Signs = tuple[int, int, int]

RUB_SIGNS: Signs = (1, -1, -1)
"""Factors of x, y and z that convert between clsplat's axes (x right, y down, z forward) and RUB (x right, y up, z
back). RUB are the y-up axes of glTF; the conversion is half a turn about x."""
LUF_SIGNS: Signs = (-1, -1, 1)
"""Factors of x, y and z that convert between clsplat's axes and LUF (x left, y up, z forward): half a turn about z."""

NODE_SIMILARITY_TOLERANCE = 1e-4
"""Largest difference of Q^T Q from the identity, where Q is a node's rotation. Files store matrices with few digits."""


def sh_signs(signs: Signs) -> Float32:
    """Factors (16,), 1 or -1, by which SH coefficients change if the axes x, y and z are multiplied by `signs`."""
    direction = np.array([[1.0, 2.0, 4.0]]) / 21**0.5  # no SH basis function is 0 in this direction
    return np.asarray(np.sign(sh_basis(direction, 3) * sh_basis(direction * signs, 3))[0], np.float32)


def quaternion_signs(signs: Signs) -> Float32:
    """Factors (4,), 1 or -1, by which quaternions w x y z change if the axes are multiplied by `signs`.

    The Gaussian's own axes change sign too, so the result is a rotation even if `signs` mirrors the world.
    Covariances change without rounding.
    """
    handedness = int(np.prod(signs))
    return np.array([1, *(handedness * sign for sign in signs)], np.float32)


def flip(gaussians: Gaussians, signs: Signs) -> None:
    """Multiply a model's axes x, y and z by `signs`, each 1 or -1, in place and without rounding."""
    gaussians.means *= np.array(signs, np.float32)
    gaussians.quaternions *= quaternion_signs(signs)
    gaussians.sh *= sh_signs(signs)[: gaussians.sh.shape[1], None]
    gaussians.origin = gaussians.origin * np.array(signs, np.float64)


def place(gaussians: Gaussians, matrix: Float64, where: str) -> Gaussians:
    """Transform a model by `matrix` (4, 4), the transform of a scene node.

    Raises InputError, prefixed with `where`, if the matrix is not a similarity.
    """
    if np.array_equal(matrix, np.eye(4)):
        return gaussians
    try:
        return transform(gaussians, matrix, slack=NODE_SIMILARITY_TOLERANCE)
    except InputError as error:
        raise InputError(f"{where}: has {error}") from None
