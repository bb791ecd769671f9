# SPDX-License-Identifier: Apache-2.0
"""Bilateral grids of photographs (colour transforms), their gradient and Adam's update: twin of kernels/grid.cl."""

from __future__ import annotations

import numpy as np

from clsplat.arrays import Float64

LUMINANCE_WEIGHTS = np.array([0.299, 0.587, 0.114])
"""Weights of red, green and blue in the luminance, which places a pixel between the grid's levels."""


def identity(shape: tuple[int, int, int]) -> Float64:
    """Return a grid (levels, rows, columns, 3, 4) that changes no colour.

    shape: number of levels, rows and columns.
    """
    return np.broadcast_to(np.eye(3, 4), (*shape, 3, 4)).copy()


def _hats(places: Float64, count: int) -> Float64:
    """Return linear interpolation weights (..., count) of the vertices on an axis, at coordinates `places` (...)."""
    weights: Float64 = np.maximum(1 - np.abs(places[..., None] - np.arange(count)), 0)
    return weights


def _weights(image: Float64, shape: tuple[int, ...]) -> tuple[Float64, Float64, Float64, Float64]:
    """Return interpolation weights of a grid's rows (H, rows), columns (W, columns) and levels (H, W, levels).

    The fourth result is the derivative of the level weights with respect to luminance. shape: as for `identity`.
    """
    (height, width, _), (levels, rows, columns) = image.shape, shape
    down = _hats((np.arange(height) + 0.5) / height * (rows - 1), rows)
    along = _hats((np.arange(width) + 0.5) / width * (columns - 1), columns)
    luminance = image @ LUMINANCE_WEIGHTS
    level = np.clip(luminance, 0, 1) * (levels - 1)
    low = np.minimum(np.floor(level), levels - 2)[..., None]
    slope = (np.arange(levels) == low + 1).astype(np.float64) - (np.arange(levels) == low)
    inside = ((luminance > 0) & (luminance < 1))[..., None]
    return down, along, _hats(level, levels), (levels - 1) * inside * slope


def _maps(down: Float64, along: Float64, levels: Float64, grid: Float64) -> Float64:
    """Interpolate a grid to the pixels: (H, W, 3, 4). down, along, levels: weights from `_weights`.

    Sums over one axis at a time, because a single call of `np.einsum` would do far more work.
    """
    rows = np.tensordot(down, grid, axes=(1, 1))  # (H, levels, columns, 3, 4)
    pixels = np.tensordot(rows, along, axes=(2, 1))  # (H, levels, 3, 4, W)
    maps: Float64 = np.einsum("yxl,ylabx->yxab", levels, pixels)
    return maps


def apply(image: Float64, grid: Float64) -> Float64:
    """Transform the colours of an image (H, W, 3) by the affine maps that a grid interpolates at its pixels."""
    down, along, levels, _ = _weights(image, grid.shape[:3])
    maps = _maps(down, along, levels, grid)
    seen: Float64 = np.einsum("yxab,yxb->yxa", maps[..., :3], image) + maps[..., 3]
    return seen


def gradient(image: Float64, grid: Float64, by_seen: Float64) -> tuple[Float64, Float64]:
    """Return gradients with respect to the image and the grid.

    by_seen: (H, W, 3), the gradient with respect to the transformed image.
    """
    down, along, levels, slopes = _weights(image, grid.shape[:3])
    whole = np.concatenate([image, np.ones_like(image[..., :1])], axis=-1)
    by_levels = np.einsum("yxl,yxa,yxb->yxlab", levels, by_seen, whole)
    by_columns = np.tensordot(by_levels, along, axes=(1, 0))  # (H, levels, 3, 4, columns)
    by_grid: Float64 = np.tensordot(down, by_columns, axes=(0, 0)).transpose(1, 0, 4, 2, 3)
    maps, risen = (_maps(down, along, each, grid) for each in (levels, slopes))
    by_luminance = np.einsum("yxa,yxab,yxb->yx", by_seen, risen, whole)
    by_image = np.einsum("yxa,yxab->yxb", by_seen, maps[..., :3]) + by_luminance[..., None] * LUMINANCE_WEIGHTS
    return by_image, by_grid


def variation(grid: Float64) -> float:
    """Return a grid's total variation: the mean squared difference of neighbouring vertices, summed over the axes."""
    return float(sum(np.square(np.diff(grid, axis=axis)).mean() for axis in range(3)))


def variation_gradient(grid: Float64) -> Float64:
    """Return the gradient of `variation` with respect to the grid."""
    total = np.zeros_like(grid)
    for axis in range(3):
        steps = np.diff(grid, axis=axis)
        ends = [(1, 0) if each == axis else (0, 0) for each in range(grid.ndim)]
        total += 2 / steps.size * (np.pad(steps, ends) - np.pad(steps, [end[::-1] for end in ends]))
    return total


def centre(grids: Float64, mean: Float64) -> Float64:
    """Shift the grids (photographs, levels, rows, columns, 3, 4) so that their mean is `mean`."""
    centred: Float64 = grids - grids.mean(axis=0) + mean
    return centred


def step(
    grid: Float64, first: Float64, second: Float64, by_grid: Float64, visit: int, rate: float
) -> tuple[Float64, Float64, Float64]:
    """Return a grid and both moments after a step of Adam with the gradient `by_grid`. rate: learning rate.

    visit: number of the grid's steps so far, including this step.
    """
    first, second = 0.9 * first + 0.1 * by_grid, 0.999 * second + 0.001 * by_grid**2
    change = rate * (first / (1 - 0.9**visit)) / (np.sqrt(second / (1 - 0.999**visit)) + 1e-15)
    return grid - change, first, second
