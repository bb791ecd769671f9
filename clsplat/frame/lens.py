# SPDX-License-Identifier: Apache-2.0
"""Lenses that bend a picture: where each pixel is in a straight one, by an STMap or by a photograph's lens.

A straight picture is looked at as far as the places reach, also beyond the frame. `warp` makes the bent one.
"""

from __future__ import annotations

from dataclasses import dataclass, replace
from functools import cached_property
from typing import Protocol

import numpy as np

from clsplat.arrays import Float64
from clsplat.camera import FRAME_CLAMP, Camera, Window
from clsplat.frame.window import crop
from clsplat.images.stmap import StMap
from clsplat.scenes.data_set import Lens

BEYOND = 1.0
"""Frames beyond each edge of the straight frame from which on there is nothing: a map may say anything there."""
STEP = 2.0**-20
"""Pixels that places are whole multiples of, so that counting them from a window's corner rounds nothing."""
MARGIN = 2
"""Pixels around a place that its interpolation looks at."""
GRID = 33
"""Places across and down at which a lens is looked at for what holds of the whole frame."""
ONE_SAMPLE = 1.25
"""Straight pixels a bent one up to which one sample of it is enough."""
MOST_SAMPLES = 16
_STEPS = ((0.5, 0.0), (-0.5, 0.0), (0.0, 0.5), (0.0, -0.5))


class Places(Protocol):
    """A source of places."""

    def size(self, frame: Camera) -> tuple[int, int]:
        """Width and height of the bent frame, of a straight one."""

    def places(self, frame: Camera, x: Float64, y: Float64) -> Float64:
        """(h, w, 2) pixels of the straight frame that are seen at x (w,), y (h,) of the bent one; NaN where nothing
        is."""


@dataclass(frozen=True, eq=False)
class ByMap:
    """Places by an STMap."""

    stmap: StMap

    def size(self, frame: Camera) -> tuple[int, int]:  # noqa: ARG002
        """The map's."""
        return self.stmap.width, self.stmap.height

    def places(self, frame: Camera, x: Float64, y: Float64) -> Float64:
        """Pixels of the straight frame, as of `Places`."""
        u, v = np.moveaxis(self.stmap.at(x, y), 2, 0)
        return np.stack([u * frame.width, (1 - v) * frame.height], axis=2)


@dataclass(frozen=True, eq=False)
class ByLens:
    """Places by the lens of a photograph, whose pixels the bent picture has. The frame is that of `Lens.bare`, in any
    size."""

    lens: Lens

    def size(self, frame: Camera) -> tuple[int, int]:
        """The frame's."""
        return frame.width, frame.height

    def places(self, frame: Camera, x: Float64, y: Float64) -> Float64:
        """Pixels of the straight frame, as of `Places`."""
        bare = self.lens.bare(frame.rotation, frame.translation)
        across, down = np.meshgrid((x - frame.cx) / frame.fx * bare.fx, (y - frame.cy) / frame.fy * bare.fy)
        pixels = np.stack([(across + bare.cx).ravel(), (down + bare.cy).ravel()], axis=1)
        rays = self.lens.cam_from_img(pixels).reshape(len(y), len(x), 2)
        return np.asarray(rays * (frame.fx, frame.fy) + (frame.cx, frame.cy))


@dataclass(frozen=True, eq=False)
class Warp:
    """A straight frame, and where a bent one's pixels are in it. frame: a camera of the whole of it."""

    source: Places
    frame: Camera

    def at(self, x: Float64, y: Float64) -> Float64:
        """Places (h, w, 2), NaN also where they are too far out."""
        places = np.round(self.source.places(self.frame, x, y) / STEP) * STEP
        size = np.array([self.frame.width, self.frame.height])
        with np.errstate(invalid="ignore"):
            inside = np.logical_and(places >= -BEYOND * size, places <= (1 + BEYOND) * size).all(axis=2)
        return np.where(np.expand_dims(inside, 2), places, np.nan)

    @property
    def shown(self) -> Camera:
        """A camera of the bent frame's size; of its pixels alone, not of what they see."""
        width, height = self.source.size(self.frame)
        return replace(self.frame, width=width, height=height)

    @cached_property
    def _grid(self) -> tuple[Float64, Float64]:
        """Places (GRID, GRID, 2) over the frame, and by how much they move a pixel on, across and down, the larger."""
        width, height = self.source.size(self.frame)
        x, y = ((np.arange(GRID) / (GRID - 1)) * (side - 1) + 0.5 for side in (width, height))
        ends = [self.at(*(places + shift for places, shift in zip((x, y), by, strict=True))) for by in _STEPS]
        steps = np.stack([np.linalg.norm(ends[0] - ends[1], axis=2), np.linalg.norm(ends[2] - ends[3], axis=2)])
        return self.at(x, y), np.fmax(*steps)

    @property
    def empty(self) -> float:
        """The part of the frame that nothing is seen in."""
        return float(np.isnan(self._grid[0][:, :, 0]).mean())

    @cached_property
    def samples(self) -> int:
        """Samples of a pixel across and down."""
        most = np.nanmax(self._grid[1], initial=0.0)
        return 1 if most <= ONE_SAMPLE else min(int(np.ceil(most - 1e-3)), MOST_SAMPLES)

    @cached_property
    def clamp(self) -> float:
        """`Window.clamp` of the straight frame, the same for each of its windows."""
        places = self._grid[0].reshape(-1, 2)
        if np.isnan(places).all():
            return FRAME_CLAMP
        size = np.array([self.frame.width, self.frame.height])
        beyond = np.maximum(-np.nanmin(places, axis=0), np.nanmax(places, axis=0) - size) + MARGIN
        return max(FRAME_CLAMP, float((2 * beyond / size).max()))

    def of_window(self, camera: Camera) -> tuple[Float64, Camera | None]:
        """Places (k height, k width, 2) of the samples of a picture or a window of it; and the straight window that
        they are in, None where they are nowhere."""
        x, y = (camera.window.x, camera.window.y) if camera.window else (0, 0)
        samples = self.samples
        across = x + (np.arange(camera.width * samples) + 0.5) / samples
        down = y + (np.arange(camera.height * samples) + 0.5) / samples
        places = self.at(across, down)
        if np.isnan(places).all():
            return places, None
        first = np.floor(np.nanmin(places, axis=(0, 1))).astype(int) - MARGIN
        last = np.ceil(np.nanmax(places, axis=(0, 1))).astype(int) + MARGIN
        (left, top), (width, height) = first.tolist(), (last - first).tolist()
        whole = replace(self.frame, window=Window(0, 0, self.frame.width, self.frame.height, self.clamp))
        return places, crop(whole, left, top, width, height)


def distorted_places(lens: Lens, straight: Camera) -> Float64:
    """(height, width, 2): pixels of the straight picture that are seen in the lens's own; NaN where none is."""
    grid = np.meshgrid(np.arange(lens.width) + 0.5, np.arange(lens.height) + 0.5)
    rays = lens.cam_from_img(np.stack([axis.ravel() for axis in grid], axis=1))
    places = rays * (straight.fx, straight.fy) + (straight.cx, straight.cy)
    return np.asarray(places.reshape(lens.height, lens.width, 2))


def undistorted_places(lens: Lens, straight: Camera) -> Float64:
    """(height, width, 2): pixels of the lens's own picture that are seen in the straight one; NaN where none is."""
    x = (np.arange(straight.width) + 0.5 - straight.cx) / straight.fx
    y = (np.arange(straight.height) + 0.5 - straight.cy) / straight.fy
    across, down = np.meshgrid(x, y)
    rays = np.stack([across.ravel(), down.ravel(), np.ones(across.size)], axis=1)
    return lens.img_from_cam(rays).reshape(straight.height, straight.width, 2)
