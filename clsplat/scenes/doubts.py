# SPDX-License-Identifier: Apache-2.0
"""Doubts about a scene: what makes a training fail without an error. They are looked for in the scene before the first
step, and in the pictures after some. A line each, which says what to do."""

from __future__ import annotations

from collections.abc import Callable, Sequence
from pathlib import Path
from typing import TYPE_CHECKING, Any

import numpy as np
from numpy.typing import NDArray

from clsplat.camera import Camera
from clsplat.config.training import Background
from clsplat.errors import InputError, examples
from clsplat.images.alpha import background_colour, composite
from clsplat.scenes.camera_checks import absurd
from clsplat.scenes.point_files import count_points

if TYPE_CHECKING:
    from clsplat.scenes.scene import Scene, View

LOOK_AT = 100
"""Steps after which the pictures are looked at for the first time."""
LOOKED_AT = 8
"""Views that are looked at, spread evenly."""
SMALLER = 4
"""Factor by which the pictures are made smaller to be looked at."""
MANY_POINTS = 1_000_000
"""Points beyond which trainings hardly gain: published models of whole rooms and gardens have 1 to 6 million Gaussians
at their end, from 50,000 to 200,000 points."""
COINCIDENT = 0.05
"""Part of the points that may lie where another one does."""
BEYOND = 0.5
"""Widths, or heights, of the picture that a principal point may lie beyond its edge."""
WHITE, BLACK = 0.98, 0.02
"""A channel is taken for white from the first on, and for black up to the second."""
BORDER = 0.9
"""Part of the pictures' border that is the background, where it is one."""


def of_scene(scene: Scene, background: Background) -> list[str]:
    """Doubts about the scene's points, cameras and photographs, or about the background for them."""
    lenses = absurd([(view.name, view.lens) for view in scene.views])
    looked = spread(scene.train_views, LOOKED_AT)
    pictures = [_pixels(view) for view in looked]
    doubts = (
        _many_points(scene),
        _other_clouds(scene),
        _coincident(scene),
        _principal_points(scene),
        lenses,
        _one_place(scene),
        _empty(looked, pictures, background),
        _background(pictures, background),
    )
    return [text for text in doubts if text]


def of_pictures(
    draw: Callable[[Camera], tuple[NDArray[Any], NDArray[Any]]], views: Sequence[View], kind: str = "training"
) -> str:
    """A doubt about a model's pictures of these views, or nothing. draw: image (H, W, 3) and alpha (H, W) of a camera;
    kind: the name of the views in the message."""
    looked = spread(views, LOOKED_AT)
    drawn = [draw(_small(view.camera)) for view in looked]
    if not any(alpha.any() for _, alpha in drawn):
        return (
            f"no Gaussian is seen by any of the {len(looked)} {kind} views that were looked at: the points do not "
            "lie before the cameras; check that both have the same axes, scale and origin"
        )
    if all(_is_flat(image) for image, _ in drawn) and not all(_is_flat(_pixels(view)) for view in looked):
        return (
            f"the pictures of all {len(looked)} {kind} views that were looked at are of one colour, and the "
            "photographs are not: check that cameras and points belong together, and settings other than the defaults"
        )
    return ""


def spread(views: Sequence[View], count: int) -> list[View]:
    """At most `count` of the views, spread evenly."""
    return [views[index] for index in np.unique(np.linspace(0, len(views) - 1, min(count, len(views))).astype(int))]


def _small(camera: Camera) -> Camera:
    return camera.resized(max(camera.width // SMALLER, 1), max(camera.height // SMALLER, 1))


def _pixels(view: View) -> NDArray[np.float32]:
    small = _small(view.camera)
    return view.load(small.width, small.height)


def _is_flat(image: NDArray[Any]) -> bool:
    """True if no pixel differs by a step of 8 bits from another."""
    return bool(np.ptp(image.reshape(-1, image.shape[2]), axis=0).max() < 1 / 255)


def _many_points(scene: Scene) -> str:
    if len(scene.points) <= MANY_POINTS:
        return ""
    return (
        f"{len(scene.points):,} points to start from are a Gaussian each, which takes memory and time from the first "
        "step on: --points-limit 200000 keeps as many, evenly"
    )


def _other_clouds(scene: Scene) -> str:
    """Clouds beside the scene that are not copies of its points."""
    if scene.start.file or not scene.clouds:
        return ""
    counts = {path: _count(path) for path in scene.clouds}
    others = [f"{path} ({count:,} points)" for path, count in counts.items() if count not in (0, len(scene.points))]
    if not others:
        return ""
    return f"{examples(others)} is not used, as the scene has points of its own: --points FILE starts from it"


def _count(path: Path) -> int:
    """Points of a cloud by its header, 0 where that does not read."""
    try:
        return count_points(path)
    except InputError:
        return 0


def _coincident(scene: Scene) -> str:
    count = len(scene.points)
    lost = count - len(np.unique(scene.points, axis=0)) if count else 0
    if lost <= COINCIDENT * count:
        return ""
    return (
        f"{lost:,} of {count:,} points lie where another one does: their Gaussians start with next to no size, or "
        "as copies; leave doubles out of the cloud"
    )


def _principal_points(scene: Scene) -> str:
    def outside(camera: Camera) -> bool:
        across, down = camera.cx / camera.width, camera.cy / camera.height
        return not (-BEYOND <= across <= 1 + BEYOND and -BEYOND <= down <= 1 + BEYOND)

    views = [view for view in scene.views if outside(view.camera)]
    if not views:
        return ""
    camera = views[0].camera
    where = f"{camera.cx:g} {camera.cy:g} in {camera.width} x {camera.height} pixels"
    return (
        f"the principal point of {examples(view.name for view in views)} lies far outside the picture, at {where}: "
        "check cx and cy, which are pixels from the upper left corner at the cameras' size"
    )


def _one_place(scene: Scene) -> str:
    if len(scene.views) < 2 or not scene.in_one_place:
        return ""
    return (
        f"all {len(scene.train_views):,} training cameras stand in one place, from where nothing has a depth: check "
        "the translations of the poses; of photographs that were taken so, views from elsewhere cannot be learnt"
    )


def _empty(views: Sequence[View], pictures: Sequence[NDArray[np.float32]], background: Background) -> str:
    colour = background_colour(background)
    if not all(_is_flat(composite(pixels, colour)) for pixels in pictures):
        return ""
    return (
        f"the {len(views)} training photographs that were looked at are of one colour, or transparent, so that there "
        f"is nothing to learn: check {examples(view.name for view in views)}"
    )


def _background(pictures: Sequence[NDArray[np.float32]], background: Background) -> str:
    edges = []
    for pixels in pictures:
        if pixels.shape[2] == 4 and pixels[:, :, 3].min() < 1:
            return ""  # composited over whatever it is trained on
        edges.append(np.concatenate([pixels[0], pixels[-1], pixels[:, 0], pixels[:, -1]])[:, :3])
    border = np.concatenate(edges)
    for name, part in (("white", (border >= WHITE).all(axis=1)), ("black", (border <= BLACK).all(axis=1))):
        other = "random" if background == "random" else {"white": "black", "black": "white"}[background]
        if part.mean() >= BORDER and background != name and (name == "white" or other == "black"):
            return (
                f"{100 * part.mean():.0f} % of the photographs' border is {name}, and the background is {background}: "
                f"use --background {name}, else Gaussians have to cover it"
            )
    return ""
