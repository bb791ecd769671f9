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
    """Pictures and steps of the workload. Oclgrind takes most of its time for the pixels of blending and of the loss.

    frame: of six tiles, or of two, one above the other. view: of four, or of two. low: of two, or of one. picture: of
    six, or of one.
    capacity: pairs of a band, of which `frame` then has several. steps: of each of training's methods. missed: steps
    that a chunk has missed at most, of which `catch_up` takes 16 at a time.
    """

    frame: tuple[int, int] = (33, 17)
    view: tuple[int, int] = (20, 17)
    low: tuple[int, int] = (17, 7)
    picture: tuple[int, int] = (33, 17)
    capacity: int = 70
    steps: int = 2
    missed: int = 300

    def shorten(self) -> None:
        """The least with which every kernel has every build."""
        self.frame = self.view = 9, 17
        self.low = self.picture = 9, 7
        self.capacity, self.steps, self.missed = 40, 1, 40


EXTENT = Extent()


def camera(width: int, height: int) -> Camera:
    """Looks along z, a little off the centre."""
    return Camera(width, height, 0.9 * width, 0.8 * width, 0.45 * width, 0.55 * height, np.eye(3), np.zeros(3))


def cloud(count: int, view: Camera, seed: int = 0, degree: int = 3) -> Gaussians:
    """Gaussians of all sizes and opacities, some beside the image, behind the camera or too faint to show."""
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
    """A model of three chunks: the last one, of 18 Gaussians, is in front of the camera, and the others are behind it,
    beside its axis."""
    gaussians = cloud(2 * CHUNK_ROWS + 18, camera(view.width, view.height), 5, degree=0)
    gaussians.means[:, 2] = np.abs(gaussians.means[:, 2])
    gaussians.means[18:] += np.array([60, 0, -50], np.float32)
    gaussians.log_scales[18:] = -5
    return gaussians
