# SPDX-License-Identifier: Apache-2.0
"""The depth loss, and the gradient of nearness with respect to the means.

Float64 twins of kernels/depth_loss.cl and of the nearness terms in project_grad.cl.
"""

from __future__ import annotations

import numpy as np

from clsplat.arrays import Float64
from clsplat.camera import Camera


def depth_loss(nearness: Float64, aims: Float64, weights: Float64, factor: float) -> tuple[float, Float64]:
    """Return the depth loss and its gradient with respect to nearness: eq. (121) of docs/gradients.md.

    The loss is `factor` times the sum over pixels of weights * |nearness - aims|. All arrays are (H, W).
    """
    difference = weights * (nearness - aims)
    return float(factor * np.abs(difference).sum()), factor * weights * np.sign(difference)


def nearness_grad(means: Float64, camera: Camera, d_nearness: Float64) -> Float64:
    """Return the gradient (N, 3) of a loss with respect to the means, through nearness.

    Equation (122) of docs/gradients.md.

    d_nearness: (N,), gradient with respect to each Gaussian's 1 / depth; for camera models along rays, 1 / distance.
    """
    local = means @ camera.rotation.T + camera.translation
    if not camera.model.along_rays:
        along, depth = np.zeros_like(local), local[:, 2]
        along[:, 2] = 1
    else:
        depth = np.linalg.norm(local, axis=1)
        along = local / depth[:, None]
    with np.errstate(divide="ignore"):
        slope = np.where(d_nearness != 0, -d_nearness / np.square(depth), 0.0)
    return np.asarray((slope[:, None] * along) @ camera.rotation)
