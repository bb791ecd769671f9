# SPDX-License-Identifier: Apache-2.0
"""The library's kernels for `check_memory.py`: small calls of every kind, with their gradients."""

from __future__ import annotations

from collections.abc import Sequence
from typing import Any

import numpy as np
from memory_scenes import EXTENT

from clsplat.device.context import Device
from clsplat.library.harmonics import spherical_harmonics
from clsplat.library.rasterize import rasterize
from clsplat.library.tile_list_pixels import rasterize_to_pixels
from clsplat.library.tiles import isect_offset_encode, isect_tiles

COUNT = 65
"""Number of Gaussians: one group of 64 is not enough."""


def library(device: Device) -> None:
    """Run every kernel of clsplat/library in all builds that differ. Raises SystemExit for non-finite numbers."""
    rng, (width, height) = np.random.default_rng(0), EXTENT.low
    means, quaternions = rng.uniform(-0.7, 0.7, (COUNT, 3)), rng.normal(size=(COUNT, 4))
    scales, opacities = rng.uniform(0.02, 0.2, (COUNT, 3)), rng.uniform(0.1, 1.0, COUNT)
    roots = rng.uniform(-0.2, 0.2, (COUNT, 3, 3))
    covars, poses = roots @ roots.transpose(0, 2, 1) + 1e-3 * np.eye(3), np.stack([np.eye(4)] * 2)
    poses[:, 2, 3] = 3.0, 2.5
    lenses = np.stack([np.array([[20.0, 0, 10], [0, 20, 5], [0, 0, 1]])] * 2)
    colours, features = rng.random((COUNT, 3)), rng.random((COUNT, 18))
    sh, wide = (rng.normal(0, 0.2, (COUNT, number, 3)) for number in (16, 25))
    plain = (means, quaternions, scales, opacities)
    calls: tuple[tuple[tuple[Any, Any, Any, Any], Any, dict[str, Any]], ...] = (
        (plain, colours, {"backgrounds": [0.1, 0.2, 0.3], "absolute_gradients": True}),
        (plain, sh, {"sh_degree": 3, "rasterize_mode": "antialiased", "camera_model": "fisheye", "alpha_max": 0.999}),
        (plain, features, {"camera_model": "ortho", "render_mode": "RGB+ED", "absolute_gradients": True}),
        ((means, None, None, opacities), colours, {"covars": covars, "rasterize_mode": "antialiased"}),
    )
    for index, (gaussians, values, settings) in enumerate(calls):
        cameras = slice(0, 2 if index == 0 else 1)  # two cameras, whose gradients are added, in one call
        views = (poses[cameras], lenses[cameras], width, height)
        result = rasterize(*gaussians, values, *views, device=device, **settings)
        gradients = result.vjp(np.ones_like(result.images), np.ones_like(result.alphas))
        check(result.images, *gradients.values())
    for degree, coefficients in ((2, sh), (4, wide)):
        directions = spherical_harmonics(degree, means, coefficients, np.arange(COUNT) % 3 > 0, device=device)
        check(directions.colors, *directions.vjp(np.ones((COUNT, 3))).values())
    result = rasterize(*plain, colours, poses[:1], lenses[:1], width, height, device=device)
    tiles = (-(-width // 16), -(-height // 16))
    _, ids, gaussians_listed = isect_tiles(result.means2d, result.radii, result.depths, 16, *tiles)
    offsets = isect_offset_encode(ids, 1, *tiles)
    arrays = (result.means2d, result.conics, result.colors2d, result.opacities)
    pixels = rasterize_to_pixels(*arrays, width, height, 16, offsets, gaussians_listed, device=device)
    check(pixels.colors, *pixels.vjp(np.ones_like(pixels.colors)).values())


def check(*arrays: np.ndarray | Sequence[np.ndarray]) -> None:
    """Raise SystemExit if a number is not finite."""
    if not all(np.isfinite(array).all() for array in arrays):
        raise SystemExit("the library's results are not finite")
