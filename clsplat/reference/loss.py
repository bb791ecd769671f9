# SPDX-License-Identifier: Apache-2.0
"""The training loss, L1 + D-SSIM, the alpha loss, and their gradients: float64 twin of kernels/loss*.cl.

Equation numbers refer to docs/gradients.md.
"""

from __future__ import annotations

import numpy as np

from clsplat.arrays import Float64

LOSS_WINDOW_PX = 11
"""Side of the SSIM window, in pixels."""
LOSS_WINDOW_SIGMA_PX = 1.5
"""Standard deviation of the Gaussian SSIM window, in pixels."""
SSIM_C1 = 0.01**2
"""Constant C1 of SSIM, for values from 0 to 1."""
SSIM_C2 = 0.03**2
"""Constant C2 of SSIM, for values from 0 to 1."""


def window() -> Float64:
    """Return the 11 weights of the Gaussian SSIM window, with sum 1; the 2D window is their outer product."""
    offsets = np.arange(LOSS_WINDOW_PX) - LOSS_WINDOW_PX // 2
    weights = np.exp(-(offsets**2) / (2 * LOSS_WINDOW_SIGMA_PX**2))
    normalised: Float64 = weights / weights.sum()
    return normalised


def blur(image: Float64) -> Float64:
    """Convolve an image (H, W, C) with the SSIM window, with zeros beyond its edge. The operation is self-adjoint."""
    height, width = image.shape[:2]
    reach = LOSS_WINDOW_PX // 2
    weights = window()
    padded = np.pad(image, ((reach, reach), (0, 0), (0, 0)))
    image = sum((weights[k] * padded[k : k + height] for k in range(LOSS_WINDOW_PX)), np.zeros_like(image))
    padded = np.pad(image, ((0, 0), (reach, reach), (0, 0)))
    return sum((weights[k] * padded[:, k : k + width] for k in range(LOSS_WINDOW_PX)), np.zeros_like(image))


def ssim(x: Float64, y: Float64) -> tuple[Float64, Float64]:
    """Return the SSIM map (H, W, C) of two images x and y, and the gradient of the map's sum with respect to x.

    Equations (17), (18), (20) and (21).
    """
    mean_x, mean_y = blur(x), blur(y)
    var_x = blur(x * x) - mean_x**2
    var_y = blur(y * y) - mean_y**2
    covariance = blur(x * y) - mean_x * mean_y
    luminance, structure = 2 * mean_x * mean_y + SSIM_C1, 2 * covariance + SSIM_C2
    luminance_norm, structure_norm = mean_x**2 + mean_y**2 + SSIM_C1, var_x + var_y + SSIM_C2
    values = luminance * structure / (luminance_norm * structure_norm)

    d_covariance = 2 * luminance / (luminance_norm * structure_norm)
    d_var = -values / structure_norm
    d_mean = 2 * mean_y * structure / (luminance_norm * structure_norm) - 2 * mean_x * values / luminance_norm
    # add the parts through variances and covariance, which depend on the mean too
    d_mean = d_mean - 2 * mean_x * d_var - mean_y * d_covariance
    gradient = blur(d_mean) + 2 * x * blur(d_var) + y * blur(d_covariance)
    return values, gradient


def l1_dssim(x: Float64, y: Float64, weight: float = 0.2) -> tuple[float, Float64]:
    """Return the loss of a render x against a photograph y, (H, W, C), and its gradient with respect to x: eq. (19).

    The loss is (1 - weight) mean |x - y| + weight (1 - mean SSIM), with means over pixels and channels.
    """
    difference = x - y
    values, d_sum = ssim(x, y)
    loss = (1 - weight) * np.abs(difference).mean() + weight * (1 - values.mean())
    gradient = ((1 - weight) * np.sign(difference) - weight * d_sum) / x.size
    return float(loss), gradient


def masked_l1_dssim(x: Float64, y: Float64, counts: Float64, weight: float = 0.2) -> tuple[float, Float64]:
    """Return `l1_dssim` over some pixels only: eq. (80). counts: (H, W), 1 for these pixels and 0 for the others."""
    mask = counts[:, :, None]
    samples = max(3 * counts.sum(), 1)
    difference = (x - y) * mask
    values, d_sum = ssim(x * mask, y * mask)
    loss = ((1 - weight) * np.abs(difference).sum() + weight * (1 - values).sum()) / samples
    gradient = mask * ((1 - weight) * np.sign(difference) - weight * d_sum) / samples
    return float(loss), gradient


def alpha_loss(transmittance: Float64, alpha: Float64, counts: Float64, weight: float) -> tuple[float, Float64]:
    """Return the alpha loss and its gradient with respect to transmittance: eq. (81). Arrays are (H, W).

    The loss is weight * mean |1 - transmittance - alpha|, over some pixels only.

    alpha: the photograph's alpha.
    counts: 1 for the pixels over which the mean is taken, 0 for the others.
    """
    difference = counts * (1 - transmittance - alpha)
    scale = weight / max(counts.sum(), 1)
    return float(scale * np.abs(difference).sum()), -scale * np.sign(difference)
