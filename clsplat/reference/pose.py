# SPDX-License-Identifier: Apache-2.0
"""Gradient with respect to a camera's pose: float64 twin of kernels/pose.cl.

Equations (140) to (142) of docs/gradients.md.
"""

from __future__ import annotations

from collections.abc import Mapping

import numpy as np

from clsplat.arrays import Float64
from clsplat.camera import Camera
from clsplat.reference.project import view_directions
from clsplat.reference.sh import sh_basis_grad
from clsplat.spherical_harmonics import SH_C0


def pose_gradient(
    means: Float64, quaternions: Float64, sh: Float64, camera: Camera, sh_degree: int, gradients: Mapping[str, Float64]
) -> Float64:
    """Return the gradient (6,) with respect to a motion of the camera by `Camera.moved`: rotation, then translation.

    gradients: gradients with respect to means (N, 3), quaternions (N, 4) and sh (N, K, 3), by name; zero for Gaussians
    that are not visible.
    """
    directions, _ = view_directions(means, camera)
    of_direction = sh_basis_grad(directions, sh_degree)
    d_value = gradients["sh"][:, 0] / SH_C0
    d_directions = np.einsum("nkd,nkc,nc->nd", of_direction, sh[:, : of_direction.shape[1]], d_value)
    w, v = quaternions[:, :1], quaternions[:, 1:]
    d_w, d_v = gradients["quaternions"][:, :1], gradients["quaternions"][:, 1:]
    turn = np.cross(means - camera.position, gradients["means"]) - np.cross(directions, d_directions)
    turn += 0.5 * (w * d_v - v * d_w + np.cross(v, d_v))
    return np.concatenate([turn.sum(axis=0), gradients["means"].sum(axis=0)])
