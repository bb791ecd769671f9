# SPDX-License-Identifier: Apache-2.0
"""Frustum culling of chunks: a chunk is left out only if none of its Gaussians can reach a tile of the picture.

The bounds follow the formulas and the rounding of kernels/project.cl and project_rays.cl, which would count no tile for
any Gaussian of a chunk that is left out. Opacities are taken as 1, and rotations as unknown.
"""

from __future__ import annotations

import math
from collections.abc import Callable
from dataclasses import dataclass
from functools import cached_property

import numpy as np

from clsplat.arrays import Bool, Float64
from clsplat.camera import Camera, Window
from clsplat.cameras.equirectangular import Equirectangular
from clsplat.cameras.fisheye import MIN_FISHEYE_SLOPE, Fisheye
from clsplat.cameras.model import CameraModel
from clsplat.cameras.perspective import PerspectiveByRays
from clsplat.chunks.bounds import GROUP_FACTOR, ChunkBounds
from clsplat.config.rasterizer import RasterizerConfig
from clsplat.layouts.columns import TILE

_DEFAULT_RASTERIZER = RasterizerConfig()
_LOW_PASS_ROOT = math.sqrt(0.3)
"""Root of the larger variance, in px^2, that projection adds (LOW_PASS in kernels/shared/gaussian.h)."""
_REACH_SLACK = 1.001
"""Factor on a Gaussian's reach. The kernels round it by 1e-4 at most, and along rays enlarge it by at most 1e-4."""
_ROUNDING = 1e-5
"""Slack relative to the terms of a plane's function. Kernels that compute in two floats round the result to float32, by
6e-8."""
_CANCELLED = 1e-11
"""Slack relative to world coordinates, for their rounding in two floats and in float64: large coordinates may cancel in
the camera's axes."""
_ANGLE_SLACK = 1e-4
"""Slack of directions in radians. In float32 they are rounded by 1e-6, and by 22e-6 near a pole."""
_LEAST_AHEAD = 2e-4
"""Twice the tangent of the angle to the plane z = 0 below which the kernels take an end of a Gaussian's box as infinite
(LEAST_AHEAD in kernels/shared/camera/perspective_rays.h)."""
_POLE = 0.99
"""Limit of sin(half angle of a cone) / sin(angle between its middle and an axis). Only below it does the cone count as
clear of the axis. The kernels use 0.999."""


@dataclass(frozen=True, eq=False)
class _Planes:
    """The four sides of a picture on an image plane, then its near and far plane, as functions of a chunk's bounds.

    A function is the sum of three parts. It is negative if the whole chunk is beyond the plane.

    terms: (6, 8), factors of `ChunkBounds.terms`.
    by_distance: (6, 1), factors of the distance of a box's middle from the camera.
    limit: (6, 1), the constant parts, negated: the function is negative if the other two parts are below it.
    centre: (3, 1), the camera's centre in the world.
    """

    terms: Float64
    by_distance: Float64
    limit: Float64
    centre: Float64


@dataclass(frozen=True, eq=False)
class PictureBorders:
    """The borders of a camera's picture and its limits of depth, which culling compares chunks with.

    culls: False if every chunk counts as visible.
    square: True if a Gaussian is listed in all tiles of a square, whose half side is the ellipse's longest half axis.
        This axis is at most the root of the sum of the squared half width and half height.
    reach: number of standard deviations at which a Gaussian ends.
    stretch: largest factor by which the camera's matrix changes a length; 1 for an exact rotation.
    low: (2,), left and upper border of the tiles, in pixels from the principal point.
    high: (2,), right and lower border of the tiles.
    slack: (2,), rounding error in pixels of image positions near the picture.
    depths: depths of the near and the far plane.
    """

    camera: Camera
    culls: bool
    square: bool
    reach: float
    stretch: float
    low: Float64
    high: Float64
    slack: Float64
    depths: tuple[float, float]

    @classmethod
    def of(
        cls, camera: Camera, config: RasterizerConfig = _DEFAULT_RASTERIZER, opacity_factor: float = 1.0
    ) -> PictureBorders:
        """Return the borders of a camera's picture.

        config: the rasterizer's settings, on which a Gaussian's reach depends.
        opacity_factor: factor, at least 1, by which random dropout of Gaussians multiplies the others' opacities.
        """
        switches = config.switches()
        reach = 3.0 if switches.extent == "3sigma" else math.sqrt(2 * math.log(opacity_factor / switches.alpha_min))
        window = camera.window or Window(0, 0, camera.width, camera.height)
        low = np.array([window.x - camera.cx, window.y - camera.cy])
        high = low - TILE * (-np.array([camera.width, camera.height]) // TILE)
        slack = _ROUNDING * (np.abs([camera.cx, camera.cy]) + np.abs(low) + np.abs(high))
        depths = max(camera.near, 0.0), min(camera.far, float(np.finfo(np.float32).max))
        square, stretch = switches.tile_test == "square", float(np.linalg.svd(camera.rotation, compute_uv=False)[0])
        culls, reach = switches.frustum_cull, reach * _REACH_SLACK
        return cls(camera, culls, square, reach, stretch, low, high, slack, depths)

    @cached_property
    def planes(self) -> _Planes:
        """The planes beyond which chunks are hidden, for cameras with an image plane.

        By equations (2) to (6) of docs/gradients.md, the half width of an ellipse is at most k (f sqrt(1 + r^2) s / z +
        b). Here k is the reach, s the largest scale, r the limit of x/z in the Jacobian, and b^2 the low-pass. An
        ellipse reaches the left border l, from the principal point, if f x/z + k (f sqrt(1 + r^2) s / z + b) >= l.
        Times z > 0 this is

            f x + (k b - l) z + k f sqrt(1 + r^2) s >= 0,

        which is linear in the mean. So a box is beyond the border if its farthest corner along (f, 0, k b - l) is
        beyond it. For means beyond the left border, r is between the Jacobian's limit and the border. For parallel rays
        z is 1 and r is 0.
        """
        camera, parallel = self.camera, self.camera.model.parallel
        limits, blur = camera.frustum_limits, self.reach * _LOW_PASS_ROOT
        normals, offsets, slopes = np.zeros((6, 3)), np.zeros(6), np.zeros(6)
        for axis, focal in enumerate((camera.fx, camera.fy)):
            for side, border in ((1, self.low[axis]), (-1, self.high[axis])):
                plane = 2 * axis + (side < 0)
                normals[plane, axis] = side * focal
                (offsets if parallel else normals[:, 2])[plane] = blur - side * border
                nearest = min(max(border / focal, limits[0, axis]), limits[1, axis])
                farthest = limits[0 if side > 0 else 1, axis]
                slopes[plane] = focal * (1.0 if parallel else math.hypot(1.0, max(abs(nearest), abs(farthest))))
        if self.square:
            steepest = 1.0 if parallel else math.hypot(1.0, *np.abs(limits).max(axis=0))
            slopes[:4] = math.hypot(camera.fx, camera.fy) * steepest
        normals[4:, 2], offsets[4:] = [1.0, -1.0], [-self.depths[0], self.depths[1]]
        in_world, sums = normals @ camera.rotation, np.abs(normals).sum(axis=1)
        along = np.column_stack([self.reach * self.stretch * slopes, _CANCELLED * sums])
        constant = normals @ camera.translation + offsets
        pixels = np.where(np.arange(6) < 4, self.slack.max(), 0.0)
        constant += _ROUNDING * np.abs(offsets) + _CANCELLED * sums * np.abs(camera.translation).sum()
        constant += pixels if parallel else 0.0
        by_distance = _ROUNDING * np.sqrt((normals * normals).sum(axis=1)) + (0.0 if parallel else pixels)
        by_distance = self.stretch * by_distance[:, None]
        # the corner is farther away than the middle by at most the sum of the half sides
        by_half = np.abs(in_world) + GROUP_FACTOR * by_distance
        centre = np.asarray(np.linalg.solve(camera.rotation, -camera.translation)[:, None], np.float64)
        return _Planes(np.hstack([in_world, by_half, along]), by_distance, -constant[:, None], centre)


def visible(picture: PictureBorders, bounds: ChunkBounds) -> Bool:
    """Return True (B,) for chunks that a picture may show; False only if no Gaussian of a chunk reaches a tile.

    Chunks whose bounds are not finite are visible. The bounds must also hold for Gaussians that were added to a chunk.
    """
    model = picture.camera.model
    if not picture.culls or len(bounds) == 0 or not (model.along_rays or model.is_pinhole or model.parallel):
        return np.ones(len(bounds), np.bool_)
    with np.errstate(all="ignore"):  # NaN compares as visible
        if not model.along_rays:
            return ~_beyond_planes(bounds, picture)
        cones = _cones(bounds, picture)
        hidden = _out_of_depth(cones, picture)
        for kind, beyond in _ALONG_RAYS.items():
            if isinstance(model, kind):
                hidden |= beyond(cones, picture)
        return ~hidden | ~bounds.finite


def _beyond_planes(bounds: ChunkBounds, picture: PictureBorders) -> Bool:
    """Return True (B,) for chunks beyond a side of a picture with an image plane, or beyond the near or far plane.

    Bounds that are not finite give NaN or infinity here, and so False. Each step calls this function, whose time for a
    few hundred chunks is that of its calls of NumPy, so these are few.
    """
    planes = picture.planes
    # einsum instead of @, because BLAS would start threads even for this small product, and they spin while they wait
    farthest_corner = np.einsum("pk,kb->pb", planes.terms, bounds.terms)
    away = bounds.terms[:3] - planes.centre
    farthest_corner += planes.by_distance * np.sqrt(np.einsum("ij,ij->j", away, away))
    return np.asarray((farthest_corner < planes.limit).any(axis=0))


@dataclass(frozen=True, eq=False)
class _Cones:
    """Cones from the camera's centre around B chunks, with angles in radians.

    middle, half: (3, B), middles and half sides of the chunks' boxes along the camera's axes.
    distance, radius: (B,), distances from the camera, and radii, of spheres around the boxes.
    least: (B,), lower limit of the distance of means beyond the near plane.
    size: (B,), the largest standard deviation.
    spread: (B,), half angle of the cone around all means; NaN if the camera is inside the sphere.
    factor: `ChunkBounds.factor`.
    """

    middle: Float64
    half: Float64
    distance: Float64
    radius: Float64
    least: Float64
    size: Float64
    spread: Float64
    factor: float


def _cones(bounds: ChunkBounds, picture: PictureBorders) -> _Cones:
    camera, terms = picture.camera, bounds.terms
    rounding = _CANCELLED * (terms[7] + np.abs(camera.translation).sum())
    middle = camera.rotation @ terms[:3] + camera.translation[:, None]
    half = np.abs(camera.rotation) @ terms[3:6] + rounding
    radius = picture.stretch * bounds.radius + 2 * rounding
    distance = np.sqrt(np.einsum("ij,ij->j", middle, middle))
    to_box = np.maximum(np.abs(middle) - half, 0.0)
    least = np.maximum(distance - radius, np.sqrt(np.einsum("ij,ij->j", to_box, to_box)))
    least = np.maximum(least, picture.depths[0]) * (1 - _ROUNDING)
    spread = np.arcsin(radius / distance)  # NaN if the camera is in the sphere
    return _Cones(middle, half, distance, radius, least, picture.stretch * terms[6], spread, bounds.factor)


def _out_of_depth(cones: _Cones, picture: PictureBorders) -> Bool:
    """Return True (B,) for chunks nearer than the near plane or beyond the far plane, for camera models along rays."""
    flat = picture.camera.model.flat
    depth, half = (cones.middle[2], cones.half[2]) if flat else (cones.distance, cones.radius)
    slack = half + _ROUNDING * (np.abs(depth) + half)
    out: Bool = (depth + slack < picture.depths[0]) | (depth - slack > picture.depths[1])
    return out


def _caps(cones: _Cones, picture: PictureBorders, pixel: float) -> tuple[Float64, Float64]:
    """Return two half angles (B,), in radians: of the largest cone around a Gaussian, and of the whole chunk's cone.

    A Gaussian's cone is around the direction of its mean. By equations (12) and (13) of docs/cameras.md, the Gaussian's
    ellipse lies in the plane that touches the unit sphere at this direction. A ray at an angle to the direction reaches
    the plane at the angle's tangent. The ellipse's half axis is at most k (s / d + b w). Here k is the reach, s the
    largest scale, d the distance, b^2 the low-pass and w the pixel's width. The chunk's half angle is NaN from 90
    degrees on.

    pixel: the largest width of a pixel on the tangent plane, in radians.
    """
    cap = np.arctan(picture.reach * (cones.size / cones.least + _LOW_PASS_ROOT * pixel)) + _ANGLE_SLACK
    whole = cones.spread + cap
    return cap, np.where(whole < 0.5 * math.pi, whole, np.nan)


def _half_turn(sine: Float64, level: Float64) -> Float64:
    """Return half of the angle (B,) that chunks' cones cover around an axis; NaN if a cone nearly contains the axis.

    Let w be a cone's half angle, and a > w the angle between its middle and the axis. Then the cones of the chunk's
    Gaussians do not contain the axis either, as sin(w - spread) / sin(a - spread) falls with the spread.

    sine: (B,), sin w.
    level: (B,), sin a.
    """
    ratio = sine / level
    return np.where(ratio < _POLE, np.arcsin(ratio), np.nan) + _ANGLE_SLACK


def _beyond_panorama(cones: _Cones, picture: PictureBorders) -> Bool:
    """Return True (B,) for chunks that a window of a panorama does not show: above it, below it, or beside it."""
    camera, (x, y, z) = picture.camera, cones.middle
    _, whole = _caps(cones, picture, max(max(1.0, 0.5 / camera.fy) / camera.fx, 1 / camera.fy))
    across = np.sqrt(x * x + z * z)
    latitude, longitude = np.arctan2(y, across), np.arctan2(x, z)
    slack = picture.slack + _ROUNDING * 2 * math.pi * np.array([camera.fx, camera.fy])
    beyond: Bool = camera.fy * (latitude + whole) + slack[1] < picture.low[1]
    beyond |= camera.fy * (latitude - whole) - slack[1] > picture.high[1]
    turn = 2 * math.pi * camera.fx
    away = camera.fx * longitude - 0.5 * (picture.low[0] + picture.high[0])
    away = np.abs(away - turn * np.round(away / turn))
    aside = camera.fx * _half_turn(np.sin(whole), across / cones.distance)
    beyond |= away - aside - slack[0] > 0.5 * (picture.high[0] - picture.low[0])
    return beyond


def _beyond_borders(cones: _Cones, picture: PictureBorders) -> Bool:
    """Return True (B,) for chunks beyond a side of a perspective picture along rays.

    A border of x or y is an angle in the plane of this axis and z. The kernels take a Gaussian's box as infinite where
    it comes near the plane z = 0, so chunks with means near this plane are visible.
    """
    camera, z = picture.camera, cones.middle[2]
    _, whole = _caps(cones, picture, 1 / min(camera.fx, camera.fy))
    least, sine = np.maximum(z - cones.half[2], picture.depths[0]), np.sin(whole)
    beyond = np.zeros(len(z), np.bool_)
    steepest = 0.5 * math.pi - _LEAST_AHEAD
    for axis, focal in enumerate((camera.fx, camera.fy)):
        along, slack = cones.middle[axis], picture.slack[axis]
        ahead = least > _LEAST_AHEAD * (np.abs(along) + cones.half[axis])
        angle = np.arctan2(along, z)
        aside = _half_turn(sine, np.sqrt(along * along + z * z) / cones.distance)
        low, high = (picture.low[axis] - slack) / focal, (picture.high[axis] + slack) / focal
        beyond |= ahead & (angle + aside < min(math.atan(low), steepest))
        beyond |= ahead & (angle - aside > max(math.atan(high), -steepest))
    return beyond


def _radius(camera: Camera, theta: Float64) -> Float64:
    """Return image radii (B,) of a fisheye, in focal lengths, at angles theta (B,): equation (18) of
    docs/cameras.md."""
    if not any(camera.radial):
        return theta
    square, (k1, k2, k3, k4) = theta * theta, camera.radial
    return theta * (1 + square * (k1 + square * (k2 + square * (k3 + square * k4))))


def _beyond_fisheye(cones: _Cones, picture: PictureBorders) -> Bool:
    """Return True (B,) for chunks beyond a side of a fisheye's picture, or beyond its largest angle.

    The kernels bound a Gaussian by a rectangle in the picture, whose sides are along and across the direction from the
    axis to the mean. The rectangle reaches from radius `inner` to `outer`, and `aside` to both sides. If a Gaussian may
    contain the axis, or reach the largest angle, the kernels take a square around the axis. The bound here is then
    1.5 `outer` on all sides, which no corner of a Gaussian's rectangle exceeds. For a group of chunks it is 2.25
    `outer`, more than the bound by a chunk's rectangle, which is at most 2 `outer`.
    """
    camera, (x, y, z), fold = picture.camera, cones.middle, picture.camera.fold[0]
    widest = 1.5 / MIN_FISHEYE_SLOPE if any(camera.radial) else max(1.0, 0.5 / (math.pi * camera.fx))
    cap, whole = _caps(cones, picture, widest / min(camera.fx, camera.fy))
    across = np.sqrt(x * x + y * y)
    theta = np.arctan2(across, z)
    sine, spread_sine = across / cones.distance, cones.radius / cones.distance
    spread_cosine = np.sqrt(1 - spread_sine * spread_sine)
    least_sine = sine * spread_cosine - np.abs(z / cones.distance) * spread_sine  # min of sin(theta +- spread)
    ratio = np.sin(cap) / least_sine
    # sine of half of the angle that the means of a chunk cover around the axis
    turn_sine = spread_sine / sine + _ANGLE_SLACK
    turn_cosine = np.sqrt(1 - turn_sine * turn_sine)
    ring = (least_sine > 0) & (ratio < _POLE) & (turn_sine < 1)
    ring &= (theta - whole > _ANGLE_SLACK) & (theta + whole < fold - _ANGLE_SLACK)
    outer = _radius(camera, np.minimum(theta + whole, fold))
    inner = _radius(camera, np.maximum(theta - whole, 0.0)) * np.sqrt(1 - ratio * ratio)
    aside = outer * ratio
    beyond: Bool = theta - cones.spread - _ANGLE_SLACK > fold
    for along, slack, focal, borders in (
        (x / across, picture.slack[0], camera.fx, (picture.low[0], -picture.high[0])),
        (y / across, picture.slack[1], camera.fy, (picture.low[1], -picture.high[1])),
    ):
        turned = turn_sine * np.sqrt(1 - along * along)
        for side, border in zip((1, -1), borders, strict=True):
            # cosine of the smallest angle in the picture between the direction to a mean and the border's normal
            nearest = np.where(side * along > turn_cosine, 1.0, side * along * turn_cosine + turned)
            support = np.where(nearest > 0, outer, inner) * nearest + aside
            support = np.where(ring, support, 1.5 * cones.factor * outer)
            beyond |= focal * support + slack + _ROUNDING * focal < border
    return beyond


_ALONG_RAYS: dict[type[CameraModel], Callable[[_Cones, PictureBorders], Bool]] = {
    Equirectangular: _beyond_panorama,
    PerspectiveByRays: _beyond_borders,
    Fisheye: _beyond_fisheye,
}
"""By camera model along rays, the function that finds chunks beyond the picture's borders. For models that are not
listed, every chunk between the near and the far plane counts as visible."""
