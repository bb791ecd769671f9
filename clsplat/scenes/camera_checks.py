# SPDX-License-Identifier: Apache-2.0
"""Cameras of pictures, and warnings of those that cannot be right: by their numbers, and by what they see of the
points. A line each."""

from __future__ import annotations

from collections.abc import Callable, Sequence
from dataclasses import replace

import numpy as np

from clsplat.arrays import Float64
from clsplat.camera import Camera
from clsplat.config.training import Lenses
from clsplat.errors import examples, warn
from clsplat.rotations import quaternion_of, rotation_from_quaternion
from clsplat.scenes.data_set import PANORAMA, SHORTEST, SMALLEST, Lens, PosedImage, pixels_of

Named = tuple[str, Camera, Lens]
FEWEST = 4
"""Cameras without which nothing is said of their poses."""
LOOKED_AT = 40
"""Cameras that are looked through, spread evenly."""
POINTS = 1000
"""Points that are looked for, spread evenly; with fewer than LEAST_POINTS poses are judged by the cameras alone."""
LEAST_POINTS = 30
SEEN, TIMES = 0.25, 4.0
"""Share of the points that the mean picture shows at least if poses are taken another way, and how many times as much
as the poses as given. Pictures of a survey show a hundredth each, either way."""
LITTLE, BLIND = 0.01, 0.2
"""A picture shows nothing of the points with under this share of them; a way in which all pictures show more is told
from this share of such pictures on. In the captures tried each shows a quarter at least."""
FACING, MEETING = 0.2, 0.9
"""Shares of the cameras that face one point: at most as given, and at least with the poses turned round."""
ASTRAY = 0.7
"""Length of the cameras' mean axis from which on they look one way, as in front of a facade or from a drone. There
poses that are turned round meet by chance."""
ALIKE = 0.02
"""Part by which a principal point's place across and down may differ where both are those of a smaller picture."""
AIM = np.cos(np.deg2rad(20.0))
"""Cosine of the angle to its axis within which a camera faces a point."""
BENT = 0.5
"""Half widths or heights of the picture by which a lens may move what is at its edge."""
FLIP = np.array([1.0, -1.0, -1.0])
"""Signs between COLMAP's camera axes and OpenGL's."""


def cameras_of(images: Sequence[PosedImage], lenses: Lenses = "undistort") -> dict[str, Camera]:
    """The cameras that the images become, as of `Lens.camera`, at full size, by name. Warns of cameras that cannot be
    right."""
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
    """Warnings about the cameras of pictures, at any size, by name. points: (N, 3) of the world, if there are any."""
    flat = [(name, camera) for name, camera, _ in views if camera.projection == "perspective"]
    points = np.empty((0, 3)) if points is None else points[:: -(-len(points) // POINTS) or 1]
    found = (_focal(views), _corner(views), _another_size(views), _poses(flat, points))
    return [text for text in found if text]


def _focal(views: Sequence[Named]) -> str:
    short = [
        (name, lens)
        for name, _, lens in views
        if lens.model != PANORAMA and lens.focal < SHORTEST * max(lens.width, lens.height)
    ]
    if not short:
        return ""
    lens = short[0][1]
    return (
        f"the focal length of {examples(name for name, _ in short)} is {lens.focal:g} pixels in {lens.width} x "
        f"{lens.height}, which no lens has: is it in millimetres, or a part of the width? Give it in pixels"
    )


def _corner(views: Sequence[Named]) -> str:
    odd = []
    for name, _, lens in views:
        x, y = (0.5 * lens.width, 0.5 * lens.height) if lens.model == PANORAMA else lens.centre
        near = abs(x) < SHORTEST * lens.width and abs(y) < SHORTEST * lens.height
        part = 0 <= x <= 1 or 0 <= y <= 1  # of the width or height, one of them alone
        if (near or part) and min(lens.width, lens.height) >= SMALLEST:
            odd.append((name, x, y, lens))
    if not odd:
        return ""
    _, x, y, lens = odd[0]
    return (
        f"the principal point (cx cy) of {examples(name for name, *_ in odd)} lies at {x:g} {y:g} of {lens.width} x "
        f"{lens.height} pixels: is it the distance from the middle, or a part? Give pixels from the upper left corner"
    )


def _another_size(views: Sequence[Named]) -> str:
    odd = []
    for name, _, lens in views:
        if lens.model != PANORAMA and min(lens.width, lens.height) >= SMALLEST:
            part, other = lens.centre[0] / lens.width, lens.centre[1] / lens.height
            if SHORTEST < part < 1 / 3 and abs(part - other) < ALIKE * part:
                odd.append((name, lens))
    if not odd:
        return ""
    lens = odd[0][1]
    x, y = lens.centre
    return (
        f"the principal point (cx cy) of {examples(name for name, _ in odd)}, {x:g} {y:g}, is the middle of {2 * x:g} "
        f"x {2 * y:g} pixels, and 'w' and 'h' are {lens.width} x {lens.height}: are they of another size than the "
        "focal lengths? Give all of one size"
    )


def _poses(views: Sequence[tuple[str, Camera]], points: Float64) -> str:
    """A doubt whether the poses mean what they are taken for: by the points that the pictures show if they are taken
    another way, or without points by the cameras that face one place. If only some are odd, these."""
    flat = [camera for _, camera in views[:: -(-len(views) // LOOKED_AT) or 1]]
    if len(flat) < FEWEST:
        return ""
    if len(points) >= LEAST_POINTS:
        shares = _shares(flat, points)
        ways = ((_shares(list(map(how, flat)), points), words) for words, how in OTHER_WAYS)
        others, words = max(ways, key=lambda way: float(way[0].mean()))
        given, best = shares.mean(), others.mean()
        some_blind = (shares < LITTLE).mean() >= BLIND and not (others < LITTLE).any()
        if best < SEEN or (best < TIMES * given and not some_blind):
            return _blind(views, points)
        evidence = (
            f"the pictures show {100 * given:.0f} % of the points, and {100 * best:.0f} % if the poses are {words}"
        )
    else:
        if np.linalg.norm(np.mean([camera.rotation[2] for camera in flat], axis=0)) > ASTRAY:
            return ""
        inverted = ((_facing(list(map(how, flat))), words) for words, how in OTHER_WAYS if words == INVERTED)
        meeting, words = max(inverted)
        if meeting < MEETING or _facing(flat) > FACING:
            return ""
        evidence = (
            f"the cameras face nothing in common, and {100 * meeting:.0f} % face one place if the poses are {words}"
        )
    return f"{evidence}: is that how they were exported? Export them again, or correct the file"


def _blind(views: Sequence[tuple[str, Camera]], points: Float64) -> str:
    """A doubt about the poses of the pictures that show none of the points, where the others show many."""
    shares = _shares([camera for _, camera in views], points)
    blind = shares < LITTLE
    if not blind.any() or (~blind).sum() < FEWEST or (usual := np.median(shares[~blind])) < SEEN:
        return ""
    names = examples(name for (name, _), none in zip(views, blind, strict=True) if none)
    return (
        f"{blind.sum():,} of {len(views):,} pictures show none of the points, or nearly, where the others show about "
        f"{100 * usual:.0f} % ({names}): their poses are in doubt; correct them, or leave them out"
    )


def _inverted(camera: Camera) -> Camera:
    turn = camera.rotation.T
    return replace(camera, rotation=turn, translation=-turn @ camera.translation)


def _flipped(camera: Camera) -> Camera:
    return replace(camera, rotation=FLIP[:, None] * camera.rotation, translation=FLIP * camera.translation)


def _inverted_opengl(camera: Camera) -> Camera:
    """The pose of a camera whose matrix in OpenGL's axes was taken the wrong way round."""
    turned = _inverted(camera)
    return replace(turned, rotation=FLIP[:, None] * turned.rotation * FLIP, translation=FLIP * turned.translation)


def _of_places(camera: Camera) -> Camera:
    """The camera whose place was given where its translation is expected."""
    return replace(camera, translation=-camera.rotation @ camera.translation)


def _of_last_w(camera: Camera) -> Camera:
    """The camera whose quaternion was given as x y z w and read as w x y z."""
    return replace(camera, rotation=rotation_from_quaternion(np.roll(quaternion_of(camera.rotation), 1)))


def _transposed(camera: Camera) -> Camera:
    return replace(camera, rotation=camera.rotation.T)


def _transposed_in_place(camera: Camera) -> Camera:
    turn = camera.rotation.T
    return replace(camera, rotation=turn, translation=-turn @ camera.position)


def _transposed_opengl(camera: Camera) -> Camera:
    """The camera of `_transposed_in_place`, of a matrix in OpenGL's axes."""
    turn = FLIP[:, None] * camera.rotation.T * FLIP
    return replace(camera, rotation=turn, translation=-turn @ camera.position)


INVERTED = "inverted (camera from world in place of world from camera, or the other way round)"
TRANSPOSED = "of transposed rotations (camera from world in place of world from camera, or the other way round)"
OTHER_WAYS: tuple[tuple[str, Callable[[Camera], Camera]], ...] = (
    (INVERTED, _inverted),
    (INVERTED, _inverted_opengl),
    ("in the other camera axes (COLMAP's and OpenCV's have y down and z ahead, OpenGL's y up and z back)", _flipped),
    ("of the cameras' places where translations are expected", _of_places),
    ("of quaternions in the order x y z w (COLMAP's is w x y z)", _of_last_w),
    (TRANSPOSED, _transposed),
    (TRANSPOSED, _transposed_in_place),
    (TRANSPOSED, _transposed_opengl),
)
"""Ways in which poses are mistaken for others, in words and as a change of the camera."""


def _shares(cameras: Sequence[Camera], points: Float64) -> Float64:
    """Share of the points that each picture shows, (cameras,)."""
    return np.array([pixels_of(points, camera)[2].mean() for camera in cameras])


def _facing(cameras: Sequence[Camera]) -> float:
    """Share of the cameras that face the point nearest to all optical axes, from as far as they are spread."""
    centres = np.stack([camera.position for camera in cameras])
    axes = np.stack([camera.rotation[2] for camera in cameras])
    across = np.eye(3) - axes[:, :, None] * axes[:, None, :]
    if np.linalg.eigvalsh(across.mean(axis=0))[0] < 1e-3:  # parallel axes meet nowhere
        return 0.0
    focus = np.linalg.solve(across.sum(axis=0), (across @ centres[:, :, None]).sum(axis=0)[:, 0])
    away = focus - centres
    distances = np.linalg.norm(away, axis=1)
    spread = float(np.median(np.linalg.norm(centres - np.median(centres, axis=0), axis=1)))
    if spread == 0:
        return 0.0
    return float(((away * axes).sum(axis=1) > AIM * np.maximum(distances, 0.5 * spread)).mean())


def absurd(lenses: Sequence[tuple[str, Lens]]) -> str:
    """A warning of the pictures whose lens bends beyond reason, or nothing. lenses: with the pictures' names."""
    bend = {lens: _bends(lens) for lens in {lens for _, lens in lenses}}
    bent = [(name, lens) for name, lens in lenses if bend[lens]]
    if not bent:
        return ""
    lens = bent[0][1]
    params = " ".join(f"{value:g}" for value in lens.params)
    return (
        f"the lens of {examples(name for name, _ in bent)} bends the picture beyond reason ({lens.model} {params}): "
        "check its coefficients, and their order"
    )


def _bends(lens: Lens) -> bool:
    """True if the lens moves what a pinhole camera of its focal length has at the picture's edge by a large part of it.
    Fisheyes and the like are meant to, and count as False."""
    if lens.is_pinhole or lens.model in ("FOV", "EUCM", PANORAMA) or "FISHEYE" in lens.model:
        return False
    pinhole = lens.pinhole(np.eye(3), np.zeros(3))
    half = np.array([lens.width, lens.height]) / 2
    edge = half * np.array([[x, y] for x in (-1, 0, 1) for y in (-1, 0, 1)])
    rays = np.concatenate([edge / [pinhole.fx, pinhole.fy], np.ones((len(edge), 1))], axis=1)
    pixels = lens.img_from_cam(rays)
    moved = pixels - pixels[len(pixels) // 2] - edge
    return not bool((np.abs(moved) <= BENT * half).all())
