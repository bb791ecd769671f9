# SPDX-License-Identifier: Apache-2.0
"""Scenes in other units: nothing may depend on them, from training to files and frames."""

from __future__ import annotations

from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest
from models import random_gaussians
from quality.experiments import UNITS
from quality.made_scenes import in_units
from quality.trainings import psnr_of
from tiny import cameras, short

from clsplat.api import train
from clsplat.camera import DEFAULT_NEAR_PLANE, Camera
from clsplat.device.context import Device
from clsplat.gaussians import Gaussians
from clsplat.models import edit
from clsplat.reference import render as reference
from clsplat.rendering.renderer import Renderer
from clsplat.scenes.loading import load_scene
from clsplat.scenes.scene import Scene
from clsplat.scenes.start.initialise import MIN_SQUARED_DISTANCE, squared_floor

BOUND = 0.3
"""dB between two units."""


@pytest.mark.parametrize(("factor", "offset"), UNITS[1:])
def test_a_scene_looks_the_same_in_all_units(
    factor: float, offset: float, scene: Path, default_device: Device, tmp_path: Path
) -> None:
    renderer = Renderer(default_device)

    def psnr(scene: Scene) -> float:
        train(scene, short(iterations=20), device=default_device).save(tmp_path / "model.ply")
        model = Gaussians.load(tmp_path / "model.ply")
        return psnr_of(lambda view: renderer.render(model, view.camera).image, scene.test_views)

    usual = psnr(load_scene(scene))
    assert usual > 15
    assert abs(psnr(in_units(load_scene(scene), factor, np.full(3, offset))) - usual) < BOUND


def test_the_near_plane_follows_the_extent_of_small_scenes(scene: Path) -> None:
    loaded = load_scene(scene)
    assert in_units(loaded, 1e-4, np.zeros(3)).near == pytest.approx(1e-6 * loaded.extent)
    assert in_units(loaded, 1e3, np.zeros(3)).near == DEFAULT_NEAR_PLANE


def test_cameras_in_one_place_take_the_extent_of_the_points(scene: Path) -> None:
    loaded = load_scene(scene)
    views = [replace(view, camera=replace(view.camera, translation=np.zeros(3))) for view in loaded.views]
    standing = Scene("standing", views, loaded.points + np.array([0, 0, 3]), loaded.point_colors, loaded.bounds)
    small = in_units(standing, 1e-6, np.zeros(3))
    assert small.extent == pytest.approx(1e-6 * standing.extent)
    # and what is left of one place far from the origin is rounding
    assert in_units(standing, 1.0, np.full(3, 1e6)).extent == pytest.approx(standing.extent, rel=1e-3)


def test_the_floor_of_initial_sizes_follows_the_extent() -> None:
    assert squared_floor(1.0) == squared_floor(50.0) == MIN_SQUARED_DISTANCE
    assert squared_floor(1e-4) == pytest.approx(1e-8 * MIN_SQUARED_DISTANCE)
    assert squared_floor(1e6) == pytest.approx(1e8 * MIN_SQUARED_DISTANCE)


def small_model() -> tuple[Gaussians, Camera]:
    """A model that lies wholly before the usual near plane, and a camera that sees it."""
    model, view = random_gaussians(200, seed=3), cameras()[0]
    model.log_scales -= 2
    model = edit.transform(model, edit.scaling(1e-4))
    return model, edit.transform_camera(view, edit.scaling(1e-4))


def test_a_model_keeps_its_near_plane(tmp_path: Path, default_device: Device) -> None:
    model, camera = small_model()
    assert model.near == pytest.approx(1e-6)
    model.save(tmp_path / "model.ply")
    again = Gaussians.load(tmp_path / "model.ply")
    assert again.near == model.near
    assert edit.take(again, np.arange(5)).near == model.near
    assert edit.merge([again, again]).near == model.near
    shown = Renderer(default_device).render(again, camera)
    wanted, _ = reference.render(again, camera)
    assert shown.alpha.max() > 0.5
    assert np.median(np.abs(shown.image - wanted)) < 1e-6
    assert not Renderer(default_device).render(again, replace(camera, near=1.0)).alpha.any(), "a camera's own counts"


def test_an_ordinary_model_has_no_word_of_it(tmp_path: Path) -> None:
    random_gaussians(20, seed=3).save(tmp_path / "model.ply")
    assert b"near" not in (tmp_path / "model.ply").read_bytes().partition(b"end_header")[0]
    assert Gaussians.load(tmp_path / "model.ply").near == DEFAULT_NEAR_PLANE


@pytest.mark.parametrize("words", ["near", "near x", "near -1", "near nan", "near 1 2"])
def test_a_comment_that_is_not_ours_is_passed_over(words: str, tmp_path: Path) -> None:
    path = tmp_path / "model.ply"
    random_gaussians(20, seed=3).save(path, comments=[f"clsplat {words}"])
    assert Gaussians.load(path).near == DEFAULT_NEAR_PLANE


def test_small_models_of_other_tools_are_seen_too(tmp_path: Path, default_device: Device) -> None:
    model, camera = small_model()
    replace(model, near=DEFAULT_NEAR_PLANE).save(tmp_path / "model.ply")  # as one without the comment
    again = Gaussians.load(tmp_path / "model.ply")
    assert again.near < 1e-5
    assert Renderer(default_device).render(again, camera).alpha.any()
