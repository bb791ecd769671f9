# SPDX-License-Identifier: Apache-2.0
"""Pixels that show the region of a training: which are kept, and that a training uses only these."""

from __future__ import annotations

from dataclasses import replace
from math import inf
from pathlib import Path

import numpy as np
import pytest
from compare import assert_same_arrays, assert_same_bits
from scenes import make_gaussians
from tiny import FEW, HEIGHT, WIDTH, hidden_model, run_steps

from clsplat.api import train
from clsplat.arrays import Float32
from clsplat.config.rasterizer import RasterizerConfig
from clsplat.device.context import Device
from clsplat.gaussians import Gaussians
from clsplat.optimisation.trained_region import TrainedRegion
from clsplat.runs.run import Run
from clsplat.scenes.scene import Scene
from clsplat.scenes.supervision.kept_pixels import KeptPixels
from clsplat.training.region_pixels import MIN_REGION_SHARE, shows_region, with_region_pixels
from clsplat.training.start import NO_START, Start
from clsplat.training.supervision.decoding import Decoder
from clsplat.training.trainer import Trainer

GROUND = np.array([[1.0, 0.0, 0.0], [0.0, 0.0, 1.0]])
LEFT = TrainedRegion(GROUND, np.array([-inf, -inf]), np.array([0.0, inf]), farthest=50.0)


def two_walls() -> Gaussians:
    """Two opaque discs that face the middle camera, one on each side of x = 0."""
    return make_gaussians(
        np.array([[-1.0, 0, 0], [1.0, 0, 0]]),
        np.tile([1.0, 0, 0, 0], (2, 1)),
        np.log(np.tile([0.35, 2.0, 0.01], (2, 1))),
        np.full(2, 0.99),
        np.zeros((2, 1, 3)),
    )


@pytest.mark.parametrize(
    ("inside", "outside", "bounded", "unbounded"),
    [
        (1.0, 0.0, True, True),
        (0.0, 1.0, False, False),
        (MIN_REGION_SHARE, 1 - MIN_REGION_SHARE, True, True),
        (MIN_REGION_SHARE / 2, 1 - MIN_REGION_SHARE / 2, False, False),
        (0.1, 0.2, True, True),
        (0.0, 0.0, False, True),
        (0.0, 0.5, False, True),
        (0.0, 1.001, False, False),
    ],
)
def test_a_pixel_shows_the_region(inside: float, outside: float, bounded: bool, unbounded: bool) -> None:
    shares = np.array([[[inside, outside]]], np.float32)
    assert shows_region(shares, unbounded=False).item() is bounded
    assert shows_region(shares, unbounded=True).item() is unbounded


@pytest.mark.parametrize(("width", "height"), [(1, 1), (7, 5), (8, 1), (64, 33)])
def test_a_mask_keeps_its_bits(width: int, height: int) -> None:
    mask = np.random.default_rng(0).uniform(size=(height, width)) > 0.5
    kept = KeptPixels.of(mask)
    assert_same_bits(kept.mask(width, height), mask)
    assert_same_bits(kept.mask(2 * width, 3 * height), np.repeat(np.repeat(mask, 2, axis=1), 3, axis=0))
    third = kept.mask(max(width // 3, 1), max(height // 3, 1))
    assert third.shape == (max(height // 3, 1), max(width // 3, 1))


@pytest.mark.parametrize("channels", [3, 4, 5])
def test_pixels_that_are_not_kept_are_zero(channels: int) -> None:
    """And the mask of the photograph's own applies too."""
    rng = np.random.default_rng(1)
    image = rng.uniform(0.1, 1, (6, 9, channels)).astype(np.float32)
    own = np.ones((6, 9), np.bool_)
    if channels == 5:
        own = rng.uniform(size=(6, 9)) > 0.3
        image = np.where(own[:, :, None], image, 0).astype(np.float32)
        image[:, :, 4] = own
    mask = rng.uniform(size=(6, 9)) > 0.5
    result: Float32 = KeptPixels.of(mask).applied(image)
    assert result.shape == (6, 9, 5)
    assert_same_bits(result[:, :, 4] > 0, mask & own)
    assert_same_bits(result[mask][:, : min(channels, 4)], image[mask][:, : min(channels, 4)])
    assert not result[~mask].any()
    if channels == 3:
        assert (result[mask][:, 3] == 1).all()


def test_the_masks_of_a_region(scene: Scene, default_device: Device) -> None:
    found = with_region_pixels(scene, Start(two_walls(), LEFT), default_device, RasterizerConfig())
    middle = min(found.train_views, key=lambda view: abs(view.camera.position[0]))
    assert middle.kept is not None
    mask = middle.kept.mask(WIDTH, HEIGHT)
    inner = mask[HEIGHT // 4 : -HEIGHT // 4]
    assert inner[:, WIDTH // 4 : WIDTH // 2 - 4].all()
    assert not inner[:, WIDTH // 2 + 4 :].any()
    assert all(view.kept is None for view in found.test_views), "held-out views are judged as a whole"


def test_a_region_of_everything_has_no_masks(scene: Scene, default_device: Device) -> None:
    everywhere = TrainedRegion(GROUND, np.full(2, -inf), np.full(2, inf))
    found = with_region_pixels(scene, Start(hidden_model(), everywhere), default_device, RasterizerConfig())
    assert all(view.kept is None for view in found.views)
    assert with_region_pixels(scene, NO_START, default_device, RasterizerConfig()) is scene


def test_a_training_of_a_region_uses_them(scene: Scene, default_device: Device, tmp_path: Path) -> None:
    start, config = Start(hidden_model(), replace(LEFT, farthest=inf)), replace(FEW, warmup=())
    run = Run.create(tmp_path / "run", config)
    train(scene, run.config, device=default_device, run=run, start=start)
    states = []
    for each in (with_region_pixels(scene, start, default_device, config.rasterizer), scene):
        trainer = Trainer(each, config, default_device, start)
        run_steps(config.iterations, trainer)
        states.append(trainer.checkpoint()[0])
    kept = Gaussians.load(run.model_path)
    masked, whole = (
        state["parameters/means"][start.region.contains(state["parameters/means"])]  # type: ignore[union-attr]
        for state in states
    )
    assert_same_arrays({"means": kept.means}, {"means": masked})
    assert not np.array_equal(masked, whole)


def test_decoded_pixels_of_other_masks_are_others(scene: Scene) -> None:
    mask = np.ones((HEIGHT, WIDTH), np.bool_)
    mask[:, :5] = False
    view = scene.train_views[0]
    masked = replace(view, kept=KeptPixels.of(mask))
    keys = {Decoder([each], rounds=True)._key(0, 1.0) for each in (view, masked, replace(masked))}
    assert len(keys) == 2
    assert masked.ignores
    assert not view.ignores
    pixels = masked.load_masked()
    assert_same_bits(pixels[:, :, 4] > 0, mask)
    assert_same_bits(np.ascontiguousarray(pixels[mask][:, :3]), np.ascontiguousarray(view.load()[mask][:, :3]))
