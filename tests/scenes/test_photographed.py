# SPDX-License-Identifier: Apache-2.0
"""Colours of points that have none, against scenes whose photographs are known in closed form: a red square before a
larger blue one."""

from __future__ import annotations

from pathlib import Path

import numpy as np
import pytest

from clsplat.config.masks import MaskUse
from clsplat.images.writing import write_image
from clsplat.scenes.dataset import Lens
from clsplat.scenes.scene import Scene, View
from clsplat.scenes.start.point_cloud import COLOUR_VIEWS_PER_POINT, photographed
from clsplat.scenes.supervision.masks import Mask

SIDE = 120
RED, BLUE, GREY = np.uint8([200, 40, 0]), np.uint8([10, 60, 220]), np.uint8([128, 128, 128])
BLACK = (0.0, 0.0, 0.0)
HALF_A_SIDE, FRONT, BACK = 0.6, 2.0, 4.0
"""Half the red square's side, and the depths of the two squares; the blue one's half is twice as long."""
HIDING, SHOWING = tuple(np.linspace(-0.9, 0.9, 9)), (2.3, 2.7, 3.1, -2.5, -2.9)
"""Places of cameras, along x, that have the blue square's middle behind the red one, and beside it."""

LENSES = {
    "pinhole": Lens("PINHOLE", SIDE, SIDE, (60.0, 60.0, SIDE / 2, SIDE / 2)),
    "fisheye": Lens("FISHEYE", SIDE, SIDE, (50.0, 50.0, SIDE / 2, SIDE / 2)),
    "panorama": Lens("EQUIRECTANGULAR", 4 * SIDE, 2 * SIDE, (4.0 * SIDE, 2.0 * SIDE)),
}


def rays_of(lens: Lens) -> np.ndarray:
    """Directions (H, W, 3) of the pixels in camera space, of any length."""
    x, y = np.meshgrid(np.arange(lens.width) + 0.5, np.arange(lens.height) + 0.5)
    if lens.is_panorama:
        turn, lift = (x / lens.width - 0.5) * 2 * np.pi, (y / lens.height - 0.5) * np.pi
        return np.stack([np.sin(turn) * np.cos(lift), np.sin(lift), np.cos(turn) * np.cos(lift)], axis=-1)
    x, y = (x - lens.centre[0]) / lens.focal, (y - lens.centre[1]) / lens.focal
    if lens.model == "PINHOLE":
        return np.stack([x, y, np.ones_like(x)], axis=-1)
    angle = np.hypot(x, y)
    return np.stack([x * np.sinc(angle / np.pi), y * np.sinc(angle / np.pi), np.cos(angle)], axis=-1)


def picture(lens: Lens, rotation: np.ndarray, position: np.ndarray) -> np.ndarray:
    """What a camera sees, (H, W, 3) uint8."""
    rays = rays_of(lens) @ rotation
    result = np.broadcast_to(GREY, rays.shape).copy()
    for depth, half, colour in ((BACK, 2 * HALF_A_SIDE, BLUE), (FRONT, HALF_A_SIDE, RED)):
        with np.errstate(divide="ignore", invalid="ignore"):
            where = position[:2] + rays[..., :2] * ((depth - position[2]) / rays[..., 2:])
        result[(np.abs(where) < half).all(axis=-1) & (rays[..., 2] > 0)] = colour
    return result


def view_of(folder: Path, lens: Lens, along: float, *, turned: bool = False) -> View:
    """The view of a camera on the x axis that looks along z, or where it is turned against it."""
    rotation, position = np.diag([-1.0, 1.0, -1.0]) if turned else np.eye(3), np.array([along, 0.0, 0.0])
    path = folder / f"{along:.3f}.png"
    write_image(path, picture(lens, rotation, position))
    return View(path.name, lens.camera(rotation, -rotation @ position, "native"), path, "train", lens)


def scene_of(views: list[View], points: np.ndarray) -> Scene:
    return Scene("squares", views, points, np.full(points.shape, 0.5, np.float32), (np.zeros(3), np.ones(3)))


def squares() -> tuple[np.ndarray, np.ndarray]:
    """Points (N, 3) of the red square and of the blue one's middle."""
    steps = np.linspace(-0.58, 0.58, 20)
    x, y = (axis.ravel() for axis in np.meshgrid(steps, steps))
    front = np.stack([x, y, np.full(x.shape, FRONT)], axis=1)
    return front, np.stack([0.6 * x, 0.6 * y, np.full(x.shape, BACK)], axis=1)


@pytest.mark.parametrize("kind", LENSES)
def test_hidden_points_do_not_take_the_colour_of_what_hides_them(tmp_path: Path, kind: str) -> None:
    """Nine photographs of fourteen have red where the blue points lie: a mean is mostly red, and a median is red."""
    front, back = squares()
    lens, turned = LENSES[kind], kind == "panorama"  # behind a panorama's back a depth along its axis is below 0
    views = [view_of(tmp_path, lens, along, turned=turned) for along in (*HIDING, *SHOWING)]
    found = photographed(scene_of(views, np.concatenate([front, back])), BLACK)
    right = np.concatenate([np.tile(RED, (len(front), 1)), np.tile(BLUE, (len(back), 1))]) / np.float32(255)
    off = np.abs(found - right).max(axis=1) > 1e-6
    # a point at the red square's edge is in its outermost pixel, whose middle may lie beside it
    assert off[: len(front)].mean() < 0.1
    assert not off[len(front) :].any()


def test_points_that_are_always_hidden_take_the_least_hidden_view(tmp_path: Path) -> None:
    """And no grey. All photographs have red there."""
    front, back = squares()
    scene = scene_of([view_of(tmp_path, LENSES["pinhole"], x) for x in HIDING[3:6]], np.concatenate([front, back]))
    middle = np.abs(back[:, :2]).max(axis=1) < 0.3
    np.testing.assert_allclose(
        photographed(scene, BLACK)[len(front) :][middle], np.tile(RED / 255, (middle.sum(), 1)), atol=1e-6
    )


@pytest.mark.parametrize("other", [0, 255])
def test_what_a_few_photographs_have_before_a_point_does_not_count(tmp_path: Path, other: int) -> None:
    """Somebody in two photographs of seven, of whom the points know nothing."""
    front, _ = squares()
    middle = front[np.abs(front[:, :2]).max(axis=1) < 0.5]
    views = [view_of(tmp_path, LENSES["pinhole"], x) for x in np.linspace(-0.5, 0.5, 7)]
    for view in views[2:4]:
        write_image(view.path, np.full((SIDE, SIDE, 3), other, np.uint8))
    np.testing.assert_allclose(
        photographed(scene_of(views, middle), BLACK), np.tile(RED / 255, (len(middle), 1)), atol=1e-6
    )


@pytest.mark.parametrize("count", [1, 2, COLOUR_VIEWS_PER_POINT + 5])
@pytest.mark.parametrize("level", [0, 1, 128, 255])
def test_photographs_of_one_grey_give_that_grey(tmp_path: Path, level: int, count: int) -> None:
    front, back = squares()
    views = [view_of(tmp_path, LENSES["pinhole"], x) for x in np.linspace(-0.5, 0.5, count)]
    for view in views:
        write_image(view.path, np.full((SIDE, SIDE, 3), level, np.uint8))
    found = photographed(scene_of(views, np.concatenate([front, back])), BLACK)
    np.testing.assert_allclose(found, level / 255, atol=1e-7)  # float32's rounding


def test_the_nearest_photographs_count(tmp_path: Path) -> None:
    """Of more than COLOUR_VIEWS_PER_POINT: those from afar have another colour."""
    front, _ = squares()
    views = [view_of(tmp_path, LENSES["pinhole"], x) for x in np.linspace(-0.5, 0.5, COLOUR_VIEWS_PER_POINT)]
    for index in range(2 * COLOUR_VIEWS_PER_POINT):
        path, centre = tmp_path / f"far{index}.png", np.array([0.0, 0.0, -4.0 - index])
        write_image(path, np.full((SIDE, SIDE, 3), 255, np.uint8))
        camera = LENSES["pinhole"].camera(np.eye(3), -centre, "native")
        views.insert(index % 3, View(path.name, camera, path, "train", LENSES["pinhole"]))
    middle = front[np.abs(front[:, :2]).max(axis=1) < 0.5]
    np.testing.assert_allclose(
        photographed(scene_of(views, middle), BLACK), np.tile(RED / 255, (len(middle), 1)), atol=1e-6
    )


@pytest.mark.parametrize("use", [MaskUse(masks="ignore"), MaskUse(masks="ignore", invert=True)])
def test_what_a_mask_leaves_out_does_not_count(tmp_path: Path, use: MaskUse) -> None:
    """In all photographs but one, where it would be black."""
    front, _ = squares()
    middle = front[np.abs(front[:, :2]).max(axis=1) < 0.5]
    views = [view_of(tmp_path, LENSES["pinhole"], x) for x in (-0.3, 0.0, 0.3)]
    (tmp_path / "masks").mkdir()
    for view in views[1:]:
        path = tmp_path / "masks" / view.name
        write_image(path, np.full((SIDE, SIDE), 255 if use.invert else 0, np.uint8))
        object.__setattr__(view, "mask", Mask(use, path))
    np.testing.assert_allclose(
        photographed(scene_of(views, middle), BLACK), np.tile(RED / 255, (len(middle), 1)), atol=1e-6
    )
    alone = photographed(scene_of(views[1:], middle), BLACK)
    np.testing.assert_array_equal(alone, np.full(middle.shape, 0.5, np.float32))


def test_a_line_of_one_pixel_keeps_its_colour(tmp_path: Path) -> None:
    """In photographs of 900 pixels: smaller ones would mix it with what is around."""
    wide = Lens("PINHOLE", 900, 30, (450.0, 450.0, 450.0, 15.0))
    pixels = np.zeros((30, 900, 3), np.uint8)
    pixels[:, 450] = 255
    write_image(tmp_path / "line.png", pixels)
    view = View("line.png", wide.camera(np.eye(3), np.zeros(3), "native"), tmp_path / "line.png", "train", wide)
    points = np.array([[0.5 / 450, 0.0, 1.0], [1.5 / 450, 0.0, 1.0]])
    np.testing.assert_array_equal(photographed(scene_of([view], points), BLACK), np.float32([[1, 1, 1], [0, 0, 0]]))
