# SPDX-License-Identifier: Apache-2.0
"""The model that a block begins with: its widened cell, and everything that its photographs may show."""

from __future__ import annotations

from dataclasses import replace
from functools import partial
from pathlib import Path

import numpy as np
import pytest
from compare import assert_same_bits
from models import random_gaussians
from small_city import load, trains_on
from tiny import CONFIG

from clsplat.blocks import block_training
from clsplat.blocks.block_training import train_block
from clsplat.blocks.surroundings import first_model_of_block
from clsplat.device.context import Device
from clsplat.models.codec.values import morton_order
from clsplat.models.edit import take
from clsplat.optimisation.trained_region import TrainedRegion
from clsplat.rendering.renderer import Renderer
from clsplat.scenes.loading import load_scene_of
from clsplat.scenes.scene import Scene

ORIGIN = np.array([500_000.0, 5_000_000.0, 100.0])
"""A place in a UTM zone, in float64."""


def region(low: float, high: float) -> TrainedRegion:
    return TrainedRegion(np.eye(3)[[0, 2]], np.full(2, low), np.full(2, high))


def far_scene(scene: Scene) -> Scene:
    """The scene with its cameras moved to ORIGIN."""
    views = [
        replace(view, camera=replace(view.camera, translation=view.camera.translation - view.camera.rotation @ ORIGIN))
        for view in scene.views
    ]
    return replace(scene, views=views, points=scene.points + ORIGIN)


@pytest.mark.parametrize("far", [False, True])
def test_pictures_are_the_same_without_the_others(
    far: bool, small_scene: Path, default_device: Device, tmp_path: Path
) -> None:
    """A cloud far larger than the scene: much of it is left out, and no picture changes by a bit."""
    scene = load_scene_of(CONFIG, small_scene)
    cloud = random_gaussians(20_000, 0)
    cloud.means *= 30
    cloud.log_scales -= 2.0
    cloud = take(cloud, morton_order(cloud.means))  # as models are: neighbours on the ground are near in the file
    if far:
        scene, cloud = far_scene(scene), replace(cloud, origin=ORIGIN)
    cloud.save(tmp_path / "model.ply")
    kept = first_model_of_block(tmp_path / "model.ply", region(-1e9, -1e8), scene, CONFIG, rows=32)
    assert 100 < len(kept) < 0.7 * len(cloud)
    renderer = Renderer(default_device, config=CONFIG.rasterizer)
    for view in scene.train_views:
        pictures = [renderer.render(model, view.camera).image.copy() for model in (cloud, kept)]
        assert pictures[0].max() > 0
        assert_same_bits(*pictures)


def test_the_widened_cell_is_whole(small_scene: Path, tmp_path: Path) -> None:
    cloud = random_gaussians(4_000, 0)
    cloud.means *= 1000
    cloud.save(tmp_path / "model.ply")
    inside = region(500.0, np.inf)
    kept = first_model_of_block(tmp_path / "model.ply", inside, load_scene_of(CONFIG, small_scene), CONFIG, rows=1)
    wanted = inside.contains(cloud.means, cloud.origin)
    assert wanted.any()
    assert_same_bits(kept.means[inside.contains(kept.means, kept.origin)], cloud.means[wanted])


def test_a_block_has_the_same_bytes_with_all_surroundings(
    city: Path, done_city: Path, default_device: Device, monkeypatch: pytest.MonkeyPatch
) -> None:
    for rows in (1, 1 << 20):
        counts: list[int] = []

        def first(*of: object, rows: int, counts: list[int] = counts) -> object:
            model = first_model_of_block(*of, rows=rows)  # type: ignore[arg-type]
            counts.append(len(model))
            return model

        monkeypatch.setattr(block_training, "first_model_of_block", partial(first, rows=rows))
        assert train_block(city, "0,0" if rows == 1 else "1,0", load(), trains_on(default_device))
        assert counts[0] > 0
    for name in ("0_0", "1_0"):
        model = Path("blocks") / name / "model.ply"
        assert (city / model).read_bytes() == (done_city / model).read_bytes()
