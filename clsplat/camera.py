# SPDX-License-Identifier: Apache-2.0
"""`Camera`: intrinsics, pose and projection, with COLMAP's axes (x right, y down, z forward), pixel centres at +0.5."""

from __future__ import annotations

import math
from dataclasses import dataclass, fields, replace
from functools import cached_property
from typing import Literal, cast

import numpy as np

from clsplat.arrays import Float32, Float64
from clsplat.cameras.equirectangular import Equirectangular
from clsplat.cameras.fisheye import BentFisheye, Fisheye
from clsplat.cameras.model import CameraModel, LensModel
from clsplat.cameras.orthographic import Orthographic
from clsplat.cameras.perspective import Perspective, PerspectiveByRays
from clsplat.errors import InputError

Projection = Literal["perspective", "orthographic", "equirectangular", "fisheye"]


CAMERA_MODELS: tuple[CameraModel, ...] = (
    Perspective(
        "perspective",
        lenses=(
            LensModel("SIMPLE_PINHOLE", 0, "PINHOLE", 0),
            LensModel("PINHOLE"),
            LensModel("SIMPLE_RADIAL", 1, "OPENCV", 4),
            LensModel("RADIAL", 2, "OPENCV", 4),
            LensModel("SIMPLE_DIVISION", 1, "DIVISION", 1),
        ),
        transforms=(
            *("", "PERSPECTIVE", "SIMPLE_PINHOLE", "PINHOLE"),
            *("SIMPLE_RADIAL", "RADIAL", "OPENCV", "FULL_OPENCV"),
        ),
        nerfstudio=("perspective",),
        usd=("", "perspective", "pinhole"),
        opensfm=("", "perspective", "brown", "radial", "simple_radial"),
        metashape=("frame",),
        realityscan=("", "perspective", "brown3", "brown3t2", "brown4", "brown4t2"),
        gsplat="pinhole",
    ),
    Orthographic(
        "orthographic", defines={"ORTHOGRAPHIC": True}, usd=("orthographic",), gsplat="ortho", ewa="ORTHOGRAPHIC"
    ),
    Equirectangular(
        "equirectangular",
        defines={"RAYS": True, "EQUIRECTANGULAR": True},
        lenses=(LensModel("EQUIRECTANGULAR"),),
        transforms=("EQUIRECTANGULAR",),
        nerfstudio=("equirectangular",),
        opensfm=("spherical", "equirectangular"),
        metashape=("spherical",),
    ),
    Fisheye(
        "fisheye",
        defines={"RAYS": True, "FISHEYE_RAYS": True},
        lenses=(
            LensModel("SIMPLE_FISHEYE", 0, "FISHEYE", 0),
            LensModel("FISHEYE"),
            LensModel("SIMPLE_RADIAL_FISHEYE", 1, "OPENCV_FISHEYE", 4),
            LensModel("RADIAL_FISHEYE", 2, "OPENCV_FISHEYE", 4),
            LensModel("OPENCV_FISHEYE", 4),
        ),
        transforms=("FISHEYE", "OPENCV_FISHEYE", "SIMPLE_RADIAL_FISHEYE", "RADIAL_FISHEYE"),
        nerfstudio=("fisheye",),
        opensfm=("fisheye", "fisheye_opencv"),
        metashape=("fisheye", "equidistant_fisheye"),
        gsplat="fisheye",
        ewa="FISHEYE",
    ),
    BentFisheye("fisheye", "radial", defines={"RAYS": True, "FISHEYE_RAYS": True, "BENT_FISHEYE": True}),
    PerspectiveByRays("perspective", "by_rays", defines={"RAYS": True, "PERSPECTIVE_RAYS": True}),
)
"""Every camera model. docs/cameras.md (Adding a camera model) explains each attribute."""

PROJECTIONS: dict[str, CameraModel] = {model.projection: model for model in CAMERA_MODELS if not model.option}
"""The model of each projection without options (`radial`, `by_rays`). Messages and the self-test use this order."""

JACOBIAN_CLAMP_HALF_FRAMES = 0.3
"""Default of `Window.clamp`, in halves of the frame's size: the Jacobian is clamped at 1.3 tan(fov / 2)."""
DEFAULT_NEAR_PLANE = 0.01
"""Default near plane in world units, for cameras and models without their own."""
MIN_SIZE_IN_NEAR_PLANES = 100.0
"""Minimum ratio of a scene's length unit to the scene's near plane, and of a tiny model's size to the model's near
plane."""
ROTATION_TOLERANCE = 1e-2
"""Largest allowed entry of |R^T R - I|. It is this large because poses may be typed with few digits or be float32."""
MAX_FOCAL_PX = 1e12
"""Exclusive upper limit of focal lengths in pixels. Even below it, float32 cannot resolve single pixels."""


@dataclass(frozen=True)
class Window:
    """Place of a picture in its frame, in pixels.

    x, y: frame coordinates of the picture's first pixel; negative if it lies left of or above the frame.
    width, height: size of the frame.
    clamp: distance beyond the frame's edges, in halves of the frame's size, up to which the projection's Jacobian
    follows a Gaussian's mean. For means farther out, the Jacobian at this distance is used. `clamp` exceeds its default
    only for a picture that extends further beyond its frame.
    """

    x: int
    y: int
    width: int
    height: int
    clamp: float = JACOBIAN_CLAMP_HALF_FRAMES


def _is_set(option: object) -> bool:
    """Return True if an option of a camera is set: `by_rays` if it is True, `radial` if it is not all zeros.

    Tuples are tested in plain Python, which is faster than NumPy, because every step calls this function often.
    """
    if isinstance(option, bool):
        return option
    return any(option) if isinstance(option, tuple) else bool(np.any(option))  # type: ignore[call-overload]


@dataclass(frozen=True, eq=False)
class Camera:
    """A camera and its pose. It is a pinhole unless `projection` says otherwise.

    Attributes
    ----------
    width : int
        Width of the picture in pixels.
    height : int
        Height of the picture in pixels.
    fx : float
        Horizontal focal length: pixels per unit of the projected coordinates (see Notes).
    fy : float
        Vertical focal length, in the same unit.
    cx : float
        Distance of the principal point from the image's left edge in pixels; the centre of the first pixel is at 0.5.
    cy : float
        Distance of the principal point from the image's upper edge in pixels; the centre of the first pixel is at 0.5.
    rotation : (3, 3) float64
        x_cam = rotation @ x_world + translation, COLMAP's `cam_from_world`; no unit.
    translation : (3,) float64
        Translation of `cam_from_world` in world units.
    near : float
        Least depth of a drawn Gaussian's mean in world units. With the default, DEFAULT_NEAR_PLANE, the model's near
        plane applies (`Gaussians.near`).
    far : float
        Largest depth of a drawn Gaussian's mean in world units.
    projection : str
        "perspective", "orthographic", "equirectangular" or "fisheye" (equidistant).
    window : Window, optional
        Place of the picture in its frame, if the picture is a part of a frame or extends beyond it. Width and height
        then are the picture's, while cx and cy are measured from the frame's corner.
    radial : (4,) float
        Coefficients k1 to k4 of a fisheye (Kannala and Brandt; OPENCV_FISHEYE in OpenCV and COLMAP), no unit. If
        all are 0, the fisheye is equidistant.
    by_rays : bool
        True for a perspective camera that draws Gaussians along the rays of its pixels, like fisheye and panorama. Use
        it for a model that was trained this way (`Gaussians.by_rays`).

    Notes
    -----
    Depth is z; for fisheye and equirectangular cameras it is the distance.

    The projected coordinates are, by projection (docs/cameras.md has the equations):

    - perspective: x/z and y/z.
    - orthographic: x and y, so that 1 / fx is world units per pixel.
    - fisheye: the angle from the axis, radians.
    - equirectangular: longitude and latitude, radians.

    With `radial`, a point at angle t from the axis is t (1 + k1 t^2 + k2 t^4 + k3 t^6 + k4 t^8) focal lengths from the
    principal point.

    Picture and frame have the same bits in their common part if the window's x and y are multiples of a tile and the
    Jacobian's clamp is the same (docs/pictures.md).
    """

    width: int
    height: int
    fx: float
    fy: float
    cx: float
    cy: float
    rotation: Float64
    translation: Float64
    near: float = DEFAULT_NEAR_PLANE
    far: float = math.inf
    projection: Projection = "perspective"
    window: Window | None = None
    radial: tuple[float, float, float, float] = (0.0, 0.0, 0.0, 0.0)
    by_rays: bool = False

    def __getstate__(self) -> dict[str, object]:
        """Return the state to pickle: the fields, without the cached `model`. Another process looks it up itself."""
        return {each.name: getattr(self, each.name) for each in fields(self)}

    @cached_property
    def model(self) -> CameraModel:
        """The row of CAMERA_MODELS for this camera's projection and options: properties, formulas and kernels."""
        for model in CAMERA_MODELS:
            if model.option and model.projection == self.projection and _is_set(getattr(self, model.option)):
                return model
        return PROJECTIONS[self.projection]

    @property
    def is_pinhole(self) -> bool:
        """True for perspective cameras, whether they draw Gaussians on the image plane or along rays."""
        return self.model.is_pinhole

    @property
    def fold(self) -> tuple[float, float]:
        """The largest angle from the axis that a fisheye shows, in radians, and the radius in the picture at which it
        shows this angle, in focal lengths."""
        return self.model.fold(self.radial)

    @property
    def frustum_limits(self) -> Float64:
        """Lower (row 0) and upper bounds (row 1) of x/z and y/z in the Jacobian: eq. (3) of docs/gradients.md."""
        window = self.window or Window(0, 0, self.width, self.height)
        size = np.array([window.width, window.height], np.float64)
        focal = np.array([self.fx, self.fy], np.float64)
        centre = np.array([self.cx, self.cy], np.float64)
        margin = window.clamp * 0.5 * size / focal
        return np.stack([-centre / focal - margin, (size - centre) / focal + margin])

    @property
    def position(self) -> Float64:
        """The camera's centre in the world, (3,)."""
        centre: Float64 = -self.rotation.T @ self.translation
        return centre

    def check(self) -> None:
        """Raise InputError if an attribute is invalid. The message names the attribute and its value."""
        for name in ("width", "height"):
            side = getattr(self, name)
            if isinstance(side, bool) or not isinstance(side, int | np.integer) or side < 1:
                raise InputError(f"camera: {name} is {side}, expected a whole number of pixels, at least 1")
        for name in ("fx", "fy"):
            if not 0 < getattr(self, name) < math.inf:
                raise InputError(f"camera: {name} is {getattr(self, name)}, expected a finite number over 0")
        if not (math.isfinite(self.cx) and math.isfinite(self.cy)):
            raise InputError(f"camera: cx, cy are {self.cx}, {self.cy}, expected finite numbers")
        for name, shape in (("rotation", (3, 3)), ("translation", (3,))):
            values = np.asarray(getattr(self, name))
            if values.shape != shape or values.dtype.kind not in "iuf":
                raise InputError(f"camera: {name} is {values.dtype} {values.shape}, expected numbers of shape {shape}")
            if not np.isfinite(values).all():
                raise InputError(f"camera: {name} has numbers that are not finite: {values.tolist()}")
        rotation = np.asarray(self.rotation, np.float64)
        if (off := float(np.abs(rotation.T @ rotation - np.eye(3)).max())) > ROTATION_TOLERANCE:
            raise InputError(
                f"camera: rotation is not a rotation matrix, its axes are {off:.2g} off right angles or length 1; "
                "expected the rotation of cam_from_world, without scale"
            )
        if not 0 < self.near < self.far:
            raise InputError(f"camera: near is {self.near} and far is {self.far}, expected 0 < near < far")
        self._check_projection()

    def _check_projection(self) -> None:
        if self.projection not in PROJECTIONS:
            raise InputError(f"camera: projection is {self.projection!r}, expected one of {', '.join(PROJECTIONS)}")
        for model in CAMERA_MODELS:
            if model.option and model.projection != self.projection and _is_set(getattr(self, model.option)):
                raise InputError(
                    f"camera: {model.option} is {getattr(self, model.option)} but projection is {self.projection!r}, "
                    f"expected {model.projection!r}"
                )
        if len(self.radial) != 4 or not all(math.isfinite(value) for value in self.radial):
            raise InputError(f"camera: radial is {self.radial}, expected four finite numbers")

    def through(self, model: CameraModel, radial: tuple[float, ...] = (0.0, 0.0, 0.0, 0.0)) -> Camera:
        """The camera with another projection, `model.projection`, and fisheye coefficients `radial`, without `by_rays`.
        Intrinsics and pose stay the same."""
        k1, k2, k3, k4 = radial
        return replace(self, projection=cast("Projection", model.projection), radial=(k1, k2, k3, k4), by_rays=False)

    def from_origin(self, origin: Float64) -> Camera:
        """The same camera for world coordinates that are relative to the point `origin` (3,) of this camera's world."""
        if not origin.any():
            return self
        return replace(self, translation=self.translation + self.rotation @ origin)

    def moved(self, motion: Float64) -> Camera:
        """The camera that sees what this camera would see if the world moved: equation (140) of docs/gradients.md.

        motion: (6,), a rotation of the world about this camera's centre, as a rotation vector in radians, and then a
        translation of the world in world units.
        """
        turn, shift = np.asarray(motion, np.float64).reshape(2, 3)
        x, y, z = turn
        angle, across = float(np.linalg.norm(turn)), np.array([[0, -z, y], [z, 0, -x], [-y, x, 0]])
        by_angle = np.sinc(np.array([angle, angle / 2]) / math.pi)
        turned = np.eye(3) + by_angle[0] * across + 0.5 * by_angle[1] ** 2 * across @ across
        rotation = self.rotation @ turned
        return replace(self, rotation=rotation, translation=self.rotation @ shift - rotation @ self.position)

    def posed(self, rotation: Float64, translation: Float64) -> Camera:
        """The same camera with another `cam_from_world`."""
        return replace(self, rotation=rotation, translation=translation)

    def refocused(self, log: float, x: float, y: float) -> Camera:
        """The same pose with fx and fy multiplied by exp(log), cx moved by x * fx, and cy moved by y * fy.

        The shifts use fx and fy from before the multiplication.
        """
        factor, moved = math.exp(log), (self.cx + x * self.fx, self.cy + y * self.fy)
        return replace(self, fx=self.fx * factor, fy=self.fy * factor, cx=moved[0], cy=moved[1])

    def before(self, near: float) -> Camera:
        """The same view with the near plane `near` of a model, in world units. A camera whose near plane is not the
        default keeps its own."""
        return replace(self, near=near) if self.near == DEFAULT_NEAR_PLANE != near else self

    def along_rays(self, by_rays: bool) -> Camera:
        """The same view with this value of `by_rays` for a perspective camera. Other cameras are returned unchanged."""
        changes = self.is_pinhole and by_rays != self.by_rays
        return replace(self, by_rays=by_rays) if changes else self

    def depths_of_distances(self) -> Float32 | None:
        """For a `by_rays` camera, the factors (height, width) that convert distances along pixels' rays to depths z.

        None for all other cameras, whose depths need no conversion before they are written to files.
        """
        return self.cosines() if self.by_rays else None

    def cosines(self) -> Float32 | None:
        """Cosines (height, width) of the angles between a perspective camera's axis and the rays of its pixels.

        None for other projections, which need no conversion: orthographic rays are parallel to the axis, and the depths
        of fisheyes and panoramas are distances.
        """
        if not self.is_pinhole:
            return None
        x, y = (self.window.x, self.window.y) if self.window else (0, 0)
        a = (x + np.arange(self.width) + 0.5 - self.cx) / self.fx
        b = (y + np.arange(self.height) + 0.5 - self.cy) / self.fy
        return (1 / np.sqrt(1 + a**2 + b[:, None] ** 2)).astype(np.float32)

    def depths_of(self, points: Float64) -> Float64:
        """Depths (N,) of points (N, 3) in world coordinates, as files store them.

        They are z for a camera with an image plane, and distances for other cameras.
        """
        local = points @ self.rotation.T + self.translation
        return np.asarray(local[:, 2] if self.model.flat else np.linalg.norm(local, axis=1))

    def drawn_depths(self, offsets: Float64) -> Float64:
        """Depths (N,) by which Gaussians are sorted: z, or distances if the model draws along rays.

        offsets: (N, 3), vectors from the camera's centre to the means, in world axes.
        """
        return np.asarray(
            np.linalg.norm(offsets, axis=1) if self.model.along_rays else offsets @ self.rotation[2], np.float64
        )

    def reshaped(self, width: int, height: int) -> Camera:
        """The camera with a picture of another size.

        If the aspect ratio changes, even by rounding, the vertical field of view and the shape of pixels stay. The
        picture then shows more or less to the left and right, so all sizes of one aspect ratio show the same. A
        panorama shows all directions at any aspect ratio.
        """
        if (width, height) == (self.width, self.height):
            return self
        if width * self.height == height * self.width or self.model.wraps:
            return self.resized(width, height)
        scale = height / self.height
        middle = 0.5 * width + (self.cx - 0.5 * self.width) * scale
        fx, fy, cy = self.fx * scale, self.fy * scale, self.cy * scale
        return replace(self, width=width, height=height, fx=fx, fy=fy, cx=middle, cy=cy)

    def cropped(self, x: int, y: int, width: int, height: int) -> Camera:
        """The camera of a part of the picture, which begins at pixel (x, y) and may extend beyond the picture.

        The part is a window of the frame, and its pixels are bit-identical to the frame's there (docs/pictures.md).
        """
        window = self.window or Window(0, 0, self.width, self.height)
        return replace(self, width=width, height=height, window=replace(window, x=window.x + x, y=window.y + y))

    def reframed(self, like: Camera) -> Camera:
        """This camera, which shows a whole frame, with the picture size and window of the camera `like`.

        If the frame of `like` has another size, this camera is first resized to it.
        """
        frame = like.window or like
        sized = self if (self.width, self.height) == (frame.width, frame.height) else None
        sized = sized or self.resized(frame.width, frame.height)
        return replace(sized, width=like.width, height=like.height, window=like.window)

    def resized(self, width: int, height: int) -> Camera:
        """The same view on another pixel grid. Since pixel centres are at +0.5, this is a pure scaling.

        Raises ValueError if edges of `window` would not be at whole pixels.
        """
        sx, sy = width / self.width, height / self.height
        window = self.window
        if window is not None:
            edges = [window.x * sx, window.y * sy, window.width * sx, window.height * sy]
            if any(edge != round(edge) for edge in edges):
                size = f"resized from {self.width}x{self.height} to {width}x{height}"
                raise ValueError(f"{window} {size} would not have its edges at whole pixels")
            x, y, across, down = (round(edge) for edge in edges)
            window = Window(x, y, across, down, window.clamp)
        return replace(
            self,
            width=width,
            height=height,
            fx=self.fx * sx,
            fy=self.fy * sy,
            cx=self.cx * sx,
            cy=self.cy * sy,
            window=window,
        )


def focal_length(fov: float, size: float, projection: Projection = "perspective") -> float:
    """fx (or fy) of a camera that sees the angle `fov`, in radians, across `size` pixels around its axis.

    Raises ValueError for an angle that the projection cannot show, and for orthographic cameras, which have no angle of
    view.
    """
    model = PROJECTIONS[projection]
    if model.parallel:
        raise ValueError(f"{model.named} camera has no angle of view")
    if 0 < fov < size / MAX_FOCAL_PX:
        raise ValueError(
            f"angle of view is {math.degrees(fov):g} degrees, which gives a focal length over {MAX_FOCAL_PX:g} pixels"
        )
    return model.focal_length(fov, size)


def model_with(column: str, value: object) -> CameraModel | None:
    """The camera model that another program calls `value`; None if no model has this name.

    column: attribute of CameraModel with the program's names, such as "usd" or "nerfstudio".
    """
    return next((model for model in CAMERA_MODELS if value in getattr(model, column)), None)


def names_of(column: str) -> tuple[str, ...]:
    """All names that another program has for camera models; names of panoramas are last.

    column: attribute of CameraModel with the program's names, such as "usd" or "nerfstudio".
    """
    return tuple(
        name for model in sorted(CAMERA_MODELS, key=lambda each: each.wraps) for name in getattr(model, column)
    )
