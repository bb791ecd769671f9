# SPDX-License-Identifier: Apache-2.0
"""Lens distortion of rendered frames: where a distorted picture's pixels lie in an undistorted picture, by an STMap or
a photograph's lens.

The undistorted picture is rendered as far as these positions reach, also beyond the frame (overscan). Module `warp`
samples it.
"""

from __future__ import annotations

from dataclasses import dataclass, replace
from functools import cached_property
from typing import Protocol

import numpy as np

from clsplat.arrays import Float64
from clsplat.camera import JACOBIAN_CLAMP_HALF_FRAMES, Camera, Window
from clsplat.images.stmap import StMap
from clsplat.scenes.dataset import Lens

MAX_BEYOND_EDGE_FRAMES = 1.0
"""Maximum distance of a position beyond an edge of the undistorted frame, in frame sizes. Pixels with a larger distance
show nothing, because the values of a map may be arbitrary there."""
PLACE_STEP_PX = 2.0**-20
"""Step in pixels to whose multiples positions are rounded, so that subtraction of a window's corner is exact."""
INTERPOLATION_MARGIN_PX = 2
"""Number of pixels on each side of a position that the interpolation reads."""
PROBE_GRID_SIDE = 33
"""Number of positions across, and down, at which the properties of a whole warp are estimated."""
MAX_SINGLE_SAMPLE_PX = 1.25
"""Maximum size of a warped pixel, in pixels of the undistorted picture, up to which a single sample is enough."""
MAX_WARP_SAMPLES = 16
"""Maximum number of samples across a warped pixel, and down."""
_HALF_PIXEL_STEPS = ((0.5, 0.0), (-0.5, 0.0), (0.0, 0.5), (0.0, -0.5))


class Places(Protocol):
    """A mapping from positions in a warped picture to positions in an undistorted picture."""

    def size(self, frame: Camera) -> tuple[int, int]:
        """Width and height of the warped frame that belongs to an undistorted frame."""

    def places(self, frame: Camera, x: Float64, y: Float64) -> Float64:
        """Return the positions (h, w, 2) in the undistorted frame that belong to x (w,), y (h,) in the warped frame.

        All are in pixels. NaN where nothing is visible.
        """


@dataclass(frozen=True, eq=False)
class ByMap:
    """A mapping (`Places`) that an STMap defines."""

    stmap: StMap

    def size(self, frame: Camera) -> tuple[int, int]:  # noqa: ARG002
        """Width and height of the STMap, which is the warped frame's size."""
        return self.stmap.width, self.stmap.height

    def places(self, frame: Camera, x: Float64, y: Float64) -> Float64:
        """Return the positions that the STMap gives, as `Places.places` specifies."""
        u, v = np.moveaxis(self.stmap.at(x, y), 2, 0)
        return np.stack([u * frame.width, (1 - v) * frame.height], axis=2)


@dataclass(frozen=True, eq=False)
class ByLens:
    """A mapping (`Places`) that a photograph's lens defines.

    The undistorted frame is rendered with the camera that `Lens.bare` returns, at any size. The warped picture has the
    same size and the lens's distortion, as the photograph has.
    """

    lens: Lens

    def size(self, frame: Camera) -> tuple[int, int]:
        """Width and height of the warped picture, which has the undistorted frame's size."""
        return frame.width, frame.height

    def places(self, frame: Camera, x: Float64, y: Float64) -> Float64:
        """Return the positions that the lens gives, as `Places.places` specifies."""
        bare = self.lens.bare(frame.rotation, frame.translation)
        across, down = np.meshgrid((x - frame.cx) / frame.fx * bare.fx, (y - frame.cy) / frame.fy * bare.fy)
        pixels = np.stack([(across + bare.cx).ravel(), (down + bare.cy).ravel()], axis=1)
        rays = self.lens.cam_from_img(pixels).reshape(len(y), len(x), 2)
        return np.asarray(rays * (frame.fx, frame.fy) + (frame.cx, frame.cy))


@dataclass(frozen=True, eq=False)
class Warp:
    """The warp of a frame: the undistorted frame that is rendered, and the mapping to it from the warped frame.

    source: mapping from positions in the warped frame to positions in the undistorted frame.
    frame: camera of the whole undistorted frame.
    """

    source: Places
    frame: Camera

    def at(self, x: Float64, y: Float64) -> Float64:
        """Return the positions (h, w, 2) in the undistorted frame that belong to x (w,), y (h,) in the warped frame.

        All are in pixels. The result is rounded to multiples of PLACE_STEP_PX. It is NaN where nothing is visible, and
        where it would be more than MAX_BEYOND_EDGE_FRAMES frame sizes beyond an edge of the undistorted frame.
        """
        places = np.round(self.source.places(self.frame, x, y) / PLACE_STEP_PX) * PLACE_STEP_PX
        size = np.array([self.frame.width, self.frame.height])
        with np.errstate(invalid="ignore"):
            inside = np.logical_and(
                places >= -MAX_BEYOND_EDGE_FRAMES * size, places <= (1 + MAX_BEYOND_EDGE_FRAMES) * size
            ).all(axis=2)
        return np.where(np.expand_dims(inside, 2), places, np.nan)

    @property
    def shown(self) -> Camera:
        """A camera of the warped frame's size. Only its size and window are valid, not its rays."""
        width, height = self.source.size(self.frame)
        return replace(self.frame, width=width, height=height)

    @cached_property
    def _grid(self) -> tuple[Float64, Float64]:
        """Positions (33, 33, 2) in the undistorted frame, and sizes (33, 33), of pixels spread over the warped frame.

        A pixel's size is the distance between its opposite sides in the undistorted frame, across or down, whichever is
        larger.
        """
        width, height = self.source.size(self.frame)
        x, y = ((np.arange(PROBE_GRID_SIDE) / (PROBE_GRID_SIDE - 1)) * (side - 1) + 0.5 for side in (width, height))
        ends = [
            self.at(*(places + shift for places, shift in zip((x, y), by, strict=True))) for by in _HALF_PIXEL_STEPS
        ]
        steps = np.stack([np.linalg.norm(ends[0] - ends[1], axis=2), np.linalg.norm(ends[2] - ends[3], axis=2)])
        return self.at(x, y), np.fmax(*steps)

    @property
    def empty(self) -> float:
        """Estimated fraction of the warped frame in which nothing is visible."""
        return float(np.isnan(self._grid[0][:, :, 0]).mean())

    @cached_property
    def samples(self) -> int:
        """Number of samples across a warped pixel, and down; 1 if no warped pixel is over MAX_SINGLE_SAMPLE_PX."""
        most = np.nanmax(self._grid[1], initial=0.0)
        return 1 if most <= MAX_SINGLE_SAMPLE_PX else min(int(np.ceil(most - 1e-3)), MAX_WARP_SAMPLES)

    @cached_property
    def clamp(self) -> float:
        """The value of `Window.clamp`, the Jacobian's limit, for all windows of the undistorted frame."""
        places = self._grid[0].reshape(-1, 2)
        if np.isnan(places).all():
            return JACOBIAN_CLAMP_HALF_FRAMES
        size = np.array([self.frame.width, self.frame.height])
        beyond = np.maximum(-np.nanmin(places, axis=0), np.nanmax(places, axis=0) - size) + INTERPOLATION_MARGIN_PX
        return max(JACOBIAN_CLAMP_HALF_FRAMES, float((2 * beyond / size).max()))

    def of_window(self, camera: Camera) -> tuple[Float64, Camera | None]:
        """Return where the samples of a warped picture are in the undistorted frame, and a camera whose window contains
        them.

        camera: camera of the warped picture; only its size and window matter.
        The positions are (k height, k width, 2), with k = `samples`. The returned camera is None if nothing is visible.
        """
        x, y = (camera.window.x, camera.window.y) if camera.window else (0, 0)
        samples = self.samples
        across = x + (np.arange(camera.width * samples) + 0.5) / samples
        down = y + (np.arange(camera.height * samples) + 0.5) / samples
        places = self.at(across, down)
        if np.isnan(places).all():
            return places, None
        first = np.floor(np.nanmin(places, axis=(0, 1))).astype(int) - INTERPOLATION_MARGIN_PX
        last = np.ceil(np.nanmax(places, axis=(0, 1))).astype(int) + INTERPOLATION_MARGIN_PX
        (left, top), (width, height) = first.tolist(), (last - first).tolist()
        whole = replace(self.frame, window=Window(0, 0, self.frame.width, self.frame.height, self.clamp))
        return places, whole.cropped(left, top, width, height)


def distorted_places(lens: Lens, straight: Camera) -> Float64:
    """Return positions (height, width, 2) of a distorted picture's pixels in the undistorted picture.

    lens: lens of the distorted picture. straight: camera of the undistorted picture.
    NaN where a pixel has no ray.
    """
    grid = np.meshgrid(np.arange(lens.width) + 0.5, np.arange(lens.height) + 0.5)
    rays = lens.cam_from_img(np.stack([axis.ravel() for axis in grid], axis=1))
    places = rays * (straight.fx, straight.fy) + (straight.cx, straight.cy)
    return np.asarray(places.reshape(lens.height, lens.width, 2))


def undistorted_places(lens: Lens, straight: Camera) -> Float64:
    """Return positions (height, width, 2) of an undistorted picture's pixels in the distorted picture.

    lens, straight: as for `distorted_places`.
    NaN where the lens does not show the pixel.
    """
    x = (np.arange(straight.width) + 0.5 - straight.cx) / straight.fx
    y = (np.arange(straight.height) + 0.5 - straight.cy) / straight.fy
    across, down = np.meshgrid(x, y)
    rays = np.stack([across.ravel(), down.ravel(), np.ones(across.size)], axis=1)
    return lens.img_from_cam(rays).reshape(straight.height, straight.width, 2)
