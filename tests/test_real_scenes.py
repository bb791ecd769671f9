# SPDX-License-Identifier: Apache-2.0
"""A model and photographs from the world outside; skipped where CLSPLAT_SCENES has none."""

from __future__ import annotations

from functools import cache
from pathlib import Path

import numpy as np
import pytest
import scenes
from compare import assert_close_images
from models import real_file
from quick import quick
from same_bytes import trained_run

from clsplat.camera import Camera
from clsplat.config.training import TrainConfig
from clsplat.device.context import Device
from clsplat.gaussians import Gaussians
from clsplat.reference.render import render as reference
from clsplat.rendering.renderer import Renderer
from clsplat.scenes.loading import load_scene
from clsplat.scenes.scene import Scene

BACKGROUND = (0.1, 0.2, 0.3)
CAMERAS = {"far": scenes.straight_camera(240, 160, 220.0), "oblique": scenes.tilted_camera(200, 150, 120.0)}
"""In the middle of the model's near side, looking into it; both have most of the Gaussians before them."""


@cache
def model() -> Gaussians:
    return Gaussians.load(real_file("samples/kacytran1122_iter7000_9080.ply"))


@cache
def wanted(name: str) -> tuple[np.ndarray, np.ndarray]:
    return reference(model(), CAMERAS[name], BACKGROUND)


@pytest.mark.parametrize("name", quick(CAMERAS, "far"))
def test_a_frame_of_a_trained_model(device: Device, name: str) -> None:
    camera: Camera = CAMERAS[name]
    image, alpha = wanted(name)
    got = Renderer(device).render(model(), camera, BACKGROUND)
    # The contract: 2e-5 in any channel, apart from 1 pixel in 10,000, where a Gaussian is on the other side of a
    # threshold: 1/255 of alpha, or the last before the pixel is full; the first is the larger of the two.
    assert_close_images(got.image, image, 2e-5, flips=1e-4, flip_tolerance=0.01)
    assert_close_images(got.alpha, alpha, 2e-5, flips=1e-4, flip_tolerance=0.01, name="alpha")
    assert alpha.mean() > 0.5, "the camera looks at the model"
    assert image.std() > 0.05


@pytest.mark.slow
def test_a_short_training_on_photographs(default_device: Device, tmp_path: Path) -> None:
    whole = load_scene(real_file("fox"), resolution=200)
    held_out = whole.test_views[::3]  # three of them say enough
    scene = Scene("fox", [*whole.train_views, *held_out], whole.points, whole.point_colors, whole.bounds)
    config = TrainConfig(iterations=120, warmup=(30, 60), resolution=200, checkpoint_every=0)
    run = trained_run(scene, config, default_device, tmp_path / "run")
    result = run.model_record()
    assert [view["name"] for view in result["views"]] == [view.name for view in held_out]
    # Measured 19.47, 19.61 and 19.66 dB with three seeds; 14.2 after half the steps, 8.8 after the first.
    assert result["mean"]["psnr"] > 19.0
