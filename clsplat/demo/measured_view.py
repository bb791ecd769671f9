# SPDX-License-Identifier: Apache-2.0
"""Gaussians and a photograph of the demo's scene for timing a training step. They are the same on every machine, as the
camera is known and not recovered by structure from motion."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
from numpy.typing import NDArray

from clsplat.camera import Camera
from clsplat.demo.ray_caster import bake, cameras, render, still_life
from clsplat.gaussians import Gaussians
from clsplat.scenes.start.initialise import from_points

MEASURED_GAUSSIANS = 20_000
"""Number of Gaussians: enough to keep a GPU busy at the size of `measured_view`'s photograph."""
COEFFICIENTS = 16
"""SH coefficients per channel: degree 3, which training reaches after 3000 steps."""


def measured_view(count: int = MEASURED_GAUSSIANS) -> tuple[Gaussians, Camera, NDArray[np.uint8]]:
    """Return Gaussians on the surfaces of the demo's scene, and the camera and pixels of its first photograph.

    The Gaussians are those with which a training from `count` points starts, with zeros for the higher SH bands. The
    number of Gaussians on a surface is proportional to the number of the surface's texels.
    """
    surfaces = still_life()
    bake(surfaces, seed=0)
    rng = np.random.default_rng(0)
    texels = np.array([surface.rows * surface.columns for surface in surfaces])
    chosen = np.bincount(rng.choice(len(surfaces), count, p=texels / texels.sum()), minlength=len(surfaces))
    points, colours = [], []
    for surface, number in zip(surfaces, chosen, strict=True):
        places, _ = surface.point(*rng.random((2, number), np.float32))
        points.append(places)
        colours.append(np.clip(surface.colour(places), 0, 1))
    start = from_points(np.concatenate(points), np.concatenate(colours))
    sh = np.zeros((count, COEFFICIENTS, 3), np.float32)
    sh[:, :1] = start.sh
    (camera,) = cameras(1, 320, 240, seed=0)
    photograph = np.rint(255 * render(surfaces, camera)).astype(np.uint8)
    return replace(start, sh=sh), camera, photograph
