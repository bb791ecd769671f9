# SPDX-License-Identifier: Apache-2.0
"""Alpha blending of Gaussians front to back and its gradient, without tiles: float64 twin of kernels/blend*.cl.

Equation numbers refer to docs/gradients.md.
"""

from __future__ import annotations

from collections.abc import Iterator, Sequence
from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from clsplat.arrays import Float64, Int64
from clsplat.reference.project import ALPHA_MIN, BOX_SLACK, Footprint, Seen

BLEND_ALPHA_MAX = float(np.float32(0.99))
"""Largest alpha of a Gaussian at a pixel."""
TRANSMITTANCE_MIN = float(np.float32(1e-4))
"""Blending of a pixel ends before the Gaussian that would reduce its transmittance to this or less.

This limit and the largest alpha are rounded to float32 as in the kernels. Unrounded, two Gaussians of alpha 0.99 would
leave exactly 1e-4."""


@dataclass(frozen=True, eq=False)
class BlendedTwin:
    """A picture blended from Gaussians.

    image: (H, W, 3).
    transmittance: (H, W), the fraction of the background's light that reaches the camera.
    last: (H, W), position in `Seen.order` of the last Gaussian added to a pixel; -1 if none is added.
    count: (H, W), number of Gaussians added to a pixel.
    nearness: (H, W), the sum over Gaussians of blending weight / depth.
    margin: (H, W), the smallest relative distance of an alpha to 1/255 or 0.99, or of a transmittance to 1e-4; at most
    0.05. Where the margin is small, rounding may change the pixel.
    """

    image: Float64
    transmittance: Float64
    last: Int64
    count: Int64
    margin: Float64
    nearness: Float64


@dataclass(frozen=True, eq=False)
class BlendGradients:
    """Gradients with respect to the projected Gaussians.

    means2d: (N, 2), per pixel; for camera models along rays, per radian along the axes of the tangent plane.
    abs_means2d: (N, 2), sums over pixels of the absolute values of the gradients in means2d.
    conics: (N, 3), with respect to a, b, c.
    opacities: (N,).
    colors: (N, 3).
    contributions: (N,), each Gaussian's contribution to the image: eq. (55).
    nearness: (N,), with respect to 1 / depth: eq. (122).
    """

    means2d: Float64
    abs_means2d: Float64
    conics: Float64
    opacities: Float64
    colors: Float64
    contributions: Float64
    nearness: Float64


@dataclass(frozen=True, eq=False)
class Layer:
    """A Gaussian's alpha on its box of pixels, and the transmittance there. Arrays have the box's shape.

    position: the Gaussian's position in the depth order, from the front.
    before, after: transmittance in front of the Gaussian and behind it.
    added: mask of the pixels to which the Gaussian is added.
    margin: as in `BlendedTwin`; infinite in pixels that are already saturated.
    """

    position: int
    gaussian: int
    box: tuple[slice, slice]
    alpha: Float64
    before: Float64
    after: Float64
    added: NDArray[np.bool_]
    margin: Float64


def layers(projected: Seen, width: int, height: int) -> Iterator[Layer]:
    """Yield the layers of the visible Gaussians, front to back: eqs. (14) to (16)."""
    transmittance, alive = np.ones((height, width)), np.ones((height, width), np.bool_)
    for position, gaussian in enumerate(projected.order):
        splat = projected.footprint(int(gaussian), width, height)
        if splat is None or not alive[box := splat.box].any():
            continue
        alpha = np.minimum(BLEND_ALPHA_MAX, splat.raw)
        before, seen = transmittance[box].copy(), alive[box] & (alpha >= ALPHA_MIN)
        after = before * (1 - alpha)
        added = seen & (after > TRANSMITTANCE_MIN)
        margin = np.minimum(np.abs(splat.raw / ALPHA_MIN - 1), np.abs(splat.raw / BLEND_ALPHA_MAX - 1))
        margin = np.minimum(margin, np.where(seen, np.abs(after / TRANSMITTANCE_MIN - 1), np.inf))
        margin = np.where(alive[box], margin, np.inf)
        transmittance[box] = after = np.where(added, after, before)
        alive[box] &= added | ~seen
        yield Layer(position, int(gaussian), box, alpha, before, after, added, margin)


def blend(
    projected: Seen,
    width: int,
    height: int,
    background: Sequence[float] | Float64 = (0.0, 0.0, 0.0),
) -> BlendedTwin:
    """Blend the visible Gaussians front to back, then add the background: eqs. (14) to (16)."""
    image = np.zeros((height, width, 3))
    transmittance = np.ones((height, width))
    last = np.full((height, width), -1, np.int64)
    count = np.zeros((height, width), np.int64)
    margin, nearness = np.full((height, width), BOX_SLACK / 2), np.zeros((height, width))
    for layer in layers(projected, width, height):
        box, added = layer.box, layer.added
        margin[box] = np.minimum(margin[box], layer.margin)
        weight = np.where(added, layer.before * layer.alpha, 0.0)
        image[box] += weight[:, :, None] * projected.colors[layer.gaussian]
        nearness[box] += weight / projected.depths[layer.gaussian]
        transmittance[box] = layer.after
        last[box] = np.where(added, layer.position, last[box])
        count[box] += added
    image += transmittance[:, :, None] * np.asarray(background, np.float64)
    return BlendedTwin(image, transmittance, last, count, margin, nearness)


def blend_grad(
    projected: Seen,
    width: int,
    height: int,
    background: Sequence[float] | Float64,
    d_image: Float64,
    d_transmittance: Float64 | None = None,
    d_nearness: Float64 | None = None,
) -> BlendGradients:
    """Return the gradients of blending, computed back to front: eqs. (22) to (29) and (55).

    d_image: (H, W, 3), gradient of the loss with respect to the image.
    d_transmittance: (H, W), gradient with respect to the transmittance behind all Gaussians: eq. (82); None for 0.
    d_nearness: (H, W), gradient with respect to the nearness: eq. (122); None for 0.
    """
    forward, order = blend(projected, width, height, background), projected.order
    transmittance = forward.transmittance.copy()
    behind = np.broadcast_to(np.asarray(background, np.float64), (height, width, 3)).copy()
    at_end = transmittance * (0.0 if d_transmittance is None else d_transmittance)
    by_near = np.zeros((height, width)) if d_nearness is None else d_nearness
    near_behind = np.zeros((height, width))
    number = len(projected.depths)
    gradients = BlendGradients(
        means2d=np.zeros((number, 2)),
        abs_means2d=np.zeros((number, 2)),
        conics=np.zeros((number, 3)),
        opacities=np.zeros(number),
        colors=np.zeros((number, 3)),
        contributions=np.zeros(number),
        nearness=np.zeros(number),
    )
    for position in range(len(order) - 1, -1, -1):
        gaussian = int(order[position])
        splat = projected.footprint(gaussian, width, height)
        if splat is None:
            continue
        box = splat.box
        alpha = np.minimum(BLEND_ALPHA_MAX, splat.raw)
        added = (alpha >= ALPHA_MIN) & (position <= forward.last[box])
        if not added.any():
            continue
        alpha = np.where(added, alpha, 0.0)
        color = projected.colors[gaussian]
        transmittance[box] /= 1 - alpha  # the transmittance in front of this Gaussian
        weight = transmittance[box] * alpha
        gradients.contributions[gaussian] = weight.sum()
        d_alpha = transmittance[box] * (d_image[box] * (color - behind[box])).sum(axis=2)
        d_alpha = d_alpha - at_end[box] / (1 - alpha)
        nearer = 1 / projected.depths[gaussian] - near_behind[box]
        d_alpha = d_alpha + transmittance[box] * by_near[box] * nearer
        gradients.nearness[gaussian] = (weight * by_near[box]).sum()
        near_behind[box] += alpha * nearer
        gradients.colors[gaussian] = (weight[:, :, None] * d_image[box]).sum(axis=(0, 1))
        behind[box] += alpha[:, :, None] * (color - behind[box])

        free = added & (splat.raw <= BLEND_ALPHA_MAX)  # an alpha at its limit passes no gradient on
        _set_shape_gradients(gradients, projected, gaussian, splat, np.where(free, d_alpha, 0.0), alpha)
    return gradients


def _set_shape_gradients(
    gradients: BlendGradients, projected: Seen, gaussian: int, splat: Footprint, d_alpha: Float64, alpha: Float64
) -> None:
    """Set the gradients of a Gaussian's mean, conic and opacity: eqs. (25) to (29).

    splat: the Gaussian's footprint on a box of h x w pixels.
    alpha: (h, w), the Gaussian's alpha at these pixels.
    d_alpha: (h, w), the gradient with respect to `alpha`.
    """
    g = d_alpha * alpha
    dx, dy = splat.dx, splat.dy
    by_x, by_y = (g * along for along in projected.by_mean(gaussian, splat))
    gradients.means2d[gaussian] = by_x.sum(), by_y.sum()
    gradients.abs_means2d[gaussian] = np.abs(by_x).sum(), np.abs(by_y).sum()
    gradients.conics[gaussian] = (
        -0.5 * (g * dx * dx).sum(),
        -(g * dx * dy).sum(),
        -0.5 * (g * dy * dy).sum(),
    )
    gradients.opacities[gaussian] = (d_alpha * splat.falloff).sum()
