# SPDX-License-Identifier: Apache-2.0
"""The contents of a data set's files, whatever its layout: images with their lenses and poses, and points. The pinhole
camera that stands in for each lens, and the resampling between the two.

The models and their formulas are COLMAP's, evaluated by pycolmap (`Camera.img_from_cam`, `undistort_camera`).
"""

from __future__ import annotations

import math
from collections.abc import Iterable
from dataclasses import dataclass, field, replace
from functools import cache
from pathlib import Path

import numpy as np
from numpy.typing import NDArray
from scipy import ndimage

from clsplat.arrays import Float32, Float64
from clsplat.camera import Camera
from clsplat.config.training import Lenses
from clsplat.errors import InputError, examples
from clsplat.images.alpha import associate, unassociate
from clsplat.images.reading import downscale
from clsplat.process import undisturbed

with undisturbed():  # it says of a Ctrl-C that it is not installed, and puts a handler of SIGTERM that prints its stack
    import pycolmap


RADIAL: dict[str, int] = {
    "SIMPLE_FISHEYE": 0,
    "FISHEYE": 0,
    "SIMPLE_RADIAL_FISHEYE": 1,
    "RADIAL_FISHEYE": 2,
    "OPENCV_FISHEYE": 4,
}
"""Models of fisheyes that a camera can be without undistortion, and their numbers of coefficients."""
PANORAMA = "EQUIRECTANGULAR"
TWO_FOCAL = {
    "SIMPLE_PINHOLE": ("PINHOLE", 0),
    "SIMPLE_RADIAL": ("OPENCV", 4),
    "RADIAL": ("OPENCV", 4),
    "SIMPLE_DIVISION": ("DIVISION", 1),
    "SIMPLE_FISHEYE": ("FISHEYE", 0),
    "SIMPLE_RADIAL_FISHEYE": ("OPENCV_FISHEYE", 4),
    "RADIAL_FISHEYE": ("OPENCV_FISHEYE", 4),
}
"""Models with one focal length: that which has two, and its number of coefficients, of which these have the first."""

MAX_SIZE = 1 << 20
"""Pixels a side; larger is a damaged file. Also keeps width times height far from overflow."""
MAX_NUMBER = 1e30
"""Coordinates beyond it are damage; their squares are still finite."""
SHORTEST = 1 / 20
"""Focal length, in the picture's longer side, under which no lens is: a fisheye of 220 degrees has 1/4."""
SMALLEST = 16
"""Pixels of the shorter side from which on a principal point in the first pixel is odd."""


@cache
def models() -> dict[int, tuple[str, int]]:
    """Name and number of parameters of each camera model that pycolmap knows, by COLMAP's id."""
    known = {}
    for name, member in pycolmap.CameraModelId.__members__.items():
        if int(member) >= 0:
            camera = pycolmap.Camera.create_from_model_name(1, name, 1.0, 1, 1)
            known[int(member)] = (name, len(camera.params))
    return known


@dataclass(frozen=True)
class Lens:
    """Intrinsics of the camera that took a picture.

    model: COLMAP's name; width, height: pixels; params: COLMAP's, in its order, focal lengths and principal point in
    pixels, the first pixel's centre at (0.5, 0.5).
    """

    model: str
    width: int
    height: int
    params: tuple[float, ...]

    @property
    def is_pinhole(self) -> bool:
        """True if pictures can be used as they are; distorted models whose coefficients are all 0 count too."""
        if self.model in ("PINHOLE", "SIMPLE_PINHOLE"):
            return True
        camera = self._camera()
        bends = self.model in ("FOV", "EUCM", PANORAMA) or "FISHEYE" in self.model
        return not bends and not any(self.params[index] for index in camera.extra_params_idxs())

    @property
    def focal(self) -> float:
        """The shortest focal length in pixels."""
        return min(float(self.params[index]) for index in self._camera().focal_length_idxs())

    @property
    def centre(self) -> tuple[float, float]:
        """The principal point in pixels."""
        x, y = (self.params[index] for index in self._camera().principal_point_idxs())
        return x, y

    def pinhole(self, rotation: Float64, translation: Float64) -> Camera:
        """The pinhole camera that the picture becomes once undistorted, with the pose of the original.

        Its size and focal length are those of COLMAP's image undistorter: focal length kept, and cropped so that no
        pixel lies outside the source picture, where that leaves at least a fifth of its size. A fisheye of 180
        degrees or more keeps about its picture's size and loses what lies beyond: no pinhole holds it.
        """
        camera = self._camera()
        if not self.is_pinhole:
            camera = pycolmap.undistort_camera(pycolmap.UndistortCameraOptions(), camera)
        return Camera(
            width=int(camera.width),
            height=int(camera.height),
            fx=float(camera.focal_length_x),
            fy=float(camera.focal_length_y),
            cx=float(camera.principal_point_x),
            cy=float(camera.principal_point_y),
            rotation=rotation,
            translation=translation,
        )

    def camera(self, rotation: Float64, translation: Float64, lenses: Lenses) -> Camera:
        """The camera that its pictures are trained with: itself where that is a panorama, or a fisheye that is left as
        it is, else `pinhole`."""
        of = self._camera()
        if self.model == PANORAMA:
            fx, fy, cx, cy = self.width / math.tau, self.height / math.pi, self.width / 2, self.height / 2
            where = (self.width, self.height, fx, fy, cx, cy, rotation, translation)
            return Camera(*where, projection="equirectangular")
        if lenses == "undistort" or self.model not in RADIAL:
            return self.pinhole(rotation, translation)
        given = [self.params[index] for index in of.extra_params_idxs()]
        radial = (*given, *[0.0] * (4 - len(given)))
        focal, centre = (of.focal_length_x, of.focal_length_y), (of.principal_point_x, of.principal_point_y)
        where = (self.width, self.height, *focal, *centre, rotation, translation)
        return Camera(*where, projection="fisheye", radial=radial)

    def bare(self, rotation: Float64, translation: Float64) -> Camera:
        """The pinhole camera of its size, focal lengths and principal point, as if it did not bend."""
        of = self._camera()
        focal, centre = (of.focal_length_x, of.focal_length_y), (of.principal_point_x, of.principal_point_y)
        return Camera(self.width, self.height, *focal, *centre, rotation, translation)

    def resized(self, width: int, height: int) -> Lens:
        """The same lens on another pixel grid; where that is uneven, of the model with two focal lengths."""
        if self.model == PANORAMA:
            return Lens(self.model, width, height, (float(width), float(height)))
        sx, sy = width / self.width, height / self.height
        if self.model in TWO_FOCAL and abs(sx - sy) * max(self.width, self.height) > 1:
            model, rest = TWO_FOCAL[self.model]
            coefficients = [*self.params[3:], *[0.0] * rest][:rest]
            both = (self.params[0], *self.params[:3], *coefficients)
            return replace(self, model=model, params=both).resized(width, height)
        camera = self._camera()
        params = list(self.params)
        focal, principal = list(camera.focal_length_idxs()), list(camera.principal_point_idxs())
        for indices in (focal, principal):
            for index, scale in zip(indices, (sx, sy) if len(indices) == 2 else (math.sqrt(sx * sy),), strict=True):
                params[index] *= scale
        return replace(self, width=width, height=height, params=tuple(params))

    def refocused(self, log: float, x: float, y: float) -> Lens:
        """The same lens, changed as `Camera.refocused` changes a camera."""
        camera, params = self._camera(), list(self.params)
        shift = (x * camera.focal_length_x, y * camera.focal_length_y)
        for index, by in zip(camera.principal_point_idxs(), shift, strict=True):
            params[index] += by
        for index in camera.focal_length_idxs():
            params[index] *= math.exp(log)
        return replace(self, params=tuple(params))

    def img_from_cam(self, points: Float64) -> Float64:
        """Project points (N, 3) in camera space to pixels (N, 2); NaN where the model has no image of them."""
        return np.asarray(self._camera().img_from_cam(np.ascontiguousarray(points, np.float64)))

    def cam_from_img(self, pixels: Float64) -> Float64:
        """Where the rays of pixels (N, 2) meet the plane z = 1, (N, 2); NaN where the model has none."""
        return np.asarray(self._camera().cam_from_img(np.ascontiguousarray(pixels, np.float64)))

    def _camera(self) -> pycolmap.Camera:
        camera = pycolmap.Camera(model=self.model, width=self.width, height=self.height, params=list(self.params))
        camera.camera_id = 1
        return camera


@dataclass(frozen=True, eq=False)
class PosedImage:
    """An image of a data set: its name, its lens at the listed size, and `cam_from_world`.

    rotation (3, 3), translation (3,), float64; path: the file, where the data set says which; split: "train", "test",
    or None where the data set has no split of its own; mask, depth: the files of its mask and its depth map, where the
    data set says which; listed: the name that it has in the data set, if the file has another.
    """

    name: str
    lens: Lens
    rotation: Float64
    translation: Float64
    path: Path = Path()
    split: str | None = None
    mask: Path | None = None
    depth: Path | None = None
    listed: str = ""

    @property
    def rank(self) -> str:
        """The name by which the split counts."""
        return self.listed or self.name


@dataclass(eq=False)
class DataSet:
    """points (N, 3) float64 in the world; colors (N, 3) float32 in [0, 1]; box: instant-ngp's volume, the corners
    (low, high), world units, or None; missing: names of pictures that are listed and left out, as they are not there;
    clouds: files of points that the data set does not name, the first to be taken where there are no points."""

    images: list[PosedImage]
    points: Float64 = field(default_factory=lambda: np.empty((0, 3)))
    colors: Float32 = field(default_factory=lambda: np.empty((0, 3), np.float32))
    box: tuple[Float64, Float64] | None = None
    missing: list[str] = field(default_factory=list)
    clouds: list[Path] = field(default_factory=list)


def check_lens(lens: Lens, where: str) -> Lens:
    """`lens` itself; raises InputError, beginning with `where`, for one that cannot be used."""
    counts = dict(models().values())
    if lens.model not in counts:
        listed = ", ".join(counts)
        raise InputError(f"{where}: unknown camera model {lens.model}, expected one of {listed}")
    if len(lens.params) != counts[lens.model]:
        raise InputError(
            f"{where}: {lens.model} has {len(lens.params)} parameters, expected {counts[lens.model]}; export it again"
        )
    if not (0 < lens.width <= MAX_SIZE and 0 < lens.height <= MAX_SIZE):
        raise InputError(f"{where}: image size {lens.width} x {lens.height}, expected 1 to {MAX_SIZE} pixels a side")
    if lens.model == PANORAMA:
        if list(lens.params) != [lens.width, lens.height]:
            sides = f"{lens.width} {lens.height}"
            raise InputError(
                f"{where}: parameters {list(lens.params)}, expected its size, {sides}, of a whole panorama"
            )
        return lens
    camera = lens._camera()  # noqa: SLF001
    focal = [lens.params[index] for index in camera.focal_length_idxs()]
    if not all(math.isfinite(value) for value in lens.params) or min(focal) <= 0:
        raise InputError(f"{where}: parameters {list(lens.params)}, expected finite ones, focal lengths above 0")
    return lens


def in_pixels(lens: Lens) -> tuple[Lens, bool]:
    """The lens in pixels, and whether it was given in parts of the picture's width and height: a principal point in the
    first pixel is none of a photograph, and one in the middle is 0.5 0.5 in parts. Focal lengths then are in parts too
    if they are under SHORTEST of the picture."""
    camera = lens._camera()  # noqa: SLF001
    sides, params = (lens.width, lens.height), list(lens.params)
    centre = list(camera.principal_point_idxs())
    if lens.model == PANORAMA or min(sides) < SMALLEST or not all(0 < params[index] <= 1 for index in centre):
        return lens, False
    focal = list(camera.focal_length_idxs())
    if all(params[index] < SHORTEST * max(sides) for index in focal):
        given = [params[index] for index in focal]
        alike = len(given) == 2 and abs(given[0] / given[1] - 1) < abs(given[0] * sides[0] / given[1] / sides[1] - 1)
        by = (sides[0],) * 2 if alike else sides  # both by the width, as pixels are square
        for index, side in zip(focal, by if len(focal) == 2 else (max(sides),), strict=True):
            params[index] *= side
    for index, side in zip(centre, sides, strict=True):
        params[index] *= side
    return replace(lens, params=tuple(params)), True


def given_in_parts(names: Iterable[object]) -> str:
    """The warning of cameras of these names whose lenses `in_pixels` has changed."""
    return (
        f"the principal point (cx cy) of {examples(names)} is given in parts of the picture's width and height and not "
        "in pixels; it is read so, and focal lengths of under a twentieth of the picture with it"
    )


def pixels_of(
    points: Float64, camera: Camera, lens: Lens | None = None
) -> tuple[NDArray[np.int64], NDArray[np.int64], NDArray[np.bool_]]:
    """Rows and columns of the pixels that show the points (N, 3) of the world, of those before the camera and in its
    picture, which are `inside` (N,). lens: of a camera that is no pinhole."""
    local = points @ camera.rotation.T + camera.translation
    if lens is not None and camera.projection != "perspective":
        place = lens.resized(camera.width, camera.height).img_from_cam(local)
        angle = np.arctan2(np.hypot(local[:, 0], local[:, 1]), local[:, 2])
        ahead = (np.linalg.norm(local, axis=1) > camera.near) & (angle <= camera.fold[0])
        with np.errstate(invalid="ignore"):
            shown = ahead & ((place >= 0) & (place < [camera.width, camera.height])).all(axis=1)
        return place[shown, 1].astype(np.int64), place[shown, 0].astype(np.int64), shown
    depth = local[:, 2]
    ahead = depth > camera.near
    by = np.where(ahead, depth, 1.0)
    x, y = camera.fx * local[:, 0] / by + camera.cx, camera.fy * local[:, 1] / by + camera.cy
    inside = ahead & (x >= 0) & (x < camera.width) & (y >= 0) & (y < camera.height)
    return y[inside].astype(np.int64), x[inside].astype(np.int64), inside


def depths_of(points: Float64, camera: Camera) -> Float64:
    """(N,) depths along the axis of points (N, 3) of the world, of a camera that is no pinhole distances."""
    local = points @ camera.rotation.T + camera.translation
    return np.asarray(local[:, 2] if camera.projection == "perspective" else np.linalg.norm(local, axis=1))


def nearest_around(rows: NDArray[np.int64], columns: NDArray[np.int64], depths: Float64, cell: float) -> Float64:
    """(N,) least depth of the points that lie in the same cell of a picture, of `cell` pixels a side, as each."""
    across, down = (columns // cell).astype(np.int64), (rows // cell).astype(np.int64)
    cells = down * (across.max(initial=0) + 1) + across
    nearest = np.full(cells.max(initial=0) + 1, np.inf)
    np.minimum.at(nearest, cells, depths)
    return np.asarray(nearest[cells])


def undistort(image: Float32, lens: Lens, camera: Camera) -> Float32:
    """Resample a picture (H, W, C) taken through `lens` to what `camera` sees from the same place.

    Where `camera` is less than 3/4 as fine, at the lens's own scale first, bilinearly, then by area; else with a
    cubic spline that is held within the values of the picture. Straight alpha in and out. Pixels that the picture
    does not reach (none for `Lens.pinhole`, extreme fisheyes aside) repeat its border.
    """
    natural = lens.pinhole(camera.rotation, camera.translation)
    shrinks = camera.width < 0.75 * natural.width
    grid = camera.resized(natural.width, natural.height) if shrinks else camera
    x, y = np.meshgrid(
        (np.arange(grid.width) + 0.5 - grid.cx) / grid.fx, (np.arange(grid.height) + 0.5 - grid.cy) / grid.fy
    )
    rays = np.stack([x.ravel(), y.ravel(), np.ones(x.size)], axis=1)
    pixels = lens.img_from_cam(rays) - 0.5  # the centre of the first pixel is sample 0
    far = 2.0 * max(lens.width, lens.height)
    pixels = np.clip(np.nan_to_num(pixels, nan=far), -far, far)
    coordinates = pixels[:, ::-1].T.reshape(2, grid.height, grid.width)

    has_alpha = image.shape[2] == 4
    source = associate(image) if has_alpha else image
    result = np.empty((grid.height, grid.width, source.shape[2]), np.float32)
    for channel in range(source.shape[2]):
        plane = np.ascontiguousarray(source[:, :, channel])
        ndimage.map_coordinates(plane, coordinates, result[:, :, channel], order=1 if shrinks else 3, mode="nearest")
        np.clip(result[:, :, channel], plane.min(), plane.max(), out=result[:, :, channel])
    if has_alpha:
        result = unassociate(result)
    return downscale(result, camera.width, camera.height)
