# SPDX-License-Identifier: Apache-2.0
"""L1 + D-SSIM and its gradient: float64 twin of kernels/loss*.cl. Equation numbers refer to docs/gradients.md."""

from __future__ import annotations

import numpy as np

from clsplat.arrays import Float64

LOSS_WINDOW_PX = 11
LOSS_WINDOW_SIGMA_PX = 1.5
SSIM_C1 = 0.01**2
SSIM_C2 = 0.03**2


def window() -> Float64:
    """The 11 weights of the Gaussian window, sigma 1.5, sum 1; the 2D window is their outer product."""
    offsets = np.arange(LOSS_WINDOW_PX) - LOSS_WINDOW_PX // 2
    weights = np.exp(-(offsets**2) / (2 * LOSS_WINDOW_SIGMA_PX**2))
    normalised: Float64 = weights / weights.sum()
    return normalised


def blur(image: Float64) -> Float64:
    """The weighted mean in the window, zeros beyond the edge, (H, W, C) -> (H, W, C). It is its own adjoint."""
    height, width = image.shape[:2]
    reach = LOSS_WINDOW_PX // 2
    weights = window()
    padded = np.pad(image, ((reach, reach), (0, 0), (0, 0)))
    image = sum((weights[k] * padded[k : k + height] for k in range(LOSS_WINDOW_PX)), np.zeros_like(image))
    padded = np.pad(image, ((0, 0), (reach, reach), (0, 0)))
    return sum((weights[k] * padded[:, k : k + width] for k in range(LOSS_WINDOW_PX)), np.zeros_like(image))


def ssim(x: Float64, y: Float64) -> tuple[Float64, Float64]:
    """Eqs. (17), (18), (20), (21): the SSIM map (H, W, C), and the gradient of its SUM with respect to x."""
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
    # the variances depend on the mean too
    d_mean = d_mean - 2 * mean_x * d_var - mean_y * d_covariance
    gradient = blur(d_mean) + 2 * x * blur(d_var) + y * blur(d_covariance)
    return values, gradient


def l1_dssim(x: Float64, y: Float64, weight: float = 0.2) -> tuple[float, Float64]:
    """Eq. (19): loss of the render x against the photograph y, both (H, W, C), and its gradient with respect to x.

    L = (1 - weight) mean |x - y| + weight (1 - mean SSIM), means over pixels and channels.
    """
    difference = x - y
    values, d_sum = ssim(x, y)
    loss = (1 - weight) * np.abs(difference).mean() + weight * (1 - values.mean())
    gradient = ((1 - weight) * np.sign(difference) - weight * d_sum) / x.size
    return float(loss), gradient


def masked_l1_dssim(x: Float64, y: Float64, counts: Float64, weight: float = 0.2) -> tuple[float, Float64]:
    """Eq. (80): `l1_dssim` over the pixels where counts (H, W) is 1. In other pixels counts is 0."""
    mask = counts[:, :, None]
    samples = max(3 * counts.sum(), 1)
    difference = (x - y) * mask
    values, d_sum = ssim(x * mask, y * mask)
    loss = ((1 - weight) * np.abs(difference).sum() + weight * (1 - values).sum()) / samples
    gradient = mask * ((1 - weight) * np.sign(difference) - weight * d_sum) / samples
    return float(loss), gradient


def alpha_loss(transmittance: Float64, alpha: Float64, counts: Float64, weight: float) -> tuple[float, Float64]:
    """Eq. (81): weight times the mean |1 - T - alpha| where counts is 1, and its gradient in T; arrays are (H, W)."""
    difference = counts * (1 - transmittance - alpha)
    scale = weight / max(counts.sum(), 1)
    return float(scale * np.abs(difference).sum()), -scale * np.sign(difference)
