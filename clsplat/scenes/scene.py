# SPDX-License-Identifier: Apache-2.0
"""Scenes: views (photographs with cameras) and points."""

from __future__ import annotations

import os
from collections.abc import Callable, Sequence
from concurrent.futures import ThreadPoolExecutor
from dataclasses import dataclass, field, replace
from functools import cached_property
from pathlib import Path
from typing import Literal, TypeVar

import numpy as np
from numpy.typing import NDArray

from clsplat.arrays import Float32, Float64
from clsplat.camera import DEFAULT_NEAR_PLANE, MIN_SIZE_IN_NEAR_PLANES, Camera
from clsplat.config.depth import NO_DEPTH, DepthUse
from clsplat.config.points import SCENE_POINTS_ONLY, StartPoints
from clsplat.config.training import MANY_PHOTOGRAPHS
from clsplat.errors import InputError, reason_of
from clsplat.files.documents import short_digest
from clsplat.images.reading import downscale, read_image
from clsplat.scenes.dataset import SOURCE_FRAME, Lens, SceneFrame, pixels_of, undistort
from clsplat.scenes.geography.georeference import Georeference
from clsplat.scenes.outliers import stray_cameras
from clsplat.scenes.supervision.depth_samples import KnownDepth
from clsplat.scenes.supervision.masks import MASK_THRESHOLD, Mask
from clsplat.scenes.supervision.region_mask import RegionMask
from clsplat.scenes.thumbnail import Thumbnail, thumbnail_of

Split = Literal["train", "test"]
FileStamp = tuple[int, int]
"""Size of a file in bytes, and its modification time in nanoseconds."""
T = TypeVar("T")

FAR_ORIGIN_RATIO = 64.0
"""Least distance of a scene from the world's origin, in scene sizes, at which means are relative to the scene's middle.

At this distance float32 resolves 64 * 2^-24 of the scene's size, or 1 % of a pixel if the scene is 2600 pixels wide.
"""
MIN_POINTS_IN_FAR_VIEW, MIN_POINT_SPREAD_IN_FAR_VIEW = 10, 0.08
"""A distant camera is not an outlier if its picture shows at least this many points, spread at least this far. The
spread is the standard deviation of the points' pixels, as a fraction of the width or height.

Such a picture shows the scene from further away, or another reconstructed part of it. Points all over the picture have
a standard deviation of 0.29. The picture of an outlier shows no points, or has every point in one pixel.
"""
MIN_FAR_GROUP_NEIGHBOURS = 2
"""In a scene without points, a distant camera is not an outlier if at least this many other cameras are near it."""
MAX_SAMPLED_PHOTOGRAPHS = 200
"""Maximum number of photographs that findings (`scenes.analysis`) are based on, if they are not all decoded before
training."""
SAME_PLACE_TOLERANCE = 1e-12
"""Cameras are in one place if none is farther from their middle than this fraction of their largest coordinate."""


@dataclass(frozen=True, eq=False)
class View:
    """A photograph and its camera.

    name: name in the data set, with extension, unique in the scene.
    camera: the photograph's camera at the working size.
    path: the photograph's file.
    split: "train" or "test".
    lens: the lens that took the file, at the file's size.
    upright: True if the camera fits the picture after rotation by its EXIF orientation, False if it fits the stored
        picture.
    mask: mask of the pixels that training uses; None if all pixels are used.
    depth_file: the depth map that the data set names, if any.
    depth: known depths for training.
    stamps: size in bytes and modification time in nanoseconds of each of `files` when the scene was loaded; () if
        unknown.
    region_mask: pixels that show the region of a training; None for all. The training's decoder applies it, in addition
        to the mask, and `load` does not.
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
    stamps: tuple[FileStamp, ...] = ()
    region_mask: RegionMask | None = None

    @property
    def files(self) -> tuple[Path, ...]:
        """Files that the pixels come from: the photograph, and its mask if it has one."""
        return (self.path,) if self.mask is None or self.mask.path is None else (self.path, self.mask.path)

    @property
    def ignores(self) -> bool:
        """True if training may ignore pixels of the photograph."""
        return self.region_mask is not None or (self.mask is not None and self.mask.ignores)

    def stamped(self) -> View:
        """Return the view with its files' current sizes and modification times. Raises OSError for a missing file."""
        return replace(self, stamps=tuple(_stamp(path) for path in self.files))

    def check_unchanged(self) -> None:
        """Raise InputError if a file has been removed or replaced since the scene was loaded."""
        for path, stamp in zip(self.files, self.stamps, strict=False):
            try:
                now = _stamp(path)
            except OSError as error:
                raise InputError(
                    f"{path}: could be read when the scene was loaded, but not now: {reason_of(error)}; put it back"
                ) from None
            if now != stamp:
                raise InputError(f"{path}: has been changed or replaced since the scene was loaded; load it again")

    def load(self, width: int | None = None, height: int | None = None) -> Float32:
        """Read the undistorted pixels at the camera's size: float32 (H, W, 3), or (H, W, 4) with straight alpha.

        width, height: size in pixels to use instead of the camera's.
        Reads the file in every call. Pixels that a mask leaves out are black or transparent. Raises InputError if the
        file does not decode or its size has changed.
        """
        image = self.load_masked(width, height)
        return image if image.shape[2] < 5 else np.ascontiguousarray(image[:, :, : 3 + _has_alpha(image)])

    def load_masked(self, width: int | None = None, height: int | None = None) -> Float32:
        """Read like `load`. If a mask leaves pixels out, there is a fifth channel: 1 for kept pixels, else 0.

        A resized pixel is kept if the mask keeps at least half of its area. Its colour is the mean over this part.
        """
        return self.load_sizes([(width or self.camera.width, height or self.camera.height)])[0]

    def load_sizes(self, sizes: Sequence[tuple[int, int]], *, reduce: bool = False) -> list[Float32]:
        """Read like `load_masked` at several sizes, (width, height), decoding the file only once.

        reduce: resample the picture to the camera's size first, and from this to each size. This is faster; results
        differ by rounding. Pictures with masked pixels are always resampled from the file's size.
        """
        image, counts = self._read(), None
        if self.mask is not None:
            image, counts = self.mask.applied(image, orient=self.upright)
        if counts is not None:
            return [self._masked(image, counts, width, height) for width, height in sizes]
        if reduce:
            full = self._fitted(image, self.camera.width, self.camera.height)
            return [downscale(full, width, height) for width, height in sizes]
        return [self._fitted(image, width, height) for width, height in sizes]

    def _masked(self, image: Float32, counts: Float32, width: int, height: int) -> Float32:
        """Resample a picture (H, W, 3 or 4) to `width` x `height` pixels, with five channels as from `load_masked`.

        counts: (H, W, 1), the mask: 1 for kept pixels, else 0.
        """
        parts = [np.where(counts > 0, image[:, :, :3], np.float32(0)), counts]
        if image.shape[2] == 4:  # alpha is averaged over kept pixels only, like a colour
            there = np.where(counts > 0, image[:, :, 3:], np.float32(0))
            alpha = self._fitted(np.concatenate([there, there, there, counts], axis=2), width, height)
            parts[0] = parts[0] * there
        scaled = self._fitted(np.concatenate(parts, axis=2), width, height)
        whole = scaled[:, :, 3:] >= MASK_THRESHOLD
        opacity = np.clip(alpha[:, :, :1], 0, 1) if image.shape[2] == 4 else np.ones_like(scaled[:, :, :1])
        colour = scaled[:, :, :3] / np.where(opacity > 0, opacity, np.float32(1))
        result = np.concatenate([colour, opacity, np.ones_like(opacity)], axis=2)
        return np.ascontiguousarray(np.where(whole, result, np.float32(0)), np.float32)

    def _fitted(self, image: Float32, width: int, height: int) -> Float32:
        if self.lens.is_pinhole or not self.camera.is_pinhole:
            return downscale(image, width, height)
        return undistort(image, self.lens, self.camera.resized(width, height))

    def check(self) -> Thumbnail:
        """Decode the picture and return its thumbnail. Raises InputError if `load` would."""
        image = self._read()
        if self.mask is not None:
            self.mask.applied(image, orient=self.upright)
        return thumbnail_of(image)

    def _read(self) -> Float32:
        image = read_image(self.path, orient=self.upright)
        if image.shape[:2] != (self.lens.height, self.lens.width):
            actual = f"{image.shape[1]}x{image.shape[0]}"
            raise InputError(
                f"{self.path}: now has {actual} pixels, expected {self.lens.width}x{self.lens.height} as when the "
                "scene was loaded; load it again"
            )
        return image


@dataclass(eq=False)
class Scene:
    """A scene to train on.

    name: the folder's name.
    views: sorted by name.
    points: (N, 3) float64, world coordinates; N may be 0.
    point_colors: (N, 3) float32 in [0, 1].
    bounds: corners (low, high) of the box for random initial points, each (3,) float64, in world units.
    warnings: messages for the user, one line each.
    start: settings by which `points` were chosen for the start of training (`scenes.start.point_cloud`).
    colourless: (N,), True for points that get their colours from photographs; None if no point does.
    source: the folder from which the scene was read.
    depth_use: settings by which known depths were added (`scenes.depth_sources`).
    clouds: point files next to the scene that are not used.
    missing: names of listed pictures that do not exist.
    unit: the length unit in world units (`scenes.depth_sources`); None for the extent.
    frame: the frame of the scene, relative to the frame that its cameras had first.
    world_from_files: (4, 4), the similarity from the frame of the scene's files to the scene's; None if they are equal.
    file_unit: length of a unit of the scene's files, in world units.
    georeference: where the scene lies on the earth; None if it is unknown.
    whole_extent: extent of the scene that this is a part of; None if it is no part.
    """

    name: str
    views: list[View]
    points: Float64
    point_colors: Float32
    bounds: tuple[Float64, Float64]
    warnings: list[str] = field(default_factory=list)
    start: StartPoints = SCENE_POINTS_ONLY
    colourless: NDArray[np.bool_] | None = None
    source: Path | None = None
    depth_use: DepthUse = NO_DEPTH
    clouds: tuple[Path, ...] = ()
    missing: tuple[str, ...] = ()
    unit: float | None = None
    frame: SceneFrame = SOURCE_FRAME
    world_from_files: Float64 | None = None
    file_unit: float = 1.0
    georeference: Georeference | None = None
    whole_extent: float | None = None

    @cached_property
    def train_views(self) -> list[View]:
        """Training views, sorted by name."""
        return [view for view in self.views if view.split == "train"]

    @cached_property
    def test_views(self) -> list[View]:
        """Held-out views, sorted by name."""
        return [view for view in self.views if view.split == "test"]

    def require_training_views(self) -> list[View]:
        """Return the training views. Raises InputError if there are none."""
        if not self.train_views:
            count = len(self.views)
            raise InputError(f"{self.name}: all {count} views are held out; use --test-every 0 to hold out none")
        return self.train_views

    @property
    def decoded_first(self) -> bool:
        """True if every picture is decoded before training. In scenes of MANY_PHOTOGRAPHS training views or more, each
        picture is decoded when a step first needs it instead."""
        return len(self.train_views) < MANY_PHOTOGRAPHS

    @cached_property
    def sampled_views(self) -> list[View]:
        """Views that findings (`scenes.analysis`) are based on: all, or in large scenes a sample of training views."""
        if self.decoded_first:
            return self.views
        count = min(MAX_SAMPLED_PHOTOGRAPHS, len(self.train_views))
        return [self.train_views[index * len(self.train_views) // count] for index in range(count)]

    def check_pictures(self) -> None:
        """Decode every picture once, so that a truncated one is reported before training.

        Sets `digests` and `thumbnails`. In scenes whose pictures are decoded during training (`decoded_first`), sets
        only `digests`. Raises InputError for the first picture, in the order of names, that does not decode.
        """
        if not self.decoded_first:
            self.__dict__["digests"] = self._of_each(_digest, self.views)
            return
        found = self._of_each(lambda view: (_digest(view), view.check()), self.views)
        self.__dict__["digests"] = {name: digest for name, (digest, _) in found.items()}
        self.__dict__["thumbnails"] = {name: thumbnail for name, (_, thumbnail) in found.items()}

    @cached_property
    def thumbnails(self) -> dict[str, Thumbnail]:
        """Thumbnail of each sampled view's picture, by view name. Raises InputError if a picture does not decode."""
        return self._of_each(View.check, self.sampled_views)

    @cached_property
    def digests(self) -> dict[str, str | None]:
        """Digest of each view's file, mask and known depths, by view name."""
        return self._of_each(_digest, self.views)

    def _of_each(self, work: Callable[[View], T], views: Sequence[View]) -> dict[str, T]:
        with ThreadPoolExecutor(os.cpu_count()) as pool:
            try:
                return {view.name: result for view, result in zip(views, pool.map(work, views), strict=True)}
            finally:
                pool.shutdown(cancel_futures=True)

    @cached_property
    def origin(self) -> Float64:
        """Point (3,) in the world to which the means of a model of this scene are relative.

        It is 0 unless the scene is far from the world's origin. Then it is the middle of the cameras without outliers,
        rounded to a multiple of about the scene's size.
        """
        centres = np.stack([view.camera.position for view in self.views if view.name not in self.stray_cameras])
        middle = centres.mean(axis=0)
        size = float(np.linalg.norm(centres - middle, axis=1).max())
        if len(self.points):
            size = max(size, float(np.median(np.linalg.norm(self.points - middle, axis=1))))
        if size == 0 or np.linalg.norm(middle) < FAR_ORIGIN_RATIO * size:
            return np.zeros(3)
        step = 2.0 ** np.ceil(np.log2(size))
        return np.asarray(np.round(middle / step) * step)

    @cached_property
    def stray_cameras(self) -> frozenset[str]:
        """Names of the views whose cameras are outliers, far from the other cameras and from the points.

        A distant camera is not an outlier if its picture shows points over a sufficient part of its area. In scenes
        without points, a distant camera is not an outlier if other cameras are near it.
        """
        centres = np.stack([view.camera.position for view in self.views])
        middle = np.median(centres, axis=0)
        away = float(np.median(np.linalg.norm(self.points - middle, axis=1))) if len(self.points) else 0.0
        far = stray_cameras([view.camera for view in self.views], away)
        found = [view for view, stray in zip(self.views, far, strict=True) if stray]
        return frozenset(view.name for view in found if not _shows_much(view, self.points, self.views))

    @cached_property
    def spread(self) -> tuple[Float64, float, float]:
        """Middle of the training cameras without outliers, distance of the farthest camera from there, and largest
        coordinate of the cameras."""
        near = [view for view in self.train_views if view.name not in self.stray_cameras]
        centres = np.stack([view.camera.position for view in near or self.train_views or self.views])
        middle: Float64 = centres.mean(axis=0)
        return middle, float(np.linalg.norm(centres - middle, axis=1).max()), float(np.abs(centres).max())

    @property
    def in_one_place(self) -> bool:
        """True if all training cameras are in one place, up to rounding."""
        _, spread, largest = self.spread
        return spread <= SAME_PLACE_TOLERANCE * largest

    @cached_property
    def extent(self) -> float:
        """The scene's size in world units, as cameras_extent in the 3DGS authors' code.

        It is 1.1 times the distance of the farthest training camera from the cameras' mean, without outliers. If all
        cameras are in one place, it is the median distance of the points from there, or 1 without points. A part of a
        scene has the extent of the whole.
        """
        if self.whole_extent is not None:
            return self.whole_extent
        middle, spread, _ = self.spread
        if not self.in_one_place:
            return 1.1 * spread
        return (float(np.median(np.linalg.norm(self.points - middle, axis=1))) if len(self.points) else 0.0) or 1.0

    @property
    def length_unit(self) -> float:
        """Length in world units for learning rates and sizes of Gaussians: `unit` if it is set, else `extent`."""
        return self.extent if self.unit is None else self.unit

    @property
    def unit_differs(self) -> bool:
        """True if the length unit is not the extent."""
        return self.length_unit != self.extent

    @property
    def near(self) -> float:
        """Near plane, in world units, of a model that is trained on this scene (docs/decisions/0019)."""
        return min(DEFAULT_NEAR_PLANE, self.length_unit / MIN_SIZE_IN_NEAR_PLANES)


def spread(items: Sequence[T], most: int) -> list[T]:
    """Return at most `most` of the items, evenly spaced from the first to the last."""
    picked = min(len(items), most)
    return [items[index * (len(items) - 1) // max(picked - 1, 1)] for index in range(picked)]


def _shows_much(view: View, points: Float64, views: Sequence[View]) -> bool:
    """Return True if a distant camera is not an outlier but part of the capture, for example in another room.

    The picture must show points over a sufficient part of its area. Without points, at least MIN_FAR_GROUP_NEIGHBOURS
    other cameras must be nearer to the camera than the median distance of all cameras from their middle.
    """
    if len(points):
        rows, columns, _ = pixels_of(points, view.camera, view.lens)
        if len(rows) < MIN_POINTS_IN_FAR_VIEW:
            return False
        sides = np.std(rows) / view.camera.height, np.std(columns) / view.camera.width
        return bool(max(sides) > MIN_POINT_SPREAD_IN_FAR_VIEW)
    centres = np.stack([each.camera.position for each in views])
    usual = float(np.median(np.linalg.norm(centres - np.median(centres, axis=0), axis=1)))
    near = np.linalg.norm(centres - view.camera.position, axis=1) < usual
    return int(near.sum()) > MIN_FAR_GROUP_NEIGHBOURS


def _stamp(path: Path) -> FileStamp:
    status = path.stat()
    return status.st_size, status.st_mtime_ns


def _has_alpha(image: Float32) -> bool:
    """Return True if a masked picture (H, W, 5) is transparent in a pixel that the mask keeps."""
    return bool((image[:, :, 3] < image[:, :, 4]).any())


def _digest(view: View) -> str | None:
    own = short_digest(view.path)
    if view.mask is not None:
        own = f"{own} {view.mask.use} {view.mask.path and short_digest(view.mask.path)}"
    return own if view.depth is None else f"{own} depth {view.depth.digest}"
