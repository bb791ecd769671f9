# SPDX-License-Identifier: Apache-2.0
"""Sizes, cameras and Gaussians of the workload of `check_memory.py`."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np

from clsplat.camera import Camera
from clsplat.gaussians import Gaussians
from clsplat.layouts.columns import CHUNK_ROWS


@dataclass
class Extent:
    """Sizes of the workload's pictures, and numbers of steps. Blending and the loss take most of Oclgrind's time.

    frame, view, low, picture: sizes in pixels, of 6, 4, 2 and 6 tiles, or after `shorten` of 2, 2, 1 and 1.
    capacity: number of pairs in a band, so small that `frame` has several bands.
    steps: number of steps with each method of training.
    missed: maximum number of steps that a chunk has missed; `catch_up` takes 16 of them at a time.
    """

    frame: tuple[int, int] = (33, 17)
    view: tuple[int, int] = (20, 17)
    low: tuple[int, int] = (17, 7)
    picture: tuple[int, int] = (33, 17)
    capacity: int = 70
    steps: int = 2
    missed: int = 300

    def shorten(self) -> None:
        """Make everything as small as possible while every kernel still has all its builds."""
        self.frame = self.view = 9, 17
        self.low = self.picture = 9, 7
        self.capacity, self.steps, self.missed = 40, 1, 40


EXTENT = Extent()


def camera(width: int, height: int) -> Camera:
    """A camera at the origin that looks along z, with its principal point a little off the centre."""
    return Camera(width, height, 0.9 * width, 0.8 * width, 0.45 * width, 0.55 * height, np.eye(3), np.zeros(3))


def cloud(count: int, view: Camera, seed: int = 0, degree: int = 3) -> Gaussians:
    """Gaussians of all sizes and opacities, some beside the view's image, behind its camera or too faint to show."""
    rng = np.random.default_rng(seed)
    depth = rng.uniform(1.5, 5.0, count)
    depth[::9] *= -1
    at = rng.uniform(-0.2, 1.2, (count, 2)) * (view.width, view.height)
    sides = (at - (view.cx, view.cy)) / (view.fx, view.fy) * depth[:, None]
    sh = rng.normal(0, 0.2, (count, (degree + 1) ** 2, 3))
    return Gaussians(
        np.concatenate([sides, depth[:, None]], axis=1).astype(np.float32),
        rng.normal(size=(count, 4)).astype(np.float32),
        np.log(np.abs(depth)[:, None] / view.fx * rng.uniform(0.5, 4.0, (count, 3))).astype(np.float32),
        rng.uniform(-6, 6, count).astype(np.float32),
        sh.astype(np.float32),
    )


def mostly_behind(view: Camera) -> Gaussians:
    """A model of three chunks, once its rows are ordered: the last, of 18 Gaussians, is in front of the camera, and the
    others are behind it, beside its axis."""
    gaussians = cloud(2 * CHUNK_ROWS + 18, camera(view.width, view.height), 5, degree=0)
    gaussians.means[:, 2] = np.abs(gaussians.means[:, 2])
    gaussians.means[18:] += np.array([60, 0, -50], np.float32)
    gaussians.log_scales[18:] = -5
    return gaussians
