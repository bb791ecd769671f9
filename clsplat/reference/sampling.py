# SPDX-License-Identifier: Apache-2.0
"""Lower limits of the scales, from the sampling rate of photographs: float64 twin of kernels/sampling.cl. Equation
numbers refer to docs/gradients.md."""

from __future__ import annotations

from collections.abc import Sequence

import numpy as np

from clsplat.arrays import Float64
from clsplat.camera import Camera

SAMPLING_WIDTH_FACTOR = np.sqrt(0.2)


def sampling_limits(means: Float64, cameras: Sequence[Camera]) -> Float64:
    """Eq. (88): natural logs (N,) of the smallest standard deviations that the cameras resolve at the means (N, 3).

    The result is -inf where no camera sees a mean.
    """
    widths = np.min([pixel_widths(means, camera) for camera in cameras], axis=0)
    with np.errstate(divide="ignore"):
        return np.where(
            np.isfinite(widths), np.log(SAMPLING_WIDTH_FACTOR * np.where(np.isfinite(widths), widths, 1.0)), -np.inf
        )


def pixel_widths(means: Float64, camera: Camera) -> Float64:
    """The width of a pixel at each mean (N, 3), in world units; infinite for means that the camera does not see."""
    return camera.model.pixel_widths(camera, means @ camera.rotation.T + camera.translation)
