# SPDX-License-Identifier: Apache-2.0
"""Scenes: pictures with their cameras as views, and points."""

from __future__ import annotations

import os
from collections.abc import Callable, Sequence
from concurrent.futures import ThreadPoolExecutor
from dataclasses import dataclass, field
from functools import cached_property
from pathlib import Path
from typing import Literal, TypeVar

import numpy as np
from numpy.typing import NDArray

from clsplat.arrays import Float32, Float64
from clsplat.camera import NEAR, NEARS, Camera
from clsplat.config.depth import NO_DEPTH, DepthUse
from clsplat.config.points import OWN_POINTS, StartPoints
from clsplat.errors import InputError
from clsplat.files import short_digest
from clsplat.images.reading import downscale, read_image
from clsplat.scenes.data_set import Lens, pixels_of, undistort
from clsplat.scenes.glance import Glance, glance_at
from clsplat.scenes.known_depth import KnownDepth
from clsplat.scenes.masks import HALF, Mask
from clsplat.scenes.strays import stray_cameras

Split = Literal["train", "test"]
T = TypeVar("T")

FAR = 64.0
"""Distance of a scene from the world's origin, in its own sizes, beyond which its means count from its middle: float32
there knows places to 64 * 2^-24 of the size, a hundredth of a pixel of 2600 across the scene."""
LEAST_SHOWN, SHOWN_PART = 10, 0.08
"""Points in the picture of a far camera, and their standard deviation in parts of the picture, from which on it shows
what the others do from further off, or something else that was reconstructed. Points all over it have 0.29; a stray has
none, or all in a pixel."""
GROUP = 2
"""Other cameras beside a far one that are a group with it: wrong poses are scattered."""
ROUNDING = 1e-12
"""Cameras that are nearer than this to each other, as a part of how far they are from the origin, are in one place."""


@dataclass(frozen=True, eq=False)
class View:
    """A picture and the camera that took it.

    name: as in the data set, with extension, unique in the scene; camera: at the working size; path: the file that is
    read; split: "train" or "test"; lens: what the file was taken through, at the file's size; upright: the camera
    belongs to the picture turned as its EXIF orientation says, not as stored; mask: what of the picture counts, None
    for all; depth_file: the depth map that the data set names; depth: what training knows of depths.
    """

    name: str
    camera: Camera
    path: Path
    split: Split
    lens: Lens
    upright: bool = False
    mask: Mask | None = None
    depth_file: Path | None = None
    depth: KnownDepth | None = None

    def load(self, width: int | None = None, height: int | None = None) -> Float32:
        """Read the pixels, float32 (H, W, 3), or (H, W, 4) with straight alpha, undistorted, of the camera's size.

        width, height: another size. Reads the file each time. What a mask leaves out is black, or transparent. Raises
        InputError for one that does not decode or has changed its size since.
        """
        image = self.load_masked(width, height)
        return image if image.shape[2] < 5 else np.ascontiguousarray(image[:, :, : 3 + _has_alpha(image)])

    def load_masked(self, width: int | None = None, height: int | None = None) -> Float32:
        """The same; if something is left out with five channels, the last 1 where a pixel counts, else 0.

        A pixel counts if half of its area does. Its colour is the mean of that part alone, so that none leaks in.
        """
        width, height = width or self.camera.width, height or self.camera.height
        image = self._read()
        if self.mask is None:
            return self._fitted(image, width, height)
        image, counts = self.mask.applied(image, orient=self.upright)
        if counts is None:
            return self._fitted(image, width, height)
        parts = [np.where(counts > 0, image[:, :, :3], np.float32(0)), counts]
        if image.shape[2] == 4:  # alpha is averaged where it counts, as a colour
            there = np.where(counts > 0, image[:, :, 3:], np.float32(0))
            alpha = self._fitted(np.concatenate([there, there, there, counts], axis=2), width, height)
            parts[0] = parts[0] * there
        scaled = self._fitted(np.concatenate(parts, axis=2), width, height)
        whole = scaled[:, :, 3:] >= HALF
        opacity = np.clip(alpha[:, :, :1], 0, 1) if image.shape[2] == 4 else np.ones_like(scaled[:, :, :1])
        colour = scaled[:, :, :3] / np.where(opacity > 0, opacity, np.float32(1))
        result = np.concatenate([colour, opacity, np.ones_like(opacity)], axis=2)
        return np.ascontiguousarray(np.where(whole, result, np.float32(0)), np.float32)

    def _fitted(self, image: Float32, width: int, height: int) -> Float32:
        if self.lens.is_pinhole or self.camera.projection != "perspective":
            return downscale(image, width, height)
        return undistort(image, self.lens, self.camera.resized(width, height))

    def check(self) -> Glance:
        """A glance at the picture. Raises InputError where `load` would."""
        image = self._read()
        if self.mask is not None:
            self.mask.applied(image, orient=self.upright)
        return glance_at(image)

    def _read(self) -> Float32:
        image = read_image(self.path, orient=self.upright)
        if image.shape[:2] != (self.lens.height, self.lens.width):
            actual = f"{image.shape[1]} x {image.shape[0]}"
            raise InputError(f"{self.path}: is {actual} pixels now, expected {self.lens.width} x {self.lens.height}")
        return image


@dataclass(eq=False)
class Scene:
    """A scene to train on.

    name: the folder's; views sorted by name; points (N, 3) float64 in the world, N may be 0; point_colors (N, 3)
    float32 in [0, 1]; bounds: corners (low, high), each (3,) float64, world units, of the box for random initial
    points; warnings: for the user, a line each; start: how the points were chosen (`scenes.cloud`); colourless (N,):
    points whose colours are those of the photographs, None for none; source: the folder that it was read from;
    depth_use: how what is known of depths was chosen (`scenes.depth`); clouds: files of points beside the scene that
    are not used; missing: names of pictures that are listed and not there.
    """

    name: str
    views: list[View]
    points: Float64
    point_colors: Float32
    bounds: tuple[Float64, Float64]
    warnings: list[str] = field(default_factory=list)
    start: StartPoints = OWN_POINTS
    colourless: NDArray[np.bool_] | None = None
    source: Path | None = None
    depth_use: DepthUse = NO_DEPTH
    clouds: tuple[Path, ...] = ()
    missing: tuple[str, ...] = ()

    @cached_property
    def train_views(self) -> list[View]:
        """Views to train on, by name."""
        return [view for view in self.views if view.split == "train"]

    @cached_property
    def test_views(self) -> list[View]:
        """Views held out, by name."""
        return [view for view in self.views if view.split == "test"]

    def require_training_views(self) -> list[View]:
        """Views to train on. Raises InputError where there are none."""
        if not self.train_views:
            count = len(self.views)
            raise InputError(f"{self.name}: all {count} views are held out; use --test-every 0 to hold out none")
        return self.train_views

    def check_pictures(self) -> None:
        """Decode every picture once, so that a cut one is named before training and not in the middle of it; the
        `digests` and `glances` are made on the way.

        Raises InputError for the first by name that does not decode.
        """
        found = self._of_each(lambda view: (_digest(view), view.check()))
        self.__dict__["digests"] = {name: digest for name, (digest, _) in found.items()}
        self.__dict__["glances"] = {name: glance for name, (_, glance) in found.items()}

    @cached_property
    def glances(self) -> dict[str, Glance]:
        """A glance at each picture, by the view's name. Raises InputError as `check_pictures`."""
        return self._of_each(View.check)

    @cached_property
    def digests(self) -> dict[str, str | None]:
        """Digest of each view's file, with that of its mask, by the view's name."""
        return self._of_each(_digest)

    def _of_each(self, work: Callable[[View], T]) -> dict[str, T]:
        with ThreadPoolExecutor(os.cpu_count()) as pool:
            try:
                return {view.name: result for view, result in zip(self.views, pool.map(work, self.views), strict=True)}
            finally:
                pool.shutdown(cancel_futures=True)

    @cached_property
    def origin(self) -> Float64:
        """Point that the means of a model of this scene should count from, (3,) in the world: 0 unless the scene is far
        off.

        The middle of the cameras but for strays, in whole steps of about the scene's size.
        """
        centres = np.stack([view.camera.position for view in self.views if view.name not in self.stray_cameras])
        middle = centres.mean(axis=0)
        size = float(np.linalg.norm(centres - middle, axis=1).max())
        if len(self.points):
            size = max(size, float(np.median(np.linalg.norm(self.points - middle, axis=1))))
        if size == 0 or np.linalg.norm(middle) < FAR * size:
            return np.zeros(3)
        step = 2.0 ** np.ceil(np.log2(size))
        return np.asarray(np.round(middle / step) * step)

    @cached_property
    def stray_cameras(self) -> frozenset[str]:
        """Names of the views whose cameras stand so far off the others, and off the points, that they are strays. Those
        that show points in a fair part of their picture are none, nor groups of cameras near each other."""
        centres = np.stack([view.camera.position for view in self.views])
        middle = np.median(centres, axis=0)
        away = float(np.median(np.linalg.norm(self.points - middle, axis=1))) if len(self.points) else 0.0
        far = stray_cameras([view.camera for view in self.views], away)
        found = [view for view, stray in zip(self.views, far, strict=True) if stray]
        return frozenset(view.name for view in found if not _shows_much(view, self.points, self.views))

    @cached_property
    def spread(self) -> tuple[Float64, float, float]:
        """The middle of the training cameras but for strays, how far the farthest is from there, and their largest
        coordinate."""
        near = [view for view in self.train_views if view.name not in self.stray_cameras]
        centres = np.stack([view.camera.position for view in near or self.train_views or self.views])
        middle: Float64 = centres.mean(axis=0)
        return middle, float(np.linalg.norm(centres - middle, axis=1).max()), float(np.abs(centres).max())

    @property
    def in_one_place(self) -> bool:
        """True if all training cameras are in one place, but for rounding."""
        _, spread, largest = self.spread
        return spread <= ROUNDING * largest

    @cached_property
    def extent(self) -> float:
        """The authors' cameras_extent, world units: 1.1 times the farthest training camera's distance from their mean,
        strays left out.

        If the cameras are all in one place, the median distance of the points from there, or 1 if there are none: it
        scales the learning rates.
        """
        middle, spread, _ = self.spread
        if not self.in_one_place:
            return 1.1 * spread
        return (float(np.median(np.linalg.norm(self.points - middle, axis=1))) if len(self.points) else 0.0) or 1.0

    @cached_property
    def near(self) -> float:
        """The near plane of a model of this scene, world units (docs/decisions/0019)."""
        return min(NEAR, self.extent / NEARS)


def _shows_much(view: View, points: Float64, views: Sequence[View]) -> bool:
    """True if a far camera is a part of the capture, as in another room: its picture has points in a fair part of it,
    or without points GROUP other cameras are nearer to it than half of all are to their middle."""
    if len(points):
        rows, columns, _ = pixels_of(points, view.camera, view.lens)
        if len(rows) < LEAST_SHOWN:
            return False
        sides = np.std(rows) / view.camera.height, np.std(columns) / view.camera.width
        return bool(max(sides) > SHOWN_PART)
    centres = np.stack([each.camera.position for each in views])
    usual = float(np.median(np.linalg.norm(centres - np.median(centres, axis=0), axis=1)))
    near = np.linalg.norm(centres - view.camera.position, axis=1) < usual
    return int(near.sum()) > GROUP


def _has_alpha(image: Float32) -> bool:
    """True if a picture with a mask is not opaque wherever it counts."""
    return bool((image[:, :, 3] < image[:, :, 4]).any())


def _digest(view: View) -> str | None:
    own = short_digest(view.path)
    if view.mask is not None:
        own = f"{own} {view.mask.use} {view.mask.path and short_digest(view.mask.path)}"
    return own if view.depth is None else f"{own} depth {view.depth.digest}"
