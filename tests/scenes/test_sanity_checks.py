# SPDX-License-Identifier: Apache-2.0
"""Trainings that cannot come to anything say so: before the first step, after a hundred, and at the end."""

from __future__ import annotations

import warnings
from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest
from calls import warnings_of
from models import assert_equal
from numpy.typing import NDArray
from test_scene import make_colmap
from tiny import short, write_scene

from clsplat.api import train
from clsplat.camera import Camera
from clsplat.device.context import Device
from clsplat.images.reading import read_image
from clsplat.images.writing import write_image
from clsplat.reference.cameras import pixel_from_world
from clsplat.scenes.analysis import sanity_checks
from clsplat.scenes.dataset import pixels_of
from clsplat.scenes.loading import load_scene
from clsplat.scenes.scene import Scene
from clsplat.scenes.start.initialise import MIN_START_COLOUR, from_points
from clsplat.scenes.start.point_cloud import is_colourless, photographed
from clsplat.spherical_harmonics import SH_C0


def told(scene: Scene, device: Device, **changes: object) -> list[str]:
    return warnings_of(lambda: train(scene, short(warmup=(), **changes), device=device))


def with_cameras(scene: Scene, **changes: object) -> Scene:
    views = [replace(view, camera=replace(view.camera, **changes)) for view in scene.views]  # type: ignore[arg-type]
    return replace(scene, views=views)


def test_an_ordinary_scene_is_not_doubted(scene: Path, default_device: Device) -> None:
    loaded = load_scene(scene)
    assert sanity_checks.of_scene(loaded, "black") == []
    assert told(loaded, default_device, iterations=3) == []


def test_points_behind_all_cameras_are_told_after_a_hundred_steps_and_at_the_end(
    scene: Path, default_device: Device, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setattr(sanity_checks, "FIRST_RENDER_CHECK_STEP", 4)
    loaded = load_scene(scene)
    behind = replace(loaded, points=loaded.points - np.array([0.0, 0.0, 50.0]))
    density = {"start": 100, "opacity_reset_every": 100}
    found = told(behind, default_device, iterations=6, density=density)
    assert [text.partition(": ")[0] for text in found] == ["step 4", "step 6"]
    assert all("no Gaussian is visible in any of the 8 training views" in text for text in found)
    assert found[0].endswith("check that points and cameras have the same axes, scale and origin")


def test_pictures_of_one_colour_are_told(scene: Path) -> None:
    views = load_scene(scene).train_views

    def draw(camera: Camera) -> tuple[NDArray[np.float32], NDArray[np.float32]]:
        shape = (camera.height, camera.width)
        return np.full((*shape, 3), 0.5, np.float32), np.ones(shape, np.float32)

    assert "has a single colour, but the photographs do not" in sanity_checks.of_pictures(draw, views)


def test_photographs_of_one_colour_may_be_learnt(tmp_path: Path) -> None:
    views = load_scene(make_colmap(tmp_path)).train_views
    ones = np.ones((1, 1))
    assert sanity_checks.of_pictures(lambda _: (np.zeros((1, 1, 3)), ones), views) == ""


def test_coincident_points_are_told(scene: Path) -> None:
    loaded = load_scene(scene)
    doubled = replace(
        loaded,
        points=np.concatenate([loaded.points, np.repeat(loaded.points[:1], 10, axis=0)]),
        point_colors=np.concatenate([loaded.point_colors, np.repeat(loaded.point_colors[:1], 10, axis=0)]),
    )
    (text,) = sanity_checks.of_scene(doubled, "black")
    assert text.startswith("10 of 50 points coincide with another point")
    assert text.endswith("remove duplicate points from the cloud")


def test_a_principal_point_far_outside_is_told(scene: Path) -> None:
    (text,) = sanity_checks.of_scene(with_cameras(load_scene(scene), cx=-500.0), "black")
    assert text.startswith("the principal point of 00.png, 01.png, 02.png and 7 more lies far outside the picture, at")
    assert "check cx and cy" in text
    assert sanity_checks.of_scene(with_cameras(load_scene(scene), cx=-10.0), "black") == [], "as of a part of a picture"


@pytest.mark.parametrize(("k1", "absurd"), [(5.0, True), (-5.0, True), (-0.3, False), (0.2, False)])
def test_absurd_distortion_is_told(k1: float, absurd: bool, tmp_path: Path) -> None:
    loaded = load_scene(make_colmap(tmp_path, camera=f"SIMPLE_RADIAL 48 32 40 24 16 {k1}"))
    found = [text for text in sanity_checks.of_scene(loaded, "black") if "lens" in text]
    assert len(found) == absurd
    if absurd:
        assert f"and 6 more distorts the picture implausibly (SIMPLE_RADIAL 40 24 16 {k1:g}): check its" in found[0]


def test_cameras_in_one_place_are_told(tmp_path: Path) -> None:
    loaded = load_scene(make_colmap(tmp_path))
    assert not [text for text in sanity_checks.of_scene(loaded, "black") if "one place" in text]
    here = [-view.camera.rotation @ [1.0, 2.0, 3.0] for view in loaded.views]
    views = [
        replace(view, camera=replace(view.camera, translation=place))
        for view, place in zip(loaded.views, here, strict=True)
    ]
    found = [text for text in sanity_checks.of_scene(replace(loaded, views=views), "black") if "one place" in text]
    assert len(found) == 1
    assert f"all {len(loaded.train_views)} training cameras stand in one place" in found[0]


@pytest.mark.parametrize(
    ("colour", "background", "hint"),
    [
        (1.0, "black", "white"),
        (1.0, "random", "white"),
        (1.0, "white", ""),
        (0.0, "white", "black"),
        (0.0, "random", ""),
    ],
)
def test_a_background_that_is_not_the_photographs_is_told(
    colour: float, background: sanity_checks.Background, hint: str, scene: Path, tmp_path: Path
) -> None:
    write_scene(tmp_path / "scene")
    for path in (tmp_path / "scene" / "images").iterdir():
        picture = read_image(path, orient=False)
        edge = np.ones(picture.shape[:2], bool)
        edge[
            sanity_checks.CHECK_DOWNSCALE : -sanity_checks.CHECK_DOWNSCALE,
            sanity_checks.CHECK_DOWNSCALE : -sanity_checks.CHECK_DOWNSCALE,
        ] = False
        picture[edge] = colour
        write_image(path, picture)
    found = sanity_checks.of_scene(load_scene(tmp_path / "scene"), background)
    assert len(found) == bool(hint)
    if hint:
        assert f"100 % of the photographs' border is {'white' if colour else 'black'}" in found[0]
        assert f"use --background {hint}" in found[0]


def test_pictures_with_alpha_take_any_background(tmp_path: Path) -> None:
    loaded = load_scene(write_scene(tmp_path / "scene", alpha=True))
    assert sanity_checks.of_scene(loaded, "white") == sanity_checks.of_scene(loaded, "black") == []


def test_a_black_point_can_learn(default_device: Device) -> None:
    # at a colour of 0 it is at the clamp, where rounding decides for good whether there is a gradient
    model = from_points([[0, 0, 2.0]], [[0.0, 0.5, 1.0]])
    np.testing.assert_allclose(0.5 + SH_C0 * model.sh[0, 0], [MIN_START_COLOUR, 0.5, 1.0], atol=1e-7)


def test_black_points_become_bright(scene: Path, default_device: Device) -> None:
    loaded = load_scene(scene)
    colors = loaded.point_colors.copy()
    colors[::2] = 0  # not all of them, for which the photographs would stand in
    model = train(
        replace(loaded, point_colors=colors), short(iterations=30, density={"start": 100}), device=default_device
    )
    assert (0.5 + SH_C0 * model.sh[::2, 0] > 3 * MIN_START_COLOUR).mean() > 0.5


def test_pixels_of_points_are_the_reference_s(scene: Path) -> None:
    loaded = load_scene(scene)
    camera = loaded.views[0].camera
    points = np.concatenate([loaded.points, [[0.0, 0.0, -500.0], [100.0, 0.0, 0.0]]])
    rows, columns, inside = pixels_of(points, camera)
    assert not inside[-2:].any()
    pixels, _ = pixel_from_world(camera, points[inside])
    np.testing.assert_array_equal(np.stack([columns, rows], axis=1), np.floor(pixels))


def test_a_cloud_without_colours_takes_the_photographs(scene: Path, default_device: Device) -> None:
    loaded = load_scene(scene)
    bare = replace(loaded, point_colors=np.zeros_like(loaded.point_colors))
    assert is_colourless(bare)
    assert not is_colourless(loaded)
    found = photographed(bare, (0.0, 0.0, 0.0))
    assert np.corrcoef(found.ravel(), loaded.point_colors.ravel())[0, 1] > 0.5
    texts = told(bare, default_device, iterations=2)
    assert texts == [f"{loaded.name}: the points have no colours, and get their colours from the photographs"]
    with warnings.catch_warnings():
        warnings.simplefilter("ignore")
        model = train(bare, short(iterations=2), device=default_device)
    assert_equal(model, train(replace(bare, point_colors=found), short(iterations=2), device=default_device))


def test_points_that_no_photograph_shows_are_grey(scene: Path) -> None:
    loaded = load_scene(scene)
    away = replace(loaded, points=np.full((3, 3), -1e3), point_colors=np.zeros((3, 3), np.float32))
    np.testing.assert_array_equal(photographed(away, (0.0, 0.0, 0.0)), np.full((3, 3), 0.5))
