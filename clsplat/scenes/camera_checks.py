# SPDX-License-Identifier: Apache-2.0
"""Checks of a data set's cameras: one-line warnings about implausible intrinsics, distortion and poses."""

from __future__ import annotations

from collections.abc import Callable, Sequence
from dataclasses import replace

import numpy as np

from clsplat.arrays import Float64
from clsplat.camera import Camera
from clsplat.config.training import Lenses
from clsplat.errors import examples, warn
from clsplat.rotations import quaternion_of, rotation_from_quaternion
from clsplat.scenes.dataset import (
    MIN_CENTRE_CHECK_SIDE_PX,
    MIN_FOCAL_PER_SIDE,
    Lens,
    PosedImage,
    pixels_of,
)

Named = tuple[str, Camera, Lens]
"""Name, camera and lens of a photograph."""
MIN_CHECKED_POSES = 4
"""Minimum number of cameras for a check of their poses."""
MAX_CHECKED_POSES = 40
"""Maximum number of cameras whose poses are checked, evenly spaced."""
MAX_POSE_CHECK_POINTS = 1000
"""Maximum number of points, evenly spaced, that the check of poses projects into the views."""
MIN_POSE_CHECK_POINTS = 30
"""Minimum number of points for a check of poses with points. With fewer, only the cameras are used."""
MIN_VISIBLE_POINT_FRACTION, MIN_VISIBLE_POINT_GAIN = 0.25, 4.0
"""Thresholds for suggesting another convention of the poses (POSE_MISREADINGS).

Another convention is suggested if, with it, views show on average at least the first fraction of the points. This must
also be at least the second number times the fraction that they show with the poses as given. The first threshold
excludes aerial surveys, where a picture shows about 1 % of the points with either convention.
"""
BLIND_VIEW_POINT_FRACTION, MIN_BLIND_VIEW_FRACTION = 0.01, 0.2
"""Fraction of visible points below which a view is blind, and fraction of blind views that makes the poses doubtful.

For doubtful poses, another convention is suggested if it leaves no view blind. In the tested captures each view shows
at least a quarter of the points.
"""
MAX_CONVERGING_FRACTION_AS_GIVEN, MIN_CONVERGING_FRACTION_INVERTED = 0.2, 0.9
"""Inverted poses are reported if at most the first fraction of the cameras faces a common point with the poses as
given. With the poses inverted, at least the second fraction must face a common point."""
PARALLEL_MEAN_AXIS_LENGTH = 0.7
"""Length of the mean optical axis above which the cameras look in the same direction, as along a facade.

Without points, the poses of such cameras are not checked, as their inverses may converge by chance.
"""
CENTRE_RATIO_TOLERANCE = 0.02
"""Relative tolerance between cx / width and cy / height. If these ratios agree but are not 1/2, (cx, cy) is the centre
of a picture of another size."""
FACING_COSINE = np.cos(np.deg2rad(20.0))
"""Cosine of the maximum angle between the optical axis and a point that a camera faces."""
MAX_EDGE_DISTORTION = 0.5
"""Maximum plausible distortion at the picture's edge, as a fraction of half the width or height."""
OPENGL_AXIS_SIGNS = np.array([1.0, -1.0, -1.0])
"""Signs that convert between COLMAP's and OpenGL's camera axes."""


def cameras_of(images: Sequence[PosedImage], lenses: Lenses = "undistort") -> dict[str, Camera]:
    """Return the images' cameras at full size (`Lens.camera`), keyed by image name. Warns of implausible cameras.

    lenses: "undistort" turns fisheyes into pinhole cameras, "native" keeps them.
    """
    by_lens = {
        lens: lens.camera(np.eye(3), np.zeros(3), lenses) for lens in dict.fromkeys(image.lens for image in images)
    }
    cameras = {
        image.name: replace(by_lens[image.lens], rotation=image.rotation, translation=image.translation)
        for image in images
    }
    named = [(image.name, cameras[image.name], image.lens) for image in images]
    for doubt in filter(None, (absurd([(name, lens) for name, _, lens in named]), *camera_checks(named))):
        warn(doubt)
    return cameras


def camera_checks(views: Sequence[Named], points: Float64 | None = None) -> list[str]:
    """Return warnings about implausible cameras.

    views: name, camera and lens of each photograph. Camera and lens may be for any size of the picture.
    points: (N, 3), the scene's points in world coordinates, if it has any.
    """
    flat = [(name, camera) for name, camera, _ in views if camera.is_pinhole]
    points = np.empty((0, 3)) if points is None else points[:: -(-len(points) // MAX_POSE_CHECK_POINTS) or 1]
    found = (_focal(views), _corner(views), _another_size(views), _poses(flat, points))
    return [text for text in found if text]


def _focal(views: Sequence[Named]) -> str:
    short = [
        (name, lens)
        for name, _, lens in views
        if not lens.is_panorama and lens.focal < MIN_FOCAL_PER_SIDE * max(lens.width, lens.height)
    ]
    if not short:
        return ""
    lens = short[0][1]
    return (
        f"the focal length of {examples(name for name, _ in short)} is {lens.focal:g} pixels for a picture of "
        f"{lens.width}x{lens.height}, too short for any lens: is it in millimetres, or in picture widths? Give it in "
        "pixels"
    )


def _corner(views: Sequence[Named]) -> str:
    odd = []
    for name, _, lens in views:
        x, y = (0.5 * lens.width, 0.5 * lens.height) if lens.is_panorama else lens.centre
        near = abs(x) < MIN_FOCAL_PER_SIDE * lens.width and abs(y) < MIN_FOCAL_PER_SIDE * lens.height
        part = 0 <= x <= 1 or 0 <= y <= 1  # True if x or y may be a fraction of the width or height
        if (near or part) and min(lens.width, lens.height) >= MIN_CENTRE_CHECK_SIDE_PX:
            odd.append((name, x, y, lens))
    if not odd:
        return ""
    _, x, y, lens = odd[0]
    return (
        f"the principal point (cx cy) of {examples(name for name, *_ in odd)} is {x:g} {y:g} in a picture of "
        f"{lens.width}x{lens.height}: is it relative to the middle, or a fraction? Give pixels from the top left corner"
    )


def _another_size(views: Sequence[Named]) -> str:
    odd = []
    for name, _, lens in views:
        if not lens.is_panorama and min(lens.width, lens.height) >= MIN_CENTRE_CHECK_SIDE_PX:
            part, other = lens.centre[0] / lens.width, lens.centre[1] / lens.height
            if MIN_FOCAL_PER_SIDE < part < 1 / 3 and abs(part - other) < CENTRE_RATIO_TOLERANCE * part:
                odd.append((name, lens))
    if not odd:
        return ""
    lens = odd[0][1]
    x, y = lens.centre
    return (
        f"the principal point (cx cy) of {examples(name for name, _ in odd)}, {x:g} {y:g}, is the middle of a picture "
        f"of {2 * x:g}x{2 * y:g} pixels, but 'w' and 'h' are {lens.width}x{lens.height}: do the intrinsics belong to "
        "another size? Give all intrinsics for the same size"
    )


def _poses(views: Sequence[tuple[str, Camera]], points: Float64) -> str:
    """Return a warning if the poses seem to follow another convention than COLMAP's (POSE_MISREADINGS), else "".

    With points, conventions are compared by the fraction of the points that the cameras see. If no other convention
    fits better, the result is a warning about views that see almost no points. Without points, conventions are compared
    by the fraction of cameras that face a common point.
    """
    flat = [camera for _, camera in views[:: -(-len(views) // MAX_CHECKED_POSES) or 1]]
    if len(flat) < MIN_CHECKED_POSES:
        return ""
    if len(points) >= MIN_POSE_CHECK_POINTS:
        shares = _shares(flat, points)
        ways = ((_shares(list(map(how, flat)), points), words) for words, how in POSE_MISREADINGS)
        others, words = max(ways, key=lambda way: float(way[0].mean()))
        given, best = shares.mean(), others.mean()
        some_blind = (shares < BLIND_VIEW_POINT_FRACTION).mean() >= MIN_BLIND_VIEW_FRACTION and not (
            others < BLIND_VIEW_POINT_FRACTION
        ).any()
        if best < MIN_VISIBLE_POINT_FRACTION or (best < MIN_VISIBLE_POINT_GAIN * given and not some_blind):
            return _blind(views, points)
        evidence = (
            f"the pictures show {100 * given:.0f} % of the points, but {100 * best:.0f} % if the poses have {words}"
        )
    else:
        if np.linalg.norm(np.mean([camera.rotation[2] for camera in flat], axis=0)) > PARALLEL_MEAN_AXIS_LENGTH:
            return ""
        inverted = (
            (_facing(list(map(how, flat))), words) for words, how in POSE_MISREADINGS if words == INVERTED_POSES
        )
        meeting, words = max(inverted)
        if meeting < MIN_CONVERGING_FRACTION_INVERTED or _facing(flat) > MAX_CONVERGING_FRACTION_AS_GIVEN:
            return ""
        evidence = (
            f"the cameras face no common point, but {100 * meeting:.0f} % of them face a common point if the poses "
            f"have {words}"
        )
    return f"{evidence}: was the file written like that? Export it again, or correct it"


def _blind(views: Sequence[tuple[str, Camera]], points: Float64) -> str:
    """Return a warning about views that show almost no points while the others show many, else ""."""
    shares = _shares([camera for _, camera in views], points)
    blind = shares < BLIND_VIEW_POINT_FRACTION
    if (
        not blind.any()
        or (~blind).sum() < MIN_CHECKED_POSES
        or (usual := np.median(shares[~blind])) < MIN_VISIBLE_POINT_FRACTION
    ):
        return ""
    names = examples(name for (name, _), none in zip(views, blind, strict=True) if none)
    return (
        f"{blind.sum():,} of {len(views):,} pictures ({names}) show almost none of the points, while the others show "
        f"about {100 * usual:.0f} %: the poses of the former are doubtful; correct them, or leave out these pictures"
    )


def _inverted(camera: Camera) -> Camera:
    turn = camera.rotation.T
    return replace(camera, rotation=turn, translation=-turn @ camera.translation)


def _flipped(camera: Camera) -> Camera:
    return replace(
        camera,
        rotation=OPENGL_AXIS_SIGNS[:, None] * camera.rotation,
        translation=OPENGL_AXIS_SIGNS * camera.translation,
    )


def _inverted_opengl(camera: Camera) -> Camera:
    """Return the camera with its pose corrected, assuming that its matrix in OpenGL's axes was inverted by mistake."""
    turned = _inverted(camera)
    return replace(
        turned,
        rotation=OPENGL_AXIS_SIGNS[:, None] * turned.rotation * OPENGL_AXIS_SIGNS,
        translation=OPENGL_AXIS_SIGNS * turned.translation,
    )


def _of_places(camera: Camera) -> Camera:
    """Return the camera with its pose corrected, assuming that the translation is in fact the camera's position."""
    return replace(camera, translation=-camera.rotation @ camera.translation)


def _of_last_w(camera: Camera) -> Camera:
    """Return the camera with its pose corrected, assuming that its quaternion x y z w was read as w x y z."""
    return replace(camera, rotation=rotation_from_quaternion(np.roll(quaternion_of(camera.rotation), 1)))


def _transposed(camera: Camera) -> Camera:
    return replace(camera, rotation=camera.rotation.T)


def _transposed_in_place(camera: Camera) -> Camera:
    turn = camera.rotation.T
    return replace(camera, rotation=turn, translation=-turn @ camera.position)


def _transposed_opengl(camera: Camera) -> Camera:
    """Return the camera with its pose corrected, assuming that its rotation in OpenGL's axes was transposed."""
    turn = OPENGL_AXIS_SIGNS[:, None] * camera.rotation.T * OPENGL_AXIS_SIGNS
    return replace(camera, rotation=turn, translation=-turn @ camera.position)


INVERTED_POSES = "inverted matrices (camera from world in place of world from camera, or the other way round)"
TRANSPOSED_ROTATIONS = "transposed rotations (camera from world in place of world from camera, or the other way round)"
POSE_MISREADINGS: tuple[tuple[str, Callable[[Camera], Camera]], ...] = (
    (INVERTED_POSES, _inverted),
    (INVERTED_POSES, _inverted_opengl),
    ("the other camera axes (y is down and z ahead in COLMAP and OpenCV, y up and z back in OpenGL)", _flipped),
    ("camera positions in place of translations", _of_places),
    ("quaternions in the order x y z w (COLMAP's order is w x y z)", _of_last_w),
    (TRANSPOSED_ROTATIONS, _transposed),
    (TRANSPOSED_ROTATIONS, _transposed_in_place),
    (TRANSPOSED_ROTATIONS, _transposed_opengl),
)
"""Common mistakes in poses: the description of each, for messages, and a function that corrects a camera's pose."""


def _shares(cameras: Sequence[Camera], points: Float64) -> Float64:
    """Return the fraction of the points (N, 3) that each camera sees, as an array with one value per camera."""
    return np.array([pixels_of(points, camera)[2].mean() for camera in cameras])


def _facing(cameras: Sequence[Camera]) -> float:
    """Return the fraction of the cameras that face a common point, the point nearest to all optical axes.

    A camera is never counted if it is nearer to the common point than about half the median distance of the cameras
    from their middle.
    """
    centres = np.stack([camera.position for camera in cameras])
    axes = np.stack([camera.rotation[2] for camera in cameras])
    across = np.eye(3) - axes[:, :, None] * axes[:, None, :]
    if np.linalg.eigvalsh(across.mean(axis=0))[0] < 1e-3:  # the axes are parallel, so that no point is nearest
        return 0.0
    focus = np.linalg.solve(across.sum(axis=0), (across @ centres[:, :, None]).sum(axis=0)[:, 0])
    away = focus - centres
    distances = np.linalg.norm(away, axis=1)
    spread = float(np.median(np.linalg.norm(centres - np.median(centres, axis=0), axis=1)))
    if spread == 0:
        return 0.0
    return float(((away * axes).sum(axis=1) > FACING_COSINE * np.maximum(distances, 0.5 * spread)).mean())


def absurd(lenses: Sequence[tuple[str, Lens]]) -> str:
    """Return a warning about lenses with implausible distortion, else "".

    lenses: pairs of a picture's name and its lens.
    """
    bend = {lens: _bends(lens) for lens in {lens for _, lens in lenses}}
    bent = [(name, lens) for name, lens in lenses if bend[lens]]
    if not bent:
        return ""
    lens = bent[0][1]
    params = " ".join(f"{value:g}" for value in lens.params)
    return (
        f"the lens of {examples(name for name, _ in bent)} distorts the picture implausibly ({lens.model} {params}): "
        "check its coefficients and their order"
    )


def _bends(lens: Lens) -> bool:
    """Return True if the lens moves the picture's edge by over MAX_EDGE_DISTORTION, compared with a pinhole camera.

    Returns False for fisheyes and similar models, which distort by design.
    """
    if lens.is_pinhole or lens.is_bent_by_design:
        return False
    pinhole = lens.pinhole(np.eye(3), np.zeros(3))
    half = np.array([lens.width, lens.height]) / 2
    edge = half * np.array([[x, y] for x in (-1, 0, 1) for y in (-1, 0, 1)])
    rays = np.concatenate([edge / [pinhole.fx, pinhole.fy], np.ones((len(edge), 1))], axis=1)
    pixels = lens.img_from_cam(rays)
    moved = pixels - pixels[len(pixels) // 2] - edge
    return not bool((np.abs(moved) <= MAX_EDGE_DISTORTION * half).all())
