# SPDX-License-Identifier: Apache-2.0
"""Blending of any number of values (colours, features) per Gaussian and its gradient, evaluated at every pixel.

Float64 twin of kernels/values.cl and values_grad.cl. Equation numbers refer to docs/gradients.md.
"""

from __future__ import annotations

from collections.abc import Iterator
from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from clsplat.arrays import Float64
from clsplat.reference.blend import BLEND_ALPHA_MAX, TRANSMITTANCE_MIN
from clsplat.reference.project import ALPHA_MIN

MAX_VALUES_MARGIN = 0.05
"""Upper limit of `ValuesBlended.margin`, the relative distance of an alpha or a transmittance from a threshold."""


@dataclass(frozen=True, eq=False)
class FlatGaussians:
    """Projected Gaussians with D values each.

    means2d: (n, 2), pixels.
    conics: (n, 3), a, b, c of the inverse covariance.
    opacities: (n,).
    values: (n, D).
    depths: (n,), by which Gaussians are blended front to back.
    drawn: (n,), False for culled Gaussians.
    """

    means2d: Float64
    conics: Float64
    opacities: Float64
    values: Float64
    depths: Float64
    drawn: NDArray[np.bool_]

    @property
    def order(self) -> list[int]:
        """Indices of the drawn Gaussians, front to back, with equal depths by index."""
        return [int(i) for i in np.argsort(self.depths, kind="stable") if self.drawn[i]]


@dataclass(frozen=True, eq=False)
class ValuesBlended:
    """A picture of blended values.

    image: (H, W, D), over the background.
    transmittance: (H, W), behind all Gaussians.
    margin: (H, W), the smallest relative distance of an alpha to 1/255 or its maximum, or of a transmittance to 1e-4;
    at most MAX_VALUES_MARGIN.
    """

    image: Float64
    transmittance: Float64
    margin: Float64


@dataclass(frozen=True, eq=False)
class ValueGradients:
    """Gradients with respect to means2d (n, 2), conics (n, 3), opacities (n,), values (n, D) and background (D,).

    absolute: (n, 2), sums over pixels of the absolute gradients with respect to means2d.
    """

    means2d: Float64
    conics: Float64
    opacities: Float64
    values: Float64
    background: Float64
    absolute: Float64


@dataclass(frozen=True, eq=False)
class _Layer:
    """A Gaussian's alpha at all pixels of a picture. Arrays are (H, W).

    dx, dy: the mean minus the pixel centre.
    raw: alpha before it is limited to `alpha_max`.
    alpha: 0 where the Gaussian is not added.
    before: transmittance in front of the Gaussian.
    margin: smallest relative distance of this Gaussian's alpha and transmittance from their thresholds; inf in pixels
        that are finished.
    """

    gaussian: int
    dx: Float64
    dy: Float64
    raw: Float64
    alpha: Float64
    before: Float64
    margin: Float64


def _layers(gaussians: FlatGaussians, width: int, height: int, alpha_max: float) -> Iterator[_Layer]:
    """Yield the layers of the drawn Gaussians, front to back: eqs. (14) to (16)."""
    x, y = np.meshgrid(np.arange(width) + 0.5, np.arange(height) + 0.5)
    transmittance, alive = np.ones((height, width)), np.ones((height, width), np.bool_)
    for i in gaussians.order:
        (mx, my), (a, b, c) = gaussians.means2d[i], gaussians.conics[i]
        dx, dy = mx - x, my - y
        raw = gaussians.opacities[i] * np.exp(-0.5 * (a * dx * dx + c * dy * dy) - b * dx * dy)
        alpha = np.minimum(raw, alpha_max)
        seen, after = alive & (alpha >= ALPHA_MIN), transmittance * (1 - alpha)
        added = seen & (after > TRANSMITTANCE_MIN)
        margin = np.minimum(np.abs(raw / ALPHA_MIN - 1), np.abs(raw / alpha_max - 1))
        margin = np.minimum(margin, np.where(seen, np.abs(after / TRANSMITTANCE_MIN - 1), np.inf))
        margin = np.where(alive, margin, np.inf)
        alive &= added | ~seen
        alpha = np.where(added, alpha, 0.0)
        yield _Layer(i, dx, dy, raw, alpha, transmittance, margin)
        transmittance = transmittance * (1 - alpha)


def blend_values(
    gaussians: FlatGaussians, width: int, height: int, background: Float64, alpha_max: float = BLEND_ALPHA_MAX
) -> ValuesBlended:
    """Blend the Gaussians' values to a picture over the background (D,): eq. (177).

    alpha_max: largest alpha of a Gaussian at a pixel.
    """
    image = np.zeros((height, width, gaussians.values.shape[1]))
    left, margin = np.ones((height, width)), np.full((height, width), MAX_VALUES_MARGIN)
    for layer in _layers(gaussians, width, height, alpha_max):
        image += (layer.before * layer.alpha)[:, :, None] * gaussians.values[layer.gaussian]
        left = layer.before * (1 - layer.alpha)
        margin = np.minimum(margin, layer.margin)
    return ValuesBlended(image + left[:, :, None] * background, left, margin)


def blend_values_grad(
    gaussians: FlatGaussians,
    width: int,
    height: int,
    background: Float64,
    d_image: Float64,
    d_alpha: Float64,
    alpha_max: float = BLEND_ALPHA_MAX,
) -> ValueGradients:
    """Return the gradients of blending, computed back to front: eqs. (178) to (180).

    d_image: (H, W, D), gradient of the loss with respect to the image.
    d_alpha: (H, W), gradient with respect to the image's alpha, 1 - transmittance.
    alpha_max: as for `blend_values`.
    """
    layers = list(_layers(gaussians, width, height, alpha_max))
    n, depth = gaussians.values.shape
    means2d, absolute, conics = np.zeros((n, 2)), np.zeros((n, 2)), np.zeros((n, 3))
    opacities, values = np.zeros(n), np.zeros((n, depth))
    left = layers[-1].before * (1 - layers[-1].alpha) if layers else np.ones((height, width))
    behind = left * (d_image @ background - d_alpha)
    for layer in reversed(layers):
        i, dx, dy, alpha, before = layer.gaussian, layer.dx, layer.dy, layer.alpha, layer.before
        shade, weight = d_image @ gaussians.values[i], before * alpha
        d = before * shade - behind / (1 - alpha)
        g = np.where((alpha > 0) & (layer.raw < alpha_max), alpha * d, 0.0)
        behind = behind + weight * shade
        values[i] = (weight[:, :, None] * d_image).sum(axis=(0, 1))
        a, b, c = gaussians.conics[i]
        by_x, by_y = -g * (a * dx + b * dy), -g * (b * dx + c * dy)
        means2d[i], absolute[i] = (by_x.sum(), by_y.sum()), (np.abs(by_x).sum(), np.abs(by_y).sum())
        conics[i] = -0.5 * (g * dx * dx).sum(), -(g * dx * dy).sum(), -0.5 * (g * dy * dy).sum()
        opacities[i] = g.sum() / gaussians.opacities[i]
    by_background = (left[:, :, None] * d_image).sum(axis=(0, 1))
    return ValueGradients(means2d, conics, opacities, values, by_background, absolute)
