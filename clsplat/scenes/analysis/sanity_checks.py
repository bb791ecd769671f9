# SPDX-License-Identifier: Apache-2.0
"""Checks for scenes on which training would give bad results without an error.

Some checks inspect the scene before the first step, others the rendered pictures after some steps. Each warning is one
line that says how to correct the problem.
"""

from __future__ import annotations

from collections.abc import Callable, Sequence
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import NDArray

from clsplat.camera import Camera
from clsplat.config.training import Background
from clsplat.errors import InputError, examples
from clsplat.images.alpha import background_colour, composite
from clsplat.scenes.camera_checks import absurd
from clsplat.scenes.point_files import count_points
from clsplat.scenes.scene import Scene, View, spread

FIRST_RENDER_CHECK_STEP = 100
"""Training step after which rendered pictures are checked for the first time."""
MAX_CHECKED_VIEWS = 8
"""Maximum number of views that are checked, evenly spaced."""
CHECK_DOWNSCALE = 4
"""Factor by which checked pictures are downscaled."""
MANY_START_POINTS = 1_000_000
"""Number of initial points above which further points hardly improve a model.

Published models of rooms and gardens grow to 1 to 6 million Gaussians from 50,000 to 200,000 points.
"""
MAX_COINCIDENT_FRACTION = 0.05
"""Maximum fraction of the points that may coincide with others without a warning."""
PRINCIPAL_POINT_MARGIN = 0.5
"""Maximum distance of a principal point outside the picture, as a fraction of its width or height."""
WHITE_LEVEL, BLACK_LEVEL = 0.98, 0.02
"""Minimum of each channel in a white pixel, and maximum of each channel in a black pixel."""
BACKGROUND_BORDER_FRACTION = 0.9
"""Photographs count as having a white or black background if at least this fraction of their border pixels has that
colour."""


def of_scene(scene: Scene, background: Background) -> list[str]:
    """Return warnings about the scene's points, cameras and photographs, and about the background colour."""
    lenses = absurd([(view.name, view.lens) for view in scene.views])
    checked = spread(scene.train_views, MAX_CHECKED_VIEWS)
    pictures = [_pixels(view) for view in checked]
    doubts = (
        _many_points(scene),
        _other_clouds(scene),
        _coincident(scene),
        _principal_points(scene),
        lenses,
        _one_place(scene),
        _empty(checked, pictures, background),
        _background(pictures, background),
    )
    return [text for text in doubts if text]


def of_pictures(
    draw: Callable[[Camera], tuple[NDArray[Any], NDArray[Any]]], views: Sequence[View], kind: str = "training"
) -> str:
    """Return a warning if a model's renders of these views show no Gaussian or only one colour, else "".

    draw: function that renders the image (H, W, 3) and alpha (H, W) of a camera.
    kind: "training", or another word for these views in the message.
    """
    checked = spread(views, MAX_CHECKED_VIEWS)
    drawn = [draw(view.camera.resized(*_small_size(view.camera))) for view in checked]
    if not any(alpha.any() for _, alpha in drawn):
        return (
            f"no Gaussian is visible in any of the {len(checked)} {kind} views that were checked: the points do not "
            "lie in front of the cameras; check that points and cameras have the same axes, scale and origin"
        )
    if all(_is_flat(image) for image, _ in drawn) and not all(_is_flat(_pixels(view)) for view in checked):
        return (
            f"each picture of the {len(checked)} {kind} views that were checked has a single colour, but the "
            "photographs do not: check that cameras and points belong together, and check settings that you changed"
        )
    return ""


def _small_size(camera: Camera) -> tuple[int, int]:
    return max(camera.width // CHECK_DOWNSCALE, 1), max(camera.height // CHECK_DOWNSCALE, 1)


def _pixels(view: View) -> NDArray[np.float32]:
    return view.load(*_small_size(view.camera))


def _is_flat(image: NDArray[Any]) -> bool:
    """Return True if the pixels differ by less than one 8-bit step in each channel."""
    return bool(np.ptp(image.reshape(-1, image.shape[2]), axis=0).max() < 1 / 255)


def _many_points(scene: Scene) -> str:
    if len(scene.points) <= MANY_START_POINTS:
        return ""
    return (
        f"each of {len(scene.points):,} initial points becomes a Gaussian, which takes memory and time from the first "
        "step on: --points-limit 200000 thins them evenly to that number"
    )


def _other_clouds(scene: Scene) -> str:
    """Return a warning about unused point clouds next to the scene that do not just repeat its points, else ""."""
    if scene.start.file or not scene.clouds:
        return ""
    counts = {path: _count(path) for path in scene.clouds}
    others = [f"{path} ({count:,} points)" for path, count in counts.items() if count not in (0, len(scene.points))]
    if not others:
        return ""
    return f"{examples(others)} is not used, as the scene itself has points: to start from a file, add --points FILE"


def _count(path: Path) -> int:
    """Return the number of points that a cloud's header gives; 0 if the file cannot be read."""
    try:
        return count_points(path)
    except InputError:
        return 0


def _coincident(scene: Scene) -> str:
    count = len(scene.points)
    lost = count - len(np.unique(scene.points, axis=0)) if count else 0
    if lost <= MAX_COINCIDENT_FRACTION * count:
        return ""
    return (
        f"{lost:,} of {count:,} points coincide with another point: their Gaussians start as copies of each "
        "other, or with almost no size; remove duplicate points from the cloud"
    )


def _principal_points(scene: Scene) -> str:
    def outside(camera: Camera) -> bool:
        across, down = camera.cx / camera.width, camera.cy / camera.height
        return not (
            -PRINCIPAL_POINT_MARGIN <= across <= 1 + PRINCIPAL_POINT_MARGIN
            and -PRINCIPAL_POINT_MARGIN <= down <= 1 + PRINCIPAL_POINT_MARGIN
        )

    views = [view for view in scene.views if outside(view.camera)]
    if not views:
        return ""
    camera = views[0].camera
    where = f"{camera.cx:g} {camera.cy:g} for a picture of {camera.width}x{camera.height}"
    return (
        f"the principal point of {examples(view.name for view in views)} lies far outside the picture, at {where}: "
        "check cx and cy, which are in pixels from the upper left corner at the cameras' size"
    )


def _one_place(scene: Scene) -> str:
    if len(scene.views) < 2 or not scene.in_one_place:
        return ""
    return (
        f"all {len(scene.train_views):,} training cameras stand in one place, so that no depth can be recovered: "
        "check the translations of the poses; if they are right, views from elsewhere cannot be learnt"
    )


def _empty(views: Sequence[View], pictures: Sequence[NDArray[np.float32]], background: Background) -> str:
    colour = background_colour(background)
    if not all(_is_flat(composite(pixels, colour)) for pixels in pictures):
        return ""
    return (
        f"each of the {len(views)} training photographs that were checked has a single colour or is "
        f"transparent, so that there is nothing to learn: check {examples(view.name for view in views)}"
    )


def _background(pictures: Sequence[NDArray[np.float32]], background: Background) -> str:
    edges = []
    for pixels in pictures:
        if pixels.shape[2] == 4 and pixels[:, :, 3].min() < 1:
            return ""  # transparent photographs are composited over the background, so every background suits them
        edges.append(np.concatenate([pixels[0], pixels[-1], pixels[:, 0], pixels[:, -1]])[:, :3])
    border = np.concatenate(edges)
    for name, part in (("white", (border >= WHITE_LEVEL).all(axis=1)), ("black", (border <= BLACK_LEVEL).all(axis=1))):
        other = "random" if background == "random" else {"white": "black", "black": "white"}[background]
        if part.mean() >= BACKGROUND_BORDER_FRACTION and background != name and (name == "white" or other == "black"):
            return (
                f"{100 * part.mean():.0f} % of the photographs' border is {name}, but the background is {background}: "
                f"use --background {name}, or else Gaussians have to cover the background"
            )
    return ""
