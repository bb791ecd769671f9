# SPDX-License-Identifier: Apache-2.0
"""Chunks that a camera may see: all but those of which no row can reach a tile of the picture.

The bounds are of what kernels/project.cl and project_rays.cl compute, so a chunk is left out only if they would count
no tile for each of its rows. Opacities count as 1, and rotations of Gaussians as unknown.
"""

from __future__ import annotations

import math
from collections.abc import Callable
from dataclasses import dataclass

import numpy as np

from clsplat.arrays import Bool, Float64
from clsplat.camera import Camera, Window
from clsplat.cameras.equirectangular import Equirectangular
from clsplat.cameras.fisheye import MIN_FISHEYE_SLOPE, Fisheye, radii
from clsplat.cameras.model import CameraModel
from clsplat.cameras.perspective import PerspectiveByRays
from clsplat.chunks.bounds import ChunkBounds
from clsplat.config.rasterizer import RasterizerConfig
from clsplat.layouts.columns import TILE

_DEFAULT_RASTERIZER = RasterizerConfig()
_LOW_PASS_ROOT = math.sqrt(0.3)
"""Root of the larger variance, in px^2, that projection adds (LOW_PASS in kernels/shared/gaussian.h)."""
_REACH_SLACK = 1.001
"""Factor of a Gaussian's reach. The kernels round it by 1e-4 at most, and along rays enlarge it by as much."""
_ROUNDING = 1e-5
"""Slack relative to the terms of a plane. A mean in two floats is rounded to float32 at the end, by 6e-8."""
_CANCELLED = 1e-11
"""Slack relative to coordinates in the world, which may cancel in the camera: what two floats, and float64, round."""
_ANGLE_SLACK = 1e-4
"""Slack of directions in radians. In float32 they are rounded by 1e-6, and 22 times that near a pole."""
_LEAST_AHEAD = 2e-4
"""Tangent of the angle to the plane z = 0 under which an end of a box along rays is infinite (LEAST_AHEAD in
kernels/shared/camera/perspective_rays.h), doubled."""
_POLE = 0.99
"""Sine of a cone over that of its middle's angle to an axis, from which the cone counts as containing the axis. The
kernels do so from 0.999."""


@dataclass(frozen=True, eq=False)
class _Boxes:
    """Boxes of B chunks in a camera's axes, and the camera's picture.

    world: (B, 3) each, middle and half sides of the boxes in the world.
    middle, half: (B, 3), of boxes along the camera's axes around those.
    radius: (B,), of spheres around those in the world.
    size: (B,), the largest standard deviation in the camera's axes.
    rounding: (B,), the rounding error of a mean in the camera's axes.
    reach: standard deviations at which a Gaussian ends.
    low, high: (2,), borders of the tiles in pixels, from the principal point.
    slack: (2,), rounding of a place on the picture in pixels, of places in and around it.
    """

    camera: Camera
    world: tuple[Float64, Float64]
    middle: Float64
    half: Float64
    radius: Float64
    size: Float64
    rounding: Float64
    reach: float
    low: Float64
    high: Float64
    slack: Float64


def visible(
    bounds: ChunkBounds,
    camera: Camera,
    config: RasterizerConfig = _DEFAULT_RASTERIZER,
    opacity_factor: float = 1.0,
) -> Bool:
    """True (B,) for chunks that may have a row with a tile in the camera's picture; False only if none has one.

    Chunks whose bounds are not finite are visible. Rows appended to a chunk must be in its bounds.

    config: the rasterizer's settings, on which a Gaussian's reach depends.
    opacity_factor: the factor by which the pass multiplies opacities (thinning), at least 1.
    """
    switches = config.switches()
    if not switches.frustum_cull or len(bounds) == 0:
        return np.ones(len(bounds), np.bool_)
    reach = 3.0 if switches.extent == "3sigma" else math.sqrt(2 * math.log(opacity_factor / switches.alpha_min))
    with np.errstate(all="ignore"):  # what is not finite compares as visible
        boxes = _boxes(bounds, camera, reach * _REACH_SLACK)
        hidden = _out_of_depth(boxes)
        if camera.model.along_rays:
            for kind, beyond in _ALONG_RAYS.items():
                if isinstance(camera.model, kind):
                    hidden |= beyond(boxes)
        elif camera.model.is_pinhole or camera.model.parallel:
            hidden |= _beyond_planes(boxes, square=switches.tile_test == "square")
        return ~hidden | ~bounds.finite


def _boxes(bounds: ChunkBounds, camera: Camera, reach: float) -> _Boxes:
    window = camera.window or Window(0, 0, camera.width, camera.height)
    corner = np.array([window.x - camera.cx, window.y - camera.cy])
    tiles = -(-np.array([camera.width, camera.height]) // TILE)
    middle, half = 0.5 * (bounds.lowest + bounds.highest), 0.5 * (bounds.highest - bounds.lowest)
    stretch = float(np.linalg.norm(camera.rotation, 2))  # a pose may be off a rotation by a little
    rounding = _CANCELLED * ((np.abs(middle) + half).sum(axis=1) + np.abs(camera.translation).sum())
    centre, high = np.abs([camera.cx, camera.cy]), corner + TILE * tiles
    return _Boxes(
        camera=camera,
        world=(middle, half),
        middle=middle @ camera.rotation.T + camera.translation,
        half=half @ np.abs(camera.rotation).T + rounding[:, None],
        radius=stretch * np.sqrt((half * half).sum(axis=1)) + 2 * rounding,
        size=stretch * np.exp(bounds.largest),
        rounding=rounding,
        reach=reach,
        low=corner,
        high=high,
        slack=_ROUNDING * (centre + np.abs(corner) + np.abs(high)),
    )


def _beyond_planes(boxes: _Boxes, *, square: bool) -> Bool:
    """True (B,) for chunks beyond a side of the picture on an image plane.

    By (2) to (6) of docs/gradients.md, the half width of an ellipse is at most k (f sqrt(1 + r^2) s / z + b), with
    k the reach, s the largest scale, r the limit of x/z in the Jacobian, and b^2 the low-pass. An ellipse reaches the
    left border l, from the principal point, if f x/z + k (f sqrt(1 + r^2) s / z + b) >= l. Times z > 0 this is

        f x + (k b - l) z + k f sqrt(1 + r^2) s >= 0,

    which is linear in the mean: a box is beyond the border if its farthest corner along (f, 0, k b - l) is. Means
    beyond the left border have r between the Jacobian's limit and the border. For parallel rays z is 1 and r is 0.

    square: True if Gaussians are listed in the square of their longest half axis, which is at most the root of the sum
    of both half axes' squares.
    """
    camera, parallel = boxes.camera, boxes.camera.model.parallel
    limits, blur = camera.frustum_limits, boxes.reach * _LOW_PASS_ROOT
    normals, offsets, slopes = np.zeros((4, 3)), np.zeros(4), np.zeros(4)
    for axis, focal in enumerate((camera.fx, camera.fy)):
        for side, border in ((1, boxes.low[axis]), (-1, boxes.high[axis])):
            plane = 2 * axis + (side < 0)
            normals[plane, axis] = side * focal
            (offsets if parallel else normals[:, 2])[plane] = blur - side * border
            nearest = np.clip(border / focal, limits[0, axis], limits[1, axis])
            farthest = limits[0 if side > 0 else 1, axis]
            slopes[plane] = focal * (1.0 if parallel else math.hypot(1.0, max(abs(nearest), abs(farthest))))
    if square:
        steepest = 1.0 if parallel else math.hypot(1.0, *np.abs(limits).max(axis=0))
        slopes[:] = math.hypot(camera.fx, camera.fy) * steepest
    middle, half = boxes.world
    in_world = normals @ camera.rotation
    farthest_corner = middle @ in_world.T + half @ np.abs(in_world).T + (normals @ camera.translation + offsets)
    farthest_corner += boxes.reach * boxes.size[:, None] * slopes + boxes.rounding[:, None] * np.abs(normals).sum(
        axis=1
    )
    farthest = np.abs(boxes.middle) + boxes.half
    slack = _ROUNDING * (farthest @ np.abs(normals).T + np.abs(offsets))
    slack += boxes.slack.max() * (1.0 if parallel else farthest[:, 2:])
    return np.asarray((farthest_corner + slack < 0).any(axis=1))


def _out_of_depth(boxes: _Boxes) -> Bool:
    """True (B,) for chunks before the near or beyond the far plane."""
    camera, distance = boxes.camera, np.linalg.norm(boxes.middle, axis=1)
    depth, half = (boxes.middle[:, 2], boxes.half[:, 2]) if camera.model.flat else (distance, boxes.radius)
    slack = _ROUNDING * (np.abs(depth) + half)
    far = min(camera.far, float(np.finfo(np.float32).max))
    out: Bool = (depth + half + slack < max(camera.near, 0.0)) | (depth - half - slack > far)
    return out


@dataclass(frozen=True, eq=False)
class _Cones:
    """Cones around the directions of B chunks' middles, with angles in radians. NaN where there is no such cone.

    spread: (B,), half angle of the cone of all means.
    cap: (B,), largest half angle of the cone of a Gaussian around its mean.
    whole: (B,), half angle of the cone of all Gaussians, less than 90 degrees.
    """

    spread: Float64
    cap: Float64
    whole: Float64


def _cones(boxes: _Boxes, pixel: float) -> _Cones:
    """The cones, from (12) and (13) of docs/cameras.md.

    A Gaussian's ellipse lies in the plane that touches the unit sphere at its mean's direction, and a ray reaches it at
    the tangent of the angle between both. The ellipse's half axis is at most k (s / d + b w), with k the reach, s the
    largest scale, d the distance, b^2 the low-pass and w the pixel's width.

    pixel: the largest width of a pixel on the tangent plane, in radians.
    """
    distance = np.linalg.norm(boxes.middle, axis=1)
    to_box = np.linalg.norm(np.maximum(np.abs(boxes.middle) - boxes.half, 0.0), axis=1)
    least = np.maximum(np.maximum(distance - boxes.radius, to_box), boxes.camera.near) * (1 - _ROUNDING)
    spread = np.arcsin(boxes.radius / distance)  # NaN if the camera is inside
    cap = np.arctan(boxes.reach * (boxes.size / least + _LOW_PASS_ROOT * pixel)) + _ANGLE_SLACK
    whole = spread + cap
    return _Cones(spread, cap, np.where(whole < 0.5 * math.pi, whole, np.nan))


def _half_turn(cones: _Cones, level: Float64) -> Float64:
    """Half of the angle (B,) that the cones cover around an axis; NaN for a cone that nearly contains the axis.

    The cones of single Gaussians then contain it even less: sin(whole - spread) / sin(a - spread) falls with the
    spread, if the angle a to the axis is larger than the whole.

    level: (B,), sine of the angle between a cone's middle and the axis.
    """
    ratio = np.sin(cones.whole) / level
    return np.where(ratio < _POLE, np.arcsin(ratio), np.nan) + _ANGLE_SLACK


def _beyond_panorama(boxes: _Boxes) -> Bool:
    """True (B,) for chunks that a part of a panorama does not show: above, below or beside it, at any turn."""
    camera, (x, y, z) = boxes.camera, boxes.middle.T
    focal = np.array([camera.fx, camera.fy])
    cones = _cones(boxes, max(max(1.0, 0.5 / camera.fy) / camera.fx, 1 / camera.fy))
    across = np.hypot(x, z)
    latitude, longitude = np.arctan2(y, across), np.arctan2(x, z)
    slack = boxes.slack + _ROUNDING * 2 * math.pi * focal
    beyond: Bool = camera.fy * (latitude + cones.whole) + slack[1] < boxes.low[1]
    beyond |= camera.fy * (latitude - cones.whole) - slack[1] > boxes.high[1]
    turn = 2 * math.pi * camera.fx
    away = camera.fx * longitude - 0.5 * (boxes.low[0] + boxes.high[0])
    away = np.abs(away - turn * np.round(away / turn))
    aside = camera.fx * _half_turn(cones, across / np.hypot(across, y))
    beyond |= away - aside - slack[0] > 0.5 * (boxes.high[0] - boxes.low[0])
    return beyond


def _beyond_borders(boxes: _Boxes) -> Bool:
    """True (B,) for chunks beyond a side of a perspective picture along rays.

    A border is an angle in the plane of its axis and z. The kernels take a Gaussian's box as infinite where it comes
    near z = 0, so chunks with means near it are visible.
    """
    camera = boxes.camera
    cones = _cones(boxes, 1 / min(camera.fx, camera.fy))
    distance = np.linalg.norm(boxes.middle, axis=1)
    least = np.maximum(boxes.middle[:, 2] - boxes.half[:, 2], camera.near)
    beyond = np.zeros(len(distance), np.bool_)
    steepest = 0.5 * math.pi - _LEAST_AHEAD
    for axis, focal in enumerate((camera.fx, camera.fy)):
        along = boxes.middle[:, axis]
        ahead = least > _LEAST_AHEAD * (np.abs(along) + boxes.half[:, axis])
        angle = np.arctan2(along, boxes.middle[:, 2])
        aside = _half_turn(cones, np.hypot(along, boxes.middle[:, 2]) / distance)
        low, high = (boxes.low[axis] - boxes.slack[axis]) / focal, (boxes.high[axis] + boxes.slack[axis]) / focal
        beyond |= ahead & (angle + aside < min(math.atan(low), steepest))
        beyond |= ahead & (angle - aside > max(math.atan(high), -steepest))
    return beyond


def _beyond_fisheye(boxes: _Boxes) -> Bool:
    """True (B,) for chunks that a fisheye does not show: beyond a side of its picture, or beyond its largest angle.

    The kernels bound a Gaussian by a rectangle along its mean's direction on the picture: from `inner` to `outer`, and
    `aside` to both sides. If a Gaussian may contain the axis, or reach the largest angle, the bound is a square around
    the axis. The rectangle's corner is then at most 1.5 times as far out as the square's side.
    """
    camera, (x, y, z), fold = boxes.camera, boxes.middle.T, boxes.camera.fold[0]
    widest = 1.5 / MIN_FISHEYE_SLOPE if any(camera.radial) else max(1.0, 0.5 / (math.pi * camera.fx))
    cones = _cones(boxes, widest / min(camera.fx, camera.fy))
    theta, azimuth = np.arctan2(np.hypot(x, y), z), np.arctan2(y, x)
    least_sine = np.minimum(np.sin(theta - cones.spread), np.sin(theta + cones.spread))
    ratio = np.sin(cones.cap) / least_sine
    ring = (least_sine > 0) & (ratio < _POLE)
    ring &= (theta - cones.whole > _ANGLE_SLACK) & (theta + cones.whole < fold - _ANGLE_SLACK)
    outer = radii(camera, np.minimum(theta + cones.whole, fold))[0]
    inner = radii(camera, np.maximum(theta - cones.whole, 0.0))[0] * np.sqrt(1 - ratio**2)
    half_turn = np.arcsin(np.sin(cones.spread) / np.sin(theta)) + _ANGLE_SLACK
    beyond: Bool = theta - cones.spread - _ANGLE_SLACK > fold
    for axis, focal in enumerate((camera.fx, camera.fy)):
        for side, border in ((1, boxes.low[axis]), (-1, -boxes.high[axis])):
            away = np.abs(np.angle(np.exp(1j * (azimuth - 0.5 * math.pi * axis - (0 if side > 0 else math.pi)))))
            first, last = away - half_turn, away + half_turn
            cosine = np.cos(np.maximum(first, 0.0))
            sine = np.maximum(np.abs(np.sin(first)), np.abs(np.sin(last)))
            sine = np.where((first < 0.5 * math.pi) & (last > 0.5 * math.pi), 1.0, sine)
            support = np.where(cosine > 0, outer, inner) * cosine + sine * outer * ratio
            support = np.where(ring, support, 1.5 * outer)
            beyond |= focal * support + boxes.slack[axis] + _ROUNDING * focal < border
    return beyond


_ALONG_RAYS: dict[type[CameraModel], Callable[[_Boxes], Bool]] = {
    Equirectangular: _beyond_panorama,
    PerspectiveByRays: _beyond_borders,
    Fisheye: _beyond_fisheye,
}
"""For models along rays: the chunks that are beyond their pictures. Of other models along rays every chunk counts as
visible between the near and the far plane."""
