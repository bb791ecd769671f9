# SPDX-License-Identifier: Apache-2.0
"""Contents of a data set in any layout: images with lenses and poses, points, and their frame; and undistortion.

The camera models and their formulas are COLMAP's, evaluated by pycolmap (`Camera.img_from_cam`, `undistort_camera`).
"""

from __future__ import annotations

import json
import math
from collections.abc import Iterable
from dataclasses import dataclass, field, replace
from functools import cache
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import NDArray

from clsplat.arrays import Float32, Float64
from clsplat.camera import CAMERA_MODELS, Camera
from clsplat.cameras.model import CameraModel, LensModel
from clsplat.config.training import Lenses
from clsplat.errors import InputError, examples
from clsplat.images.alpha import associate, unassociate
from clsplat.images.reading import downscale
from clsplat.process import undisturbed
from clsplat.scenes.geography.georeference import Georeference

# If Ctrl-C interrupts its import, pycolmap says that it is not installed. It also sets a SIGTERM handler that prints a
# stack trace. `undisturbed` prevents both.
with undisturbed():
    import pycolmap

MAX_IMAGE_SIDE_PX = 1 << 20
"""Maximum width or height in pixels. Larger values indicate a damaged file, and width times height could overflow."""
MAX_COORDINATE = 1e30
"""Limit of coordinates in files, so that their squares are finite. Larger ones indicate a damaged file."""
MIN_FOCAL_PER_SIDE = 1 / 20
"""Minimum plausible focal length, as a fraction of the longer side. A fisheye of 220 degrees has 1/4."""
MIN_CENTRE_CHECK_SIDE_PX = 16
"""Minimum shorter side, in pixels, of pictures whose principal point is checked: it must not lie in the first pixel."""
POINTS_PER_OCCLUSION_CELL = 16
"""Mean number of points in an occlusion cell, a square of pixels in which the nearest point hides farther ones.

With fewer points, occluded points show through the gaps. With more, cells are so wide that they cover adjacent objects.
"""
MAX_OCCLUSION_CELL_FRACTION = 1 / 25
"""Maximum side of an occlusion cell, relative to the picture's longer side. It applies where there are few points."""


@cache
def colmap_camera_models() -> dict[int, tuple[str, int]]:
    """Return name and number of parameters of each camera model that pycolmap knows, such as PINHOLE. The keys
    are COLMAP's ids."""
    known = {}
    for name, member in pycolmap.CameraModelId.__members__.items():
        if int(member) >= 0:
            camera = pycolmap.Camera.create_from_model_name(1, name, 1.0, 1, 1)
            known[int(member)] = (name, len(camera.params))
    return known


@cache
def lens_models() -> dict[str, tuple[LensModel, CameraModel]]:
    """Return each lens model and the camera model that supports it (`CameraModel.lenses`). The keys are the lens
    models' names, such as COLMAP's OPENCV_FISHEYE."""
    return {lens.name: (lens, model) for model in CAMERA_MODELS for lens in model.lenses}


@dataclass(frozen=True)
class Lens:
    """Intrinsics of the camera that took a picture.

    model: COLMAP's name of the camera model.
    width, height: size of the picture in pixels.
    params: COLMAP's parameters in COLMAP's order. Focal lengths and principal point are in pixels; the centre of the
        first pixel is at (0.5, 0.5).
    """

    model: str
    width: int
    height: int
    params: tuple[float, ...]

    @property
    def native(self) -> CameraModel | None:
        """Camera model that renders through this fisheye or panorama lens; None for all other lenses."""
        camera_model = lens_models().get(self.model, (None, None))[1]
        return camera_model if camera_model is not None and not camera_model.is_pinhole else None

    @property
    def is_colmap(self) -> bool:
        """True if COLMAP has this model. The formulas of all other models are in `clsplat.cameras`."""
        return self.model not in lens_models() or lens_models()[self.model][0].is_colmap

    @property
    def is_panorama(self) -> bool:
        """True for panoramas, which no pinhole camera can show."""
        return self.native is not None and self.native.wraps

    @property
    def is_bent_by_design(self) -> bool:
        """True for fisheyes, panoramas and similar models, which bend straight lines even if all coefficients are 0."""
        return self.native is not None or self.model in ("FOV", "EUCM") or "FISHEYE" in self.model

    @property
    def is_pinhole(self) -> bool:
        """True if pictures need no undistortion: for pinhole models, and distortion models with all coefficients 0."""
        if self.model in ("PINHOLE", "SIMPLE_PINHOLE"):
            return True
        camera = self._camera()
        return not self.is_bent_by_design and not any(self.params[index] for index in camera.extra_params_idxs())

    @property
    def focal(self) -> float:
        """Shortest focal length in pixels."""
        return min(float(self.params[index]) for index in self._camera().focal_length_idxs())

    @property
    def centre(self) -> tuple[float, float]:
        """Principal point in pixels."""
        x, y = (self.params[index] for index in self._camera().principal_point_idxs())
        return x, y

    def pinhole(self, rotation: Float64, translation: Float64) -> Camera:
        """Return the pinhole camera of the undistorted picture, with the given pose.

        Size and focal length follow COLMAP's image undistorter. It keeps the focal length and crops so that no pixel
        lies outside the source picture, if this leaves at least a fifth of its size. The result for a fisheye of 180
        degrees or more has about the size of its picture, and lacks directions that no pinhole camera can show.
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
        """Return the camera for training, with the given pose.

        Panoramas keep their projection, and so do fisheyes if `lenses` is "native". For other lenses, this is the
        camera of `pinhole`.
        """
        native = self.native
        if native is None or (lenses == "undistort" and not native.wraps):
            return self.pinhole(rotation, translation)
        if native.wraps:
            whole = native.whole(self.width, self.height)
            return Camera(self.width, self.height, *whole, rotation, translation).through(native)
        count = lens_models()[self.model][0].coefficients
        given = [self.params[index] for index in self._camera().extra_params_idxs()][:count]
        return self.bare(rotation, translation).through(native, (*given, *[0.0] * (4 - count)))

    def bare(self, rotation: Float64, translation: Float64) -> Camera:
        """Return a pinhole camera with this lens's size, focal lengths and principal point, without its distortion."""
        of = self._camera()
        focal, centre = (of.focal_length_x, of.focal_length_y), (of.principal_point_x, of.principal_point_y)
        return Camera(self.width, self.height, *focal, *centre, rotation, translation)

    def resized(self, width: int, height: int) -> Lens:
        """Return the lens on another pixel grid, with two focal lengths if width and height scale differently."""
        if self.is_panorama:
            return Lens(self.model, width, height, (float(width), float(height)))
        sx, sy = width / self.width, height / self.height
        named, _ = lens_models().get(self.model, (LensModel(self.model), None))
        if named.two_focal_model and abs(sx - sy) * max(self.width, self.height) > 1:
            model, rest = named.two_focal_model, named.two_focal_coefficients
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
        """Return the lens with fx and fy multiplied by exp(log), cx moved by x * fx, and cy moved by y * fy.

        The shifts use fx and fy from before the multiplication.
        """
        camera, params = self._camera(), list(self.params)
        shift = (x * camera.focal_length_x, y * camera.focal_length_y)
        for index, by in zip(camera.principal_point_idxs(), shift, strict=True):
            params[index] += by
        for index in camera.focal_length_idxs():
            params[index] *= math.exp(log)
        return replace(self, params=tuple(params))

    def img_from_cam(self, points: Float64) -> Float64:
        """Project points (N, 3) in camera space to pixels (N, 2); NaN for points that the lens does not show."""
        if self.native is not None and not self.is_colmap:
            shown = self.camera(np.eye(3), np.zeros(3), "native")
            a, b, _ = self.native.places_of(shown, points)
            u = self.native.wrapped(shown, shown.cx + shown.fx * a)
            return np.stack([u, shown.cy + shown.fy * b], axis=1)
        return np.asarray(self._camera().img_from_cam(np.ascontiguousarray(points, np.float64)))

    def cam_from_img(self, pixels: Float64) -> Float64:
        """Return points (N, 2) where the rays of pixels (N, 2) meet the plane z = 1; NaN for pixels without a ray."""
        return np.asarray(self._camera().cam_from_img(np.ascontiguousarray(pixels, np.float64)))

    def _camera(self) -> pycolmap.Camera:
        # PINHOLE stands in for a lens that COLMAP lacks: only focal lengths and principal point are read from it.
        model = self.model if self.is_colmap else "PINHOLE"
        camera = pycolmap.Camera(model=model, width=self.width, height=self.height, params=list(self.params))
        camera.camera_id = 1
        return camera


@dataclass(frozen=True, eq=False)
class PosedImage:
    """An image of a data set: its name, its lens at the size that the data set gives, and the pose `cam_from_world`.

    rotation, translation: (3, 3) and (3,), float64.
    path: the file, if the data set names it.
    split: "train", "test", or None if the data set has no split of its own.
    mask, depth: files of the mask and the depth map, if the data set names them.
    listed: the name in the data set, if it differs from the file's name.
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
        """Name by which images are sorted before they are split into training and test images."""
        return self.listed or self.name


@dataclass(frozen=True, eq=False)
class SceneFrame:
    """The coordinate frame of a scene, relative to the source's: the frame that its cameras had first, as from COLMAP.

    world_from_source: (4, 4), similarity from the source's frame to the world.
    upright: True if the world's up is -y.
    metres: True if world units are metres.
    origin: latitude and longitude in degrees and altitude in metres of the world's origin; () if unknown. If known,
        the world's x axis points east, and z north.
    measured: the coordinates of two points that gave the scale, and the scale of world_from_source when they were
        measured; () if no points gave it.
    up_note, scale_note: sources of the up direction and the unit, for the user; "" if neither was set.
    """

    world_from_source: Float64 = field(default_factory=lambda: np.eye(4))
    upright: bool = False
    metres: bool = False
    origin: tuple[float, ...] = ()
    measured: tuple[float, ...] = ()
    up_note: str = ""
    scale_note: str = ""

    @property
    def notes(self) -> list[str]:
        """Sources of the axes and the unit, one line each."""
        return [note for note in (self.up_note, self.scale_note) if note]

    @property
    def is_source(self) -> bool:
        """True if the frame is the source's."""
        return np.array_equal(self.world_from_source, np.eye(4))

    def change_from(self, other: SceneFrame) -> Float64 | None:
        """Return the similarity (4, 4) from another frame of the same source to this one; None if they are equal."""
        if np.array_equal(self.world_from_source, other.world_from_source):
            return None
        return np.asarray(self.world_from_source @ np.linalg.inv(other.world_from_source))

    def document(self) -> dict[str, Any]:
        """Return the values of the frame's record, frame.json (`scenes.orientation.frame_record`)."""
        return {
            "clsplat_frame": 1,
            "world_from_source": self.world_from_source.tolist(),
            "upright": self.upright,
            "metres": self.metres,
            "origin": list(self.origin),
            "measured": list(self.measured),
            "up_note": self.up_note,
            "scale_note": self.scale_note,
        }

    def content(self) -> bytes:
        """Return the content of frame.json."""
        return (json.dumps(self.document(), indent=2) + "\n").encode()


SOURCE_FRAME = SceneFrame()
"""Frame of a scene that was neither turned nor scaled."""


@dataclass(eq=False)
class DataSet:
    """Images and points of a data set.

    points: (N, 3) float64, world coordinates.
    colors: (N, 3) float32 in [0, 1].
    box: corners (low, high) of instant-ngp's volume in world units; None for other data sets.
    missing: names of listed pictures that do not exist and are left out.
    clouds: point files that the data set does not name. The first one is used if `points` is empty.
    frame: the frame of the images and points.
    georeference: where the data set lies on the earth; None if its files do not say it.
    """

    images: list[PosedImage]
    points: Float64 = field(default_factory=lambda: np.empty((0, 3)))
    colors: Float32 = field(default_factory=lambda: np.empty((0, 3), np.float32))
    box: tuple[Float64, Float64] | None = None
    missing: list[str] = field(default_factory=list)
    clouds: list[Path] = field(default_factory=list)
    frame: SceneFrame = SOURCE_FRAME
    georeference: Georeference | None = None


def check_lens(lens: Lens, where: str) -> Lens:
    """Return `lens` unchanged. Raises InputError if its model, size or parameters are invalid.

    where: beginning of the error message.
    """
    counts = dict(colmap_camera_models().values())
    counts |= {name: 2 if model.wraps else 4 for name, (row, model) in lens_models().items() if not row.is_colmap}
    if lens.model not in counts:
        listed = ", ".join(counts)
        raise InputError(f"{where}: unknown camera model {lens.model}, expected one of {listed}")
    if len(lens.params) != counts[lens.model]:
        raise InputError(
            f"{where}: {lens.model} has {len(lens.params)} parameters, expected {counts[lens.model]}; export it again"
        )
    if not (0 < lens.width <= MAX_IMAGE_SIDE_PX and 0 < lens.height <= MAX_IMAGE_SIDE_PX):
        raise InputError(
            f"{where}: the image size is {lens.width}x{lens.height}, expected 1 to {MAX_IMAGE_SIDE_PX} pixels a side"
        )
    if lens.is_panorama:
        if list(lens.params) != [lens.width, lens.height]:
            sides = f"{lens.width} {lens.height}"
            raise InputError(
                f"{where}: the parameters are {list(lens.params)}, expected the size of a full panorama, {sides}"
            )
        return lens
    camera = lens._camera()  # noqa: SLF001
    focal = [lens.params[index] for index in camera.focal_length_idxs()]
    if not all(math.isfinite(value) for value in lens.params) or min(focal) <= 0:
        raise InputError(
            f"{where}: the parameters are {list(lens.params)}, expected finite numbers and focal lengths above 0"
        )
    return lens


def in_pixels(lens: Lens) -> tuple[Lens, bool]:
    """Convert a lens to pixels if it was given in fractions of the picture's width and height.

    A principal point in the first pixel is implausible for a photograph, so it is read as fractions of the size. Focal
    lengths are then read as fractions too if they are below MIN_FOCAL_PER_SIDE times the longer side.
    Returns the lens, and True if it was converted.
    """
    camera = lens._camera()  # noqa: SLF001
    sides, params = (lens.width, lens.height), list(lens.params)
    centre = list(camera.principal_point_idxs())
    if lens.is_panorama or min(sides) < MIN_CENTRE_CHECK_SIDE_PX or not all(0 < params[index] <= 1 for index in centre):
        return lens, False
    focal = list(camera.focal_length_idxs())
    if all(params[index] < MIN_FOCAL_PER_SIDE * max(sides) for index in focal):
        given = [params[index] for index in focal]
        alike = len(given) == 2 and abs(given[0] / given[1] - 1) < abs(given[0] * sides[0] / given[1] / sides[1] - 1)
        # Pixels are square, so focal lengths that are nearly equal are both fractions of the width.
        by = (sides[0],) * 2 if alike else sides
        for index, side in zip(focal, by if len(focal) == 2 else (max(sides),), strict=True):
            params[index] *= side
    for index, side in zip(centre, sides, strict=True):
        params[index] *= side
    return replace(lens, params=tuple(params)), True


def given_in_parts(names: Iterable[object]) -> str:
    """Return the warning that `in_pixels` has converted the lenses of the cameras `names`."""
    return (
        f"the principal point (cx cy) of {examples(names)} is given as fractions of the picture's width and height, "
        "not in pixels; it is read as fractions, and so are focal lengths below a twentieth of the longer side"
    )


def pixels_of(
    points: Float64, camera: Camera, lens: Lens | None = None
) -> tuple[NDArray[np.int64], NDArray[np.int64], NDArray[np.bool_]]:
    """Locate points in a view's picture.

    points: (N, 3), world coordinates.
    lens: the photograph's lens; needed only if the camera is not a pinhole camera.
    Returns the rows and columns of the points that lie in front of the camera and in its picture, and `inside` (N,),
    which is True for these points.
    """
    local = points @ camera.rotation.T + camera.translation
    if lens is not None and not camera.is_pinhole:
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


MIN_TRACKED_POINTS_IN_VIEW = 0.1
"""Minimum fraction of tracked points that the scene's cameras project into the photographs of their tracks.

The fraction is 0.4 for an undistorted fisheye of 200 degrees, and 0.001 for cameras in another coordinate frame.
"""


def tracked_in_view(tracked: Iterable[tuple[Camera, Lens | None, Float64]]) -> tuple[int, int, bool]:
    """Count the points that the cameras project into the photographs in which COLMAP observed them.

    Returns this count, the number of observations, and True if their ratio is at least MIN_TRACKED_POINTS_IN_VIEW.
    Otherwise the cameras and the points have different world frames.

    tracked: for each photograph its camera, its lens and the points (k, 3) that COLMAP observed in it.
    """
    seen = whole = 0
    for camera, lens, points in tracked:
        seen += int(np.count_nonzero(pixels_of(points, camera, lens)[2]))
        whole += len(points)
    return seen, whole, seen >= MIN_TRACKED_POINTS_IN_VIEW * whole


def occlusion_cell(camera: Camera, points: int) -> float:
    """Return the side in pixels of the occlusion cells of a camera's picture (POINTS_PER_OCCLUSION_CELL).

    points: number of points that the picture shows.
    """
    cell = np.sqrt(POINTS_PER_OCCLUSION_CELL * camera.width * camera.height / max(points, 1))
    return float(max(min(cell, MAX_OCCLUSION_CELL_FRACTION * max(camera.width, camera.height)), 1.0))


def nearest_around(rows: NDArray[np.int64], columns: NDArray[np.int64], depths: Float64, cell: float) -> Float64:
    """Return, for each point, the least depth (N,) of the points in the same square of `cell` x `cell` pixels.

    rows, columns, depths: (N,), pixel and depth of each point.
    """
    across, down = (columns // cell).astype(np.int64), (rows // cell).astype(np.int64)
    cells = down * (across.max(initial=0) + 1) + across
    nearest = np.full(cells.max(initial=0) + 1, np.inf)
    np.minimum.at(nearest, cells, depths)
    return np.asarray(nearest[cells])


def undistort(image: Float32, lens: Lens, camera: Camera) -> Float32:
    """Resample a picture (H, W, C) that was taken through `lens` to the pixels of `camera`, which has the same pose.

    Interpolation is by cubic spline, clipped to the picture's range of values. If `camera` is less than 3/4 as wide as
    `lens.pinhole`, the picture is interpolated bilinearly to the size of `lens.pinhole` and then averaged over areas.
    Alpha is straight in input and output. Pixels outside the picture repeat its border. `Lens.pinhole` has no such
    pixels, except for extreme fisheyes.
    """
    from scipy import ndimage  # imported here, as the import takes 0.1 s and few commands need it

    natural = lens.pinhole(camera.rotation, camera.translation)
    shrinks = camera.width < 0.75 * natural.width
    grid = camera.resized(natural.width, natural.height) if shrinks else camera
    x, y = np.meshgrid(
        (np.arange(grid.width) + 0.5 - grid.cx) / grid.fx, (np.arange(grid.height) + 0.5 - grid.cy) / grid.fy
    )
    rays = np.stack([x.ravel(), y.ravel(), np.ones(x.size)], axis=1)
    pixels = lens.img_from_cam(rays) - 0.5  # from pixel centres at +0.5 to whole indices
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
