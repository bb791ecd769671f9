# SPDX-License-Identifier: Apache-2.0
"""Sizes that pictures can show, in float64: twin of kernels/sampling.cl. Equation numbers are those of
docs/gradients.md."""

from __future__ import annotations

from collections.abc import Sequence

import numpy as np

from clsplat.arrays import Float64
from clsplat.camera import Camera
from clsplat.reference.project import frustum_limits

SAMPLING = np.sqrt(0.2)


def sampling_limits(means: Float64, cameras: Sequence[Camera]) -> Float64:
    """(88): natural logs of the least standard deviations of Gaussians at means (N, 3), -inf where no camera sees
    one."""
    nearest = np.full(len(means), np.inf)
    for camera in cameras:
        p = means @ camera.rotation.T + camera.translation
        with np.errstate(all="ignore"):
            ratios, (low, high) = p[:, :2] / p[:, 2:], frustum_limits(camera)
        seen = (p[:, 2] > camera.near) & ((ratios > low) & (ratios < high)).all(axis=1)
        nearest = np.where(seen, np.minimum(nearest, p[:, 2] / max(camera.fx, camera.fy)), nearest)
    return np.where(np.isfinite(nearest), np.log(SAMPLING * np.where(np.isfinite(nearest), nearest, 1.0)), -np.inf)
