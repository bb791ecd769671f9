# SPDX-License-Identifier: Apache-2.0
"""Lower limits of Gaussians' scales, from the sampling rate of photographs: float64 twin of kernels/sampling.cl.

Equation numbers refer to docs/gradients.md.
"""

from __future__ import annotations

from collections.abc import Sequence

import numpy as np

from clsplat.arrays import Float64
from clsplat.camera import Camera

SAMPLING_WIDTH_FACTOR = np.sqrt(0.2)
"""Smallest standard deviation of a Gaussian, as a multiple of a pixel's width at its mean."""


def sampling_limits(means: Float64, cameras: Sequence[Camera]) -> Float64:
    """Return the log scales (N,) of the smallest Gaussians that the cameras resolve at means (N, 3): eq. (88).

    The result is -inf for a mean that no camera sees.
    """
    widths = np.min([pixel_widths(means, camera) for camera in cameras], axis=0)
    with np.errstate(divide="ignore"):
        return np.where(
            np.isfinite(widths), np.log(SAMPLING_WIDTH_FACTOR * np.where(np.isfinite(widths), widths, 1.0)), -np.inf
        )


def pixel_widths(means: Float64, camera: Camera) -> Float64:
    """Return a pixel's width (N,) at means (N, 3), in world units; infinite for means that the camera does not see."""
    return camera.model.pixel_widths(camera, means @ camera.rotation.T + camera.translation)
