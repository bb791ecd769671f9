# SPDX-License-Identifier: Apache-2.0
"""The camera: COLMAP's axes (x right, y down, z forward), pixel centres at +0.5."""

from __future__ import annotations

import math
from collections.abc import Mapping
from dataclasses import dataclass, field, replace
from functools import cached_property
from typing import Literal

import numpy as np

from clsplat.arrays import Float32, Float64
from clsplat.errors import InputError

Projection = Literal["perspective", "orthographic", "equirectangular", "fisheye"]


@dataclass(frozen=True)
class ProjectionKind:
    """Properties of a projection.

    flat: True if there is an image plane; defines: those that the kernels are built with.
    """

    flat: bool = True
    defines: Mapping[str, object] = field(default_factory=dict)

    @property
    def rays(self) -> bool:
        """True if Gaussians are ellipses on planes of their own, at which a pixel looks along its ray, and kernels have
        distances for depths; else they are on the image's plane, and depth is z."""
        return "RAYS" in self.defines


PROJECTIONS: dict[Projection, ProjectionKind] = {
    "perspective": ProjectionKind(),
    "orthographic": ProjectionKind(defines={"ORTHOGRAPHIC": True}),
    "equirectangular": ProjectionKind(flat=False, defines={"RAYS": 1}),
    "fisheye": ProjectionKind(flat=False, defines={"RAYS": 2}),
}
"""Every projection. Its equations are in kernels/project*.cl and, in float64, in clsplat/reference/cameras.py."""

BENT_FISHEYE = ProjectionKind(flat=False, defines={"RAYS": 2, "KANNALA_BRANDT": True})
"""The fisheye with coefficients (`Camera.radial`)."""

PERSPECTIVE_BY_RAYS = ProjectionKind(defines={"RAYS": 3})
"""The pinhole that shows what a fisheye shows (`Camera.by_rays`)."""

KINDS = (*PROJECTIONS.values(), BENT_FISHEYE, PERSPECTIVE_BY_RAYS)
"""Every kind that a camera may have."""

LEAST_SLOPE = 0.1
"""Pixels a radian, in those of the axis, from which on a fisheye's picture counts as folded over: it has nothing there,
and float32 finds the angle of every pixel before."""

FRAME_CLAMP = 0.3
NEAR = 0.01
"""World units: the near plane of a camera that has none of its own, before a model that has none either."""
NEARS = 100.0
"""Near planes in the extent of a scene that is too small for the usual one."""
NO_ROTATION = 1e-2
"""Most that R^T R may differ from 1: poses are typed with few digits, or float32's."""
LARGEST_FOCAL = 1e12
"""Pixels: float32 has no digits left of a position long before."""


@dataclass(frozen=True)
class Window:
    """Place of a picture in its frame, in pixels.

    x, y: its first pixel, negative beyond the frame's left and upper edge; width, height: of the frame; clamp: how far
    beyond the frame's edges the projection's Jacobian still follows a Gaussian's mean, in halves of the frame's size;
    more only for a picture that shows more.
    """

    x: int
    y: int
    width: int
    height: int
    clamp: float = FRAME_CLAMP


@dataclass(frozen=True, eq=False)
class Camera:
    """A camera and its pose; a pinhole unless `projection` says otherwise.

    width, height: image size in pixels; fx, fy: pixels a unit of what the projection maps, see below; cx, cy: the
    principal point in pixels, measured from the image's top left corner, so that the centre of the first pixel is
    (0.5, 0.5); rotation (3, 3), translation (3,): `cam_from_world`, x_cam = rotation @ x_world + translation.

    projection, and what a pixel is a multiple of there (docs/cameras.md has the equations): perspective, x/z and y/z;
    orthographic, x and y, so 1 / fx is world units a pixel; fisheye (equidistant), the angle from the axis in radians;
    equirectangular, longitude and latitude in radians. near, far: depths in world units between which something is
    seen, by their means; depth is z, for fisheye and equirectangular the distance. A near of NEAR, the default,
    stands for the model's (`Gaussians.near`).

    radial: k1 to k4 of a fisheye (Kannala and Brandt; OpenCV's and COLMAP's OPENCV_FISHEYE): the angle t from the axis
    is t (1 + k1 t^2 + k2 t^4 + k3 t^6 + k4 t^8) focal lengths from it; 0 for the equidistant one.

    by_rays: True for a perspective camera that draws Gaussians as the fisheye and the panorama do, along the rays of
    its pixels, for a model that was trained so (`Gaussians.by_rays`).

    window: where the picture is a part of a frame, or more than it: width and height are the picture's, cx and cy are
    measured from the frame's corner. What both show has the same bits where x and y are multiples of a tile and the
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
    near: float = NEAR
    far: float = math.inf
    projection: Projection = "perspective"
    window: Window | None = None
    radial: tuple[float, float, float, float] = (0.0, 0.0, 0.0, 0.0)
    by_rays: bool = False

    @property
    def kind(self) -> ProjectionKind:
        """The properties of its projection."""
        if self.by_rays:
            return PERSPECTIVE_BY_RAYS
        return BENT_FISHEYE if any(self.radial) else PROJECTIONS[self.projection]

    @cached_property
    def fold(self) -> tuple[float, float]:
        """The largest angle from its axis, radians, that a fisheye shows, and its distance there in focal lengths."""
        if not any(self.radial):
            return math.pi, math.pi
        powers = 2 * np.arange(5)
        factors = np.array([1.0, *self.radial])
        angles = np.linspace(0.0, math.pi, 4097)
        folded = (((1 + powers) * factors) @ angles ** powers[:, None]) < LEAST_SLOPE
        angle = float(angles[np.argmax(folded) - 1]) if folded.any() else math.pi
        return angle, float(angle * (factors @ angle**powers))

    @property
    def position(self) -> Float64:
        """The camera's centre in the world, (3,)."""
        centre: Float64 = -self.rotation.T @ self.translation
        return centre

    def check(self) -> None:
        """Raise InputError naming the value that no camera has."""
        for name in ("width", "height"):
            side = getattr(self, name)
            if isinstance(side, bool) or not isinstance(side, int | np.integer) or side < 1:
                raise InputError(f"camera: {name} is {side}, expected a whole number of pixels from 1 on")
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
        if (off := float(np.abs(rotation.T @ rotation - np.eye(3)).max())) > NO_ROTATION:
            raise InputError(
                f"camera: rotation is none, its axes are {off:.2g} off right angles or length 1, expected that of "
                "cam_from_world; a scale does not belong in it"
            )
        if not 0 < self.near < self.far:
            raise InputError(f"camera: near is {self.near}, far {self.far}, expected 0 < near < far")
        self._check_projection()

    def _check_projection(self) -> None:
        if self.projection not in PROJECTIONS:
            raise InputError(f"camera: projection is {self.projection!r}, expected one of {', '.join(PROJECTIONS)}")
        for name, of, other in (("radial", "fisheye", any(self.radial)), ("by_rays", "perspective", self.by_rays)):
            if other and self.projection != of:
                raise InputError(
                    f"camera: {name} is {getattr(self, name)} of a camera that is {self.projection}, expected {of}"
                )
        if len(self.radial) != 4 or not all(math.isfinite(value) for value in self.radial):
            raise InputError(f"camera: radial is {self.radial}, expected four finite numbers")

    def from_origin(self, origin: Float64) -> Camera:
        """The same view, for coordinates of the world that are counted from origin (3,)."""
        if not origin.any():
            return self
        return replace(self, translation=self.translation + self.rotation @ origin)

    def moved(self, motion: Float64) -> Camera:
        """The camera after a motion (6,): a turn about its centre, in radians about the world's axes, and a shift along
        them. It sees what it would see if the world had made them instead, the shift last: (140) of docs/gradients.md.
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
        """The same view with focal lengths times e^log, its principal point moved by x and y of the old ones."""
        factor, moved = math.exp(log), (self.cx + x * self.fx, self.cy + y * self.fy)
        return replace(self, fx=self.fx * factor, fy=self.fy * factor, cx=moved[0], cy=moved[1])

    def before(self, near: float) -> Camera:
        """The same view of a model whose near plane is at `near`: that counts unless the camera has its own."""
        return replace(self, near=near) if self.near == NEAR != near else self

    def along_rays(self, by_rays: bool) -> Camera:
        """The same view of a model that is drawn along rays, or is not; for another projection than perspective the
        camera itself."""
        changes = self.projection == "perspective" and by_rays != self.by_rays
        return replace(self, by_rays=by_rays) if changes else self

    def depths_of_distances(self) -> Float32 | None:
        """Cosines (height, width) at the pixels of a perspective camera, where kernels have distances: times these they
        are depths, z. None where kernels have the depth."""
        return self.cosines() if self.by_rays else None

    def cosines(self) -> Float32 | None:
        """Cosines (height, width) of the angles between a perspective camera's axis and the rays of its pixels; None
        for other projections, whose depths are not along rays or are distances."""
        if self.projection != "perspective":
            return None
        x, y = (self.window.x, self.window.y) if self.window else (0, 0)
        a = (x + np.arange(self.width) + 0.5 - self.cx) / self.fx
        b = (y + np.arange(self.height) + 0.5 - self.cy) / self.fy
        return (1 / np.sqrt(1 + a**2 + b[:, None] ** 2)).astype(np.float32)

    def resized(self, width: int, height: int) -> Camera:
        """The same view on another pixel grid: pixel centres at +0.5 make this a pure scaling.

        Raises ValueError where a window's edges would not be on it.
        """
        sx, sy = width / self.width, height / self.height
        window = self.window
        if window is not None:
            edges = [window.x * sx, window.y * sy, window.width * sx, window.height * sy]
            if any(edge != round(edge) for edge in edges):
                raise ValueError(f"{window} of {self.width}x{self.height} resized to {width}x{height}: no whole pixels")
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
    """fx (or fy) of a camera that sees the angle `fov`, radians, across `size` pixels around its axis.

    Raises ValueError for an angle that the projection cannot show, and for orthographic, which has none.
    """
    if projection == "orthographic":
        raise ValueError("an orthographic camera has no angle of view")
    if 0 < fov < size / LARGEST_FOCAL:
        raise ValueError(f"angle of view {math.degrees(fov):g} degrees, for a focal length of over {LARGEST_FOCAL:g}")
    if projection == "perspective":
        if not 0 < fov < math.pi:
            raise ValueError(f"angle of view {math.degrees(fov):g} degrees, expected more than 0 and less than 180")
        return 0.5 * size / math.tan(0.5 * fov)
    if not 0 < fov <= 2 * math.pi * (1 + 1e-12):
        raise ValueError(f"angle of view {math.degrees(fov):g} degrees, expected more than 0 and at most 360")
    return size / fov
