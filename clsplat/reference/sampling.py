# SPDX-License-Identifier: Apache-2.0
"""Sizes that pictures can show, in float64: twin of kernels/sampling.cl. Equation numbers are those of
docs/gradients.md."""

from __future__ import annotations

from collections.abc import Sequence

import numpy as np

from clsplat.arrays import Float64
from clsplat.camera import Camera
from clsplat.reference.cameras import radii
from clsplat.reference.project import frustum_limits
from clsplat.reference.rays import pixel_angles

SAMPLING = np.sqrt(0.2)


def sampling_limits(means: Float64, cameras: Sequence[Camera]) -> Float64:
    """(88): natural logs of the least standard deviations of Gaussians at means (N, 3), -inf where no camera sees
    one."""
    widths = np.min([pixel_widths(means, camera) for camera in cameras], axis=0)
    with np.errstate(divide="ignore"):
        return np.where(np.isfinite(widths), np.log(SAMPLING * np.where(np.isfinite(widths), widths, 1.0)), -np.inf)


def pixel_widths(means: Float64, camera: Camera) -> Float64:
    """The width of a camera's pixel at each mean (N, 3), in world units; infinite where it does not see that."""
    p = means @ camera.rotation.T + camera.translation
    depths, focal, (low, high) = np.linalg.norm(p, axis=1), max(camera.fx, camera.fy), frustum_limits(camera)
    if camera.projection == "equirectangular":
        return np.where(depths > camera.near, depths / focal, np.inf)
    if camera.projection == "fisheye":
        across = np.hypot(p[:, 0], p[:, 1])
        theta = np.arctan2(across, p[:, 2])
        along, around, _, _ = pixel_angles(camera, theta)
        places = radii(camera, theta)[0][:, None] * p[:, :2] / np.where(across > 0, across, 1.0)[:, None]
        seen = (depths > camera.near) & (theta < camera.fold[0]) & ((places > low) & (places < high)).all(axis=1)
        return np.where(seen, depths / focal * np.minimum(along, around), np.inf)
    with np.errstate(all="ignore"):
        ratios = p[:, :2] / p[:, 2:]
    seen = (p[:, 2] > camera.near) & ((ratios > low) & (ratios < high)).all(axis=1)
    return np.where(seen, p[:, 2] / focal, np.inf)
