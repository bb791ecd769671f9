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
from clsplat.config.rasterizer import RasterizerConfig
from clsplat.device.context import Device
from clsplat.errors import InputError
from clsplat.gaussians import Gaussians
from clsplat.optimisation.trained_region import TrainedRegion
from clsplat.runs.run import Run
from clsplat.scenes.scene import Scene
from clsplat.scenes.supervision.region_mask import RegionMask
from clsplat.training.region_masks import MIN_REGION_SHARE, MIN_USED_PIXELS, shows_region, with_region_masks
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
        (0.0, 0.0, True, True),
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
    kept = RegionMask.of(mask)
    assert_same_bits(kept.pixels(width, height), mask)
    assert_same_bits(kept.pixels(2 * width, 3 * height), np.repeat(np.repeat(mask, 2, axis=1), 3, axis=0))
    third = kept.pixels(max(width // 3, 1), max(height // 3, 1))
    assert third.shape == (max(height // 3, 1), max(width // 3, 1))


@pytest.mark.parametrize("dtype", [np.uint8, np.float32])
@pytest.mark.parametrize("channels", [3, 4, 5])
def test_pixels_outside_the_mask_are_zero(channels: int, dtype: type[np.generic]) -> None:
    """And the photograph's own mask applies too."""
    rng = np.random.default_rng(1)
    image, most = rng.integers(1, 255, (6, 9, channels)).astype(dtype), 255 if dtype is np.uint8 else 1
    own = np.ones((6, 9), np.bool_)
    if channels == 5:
        own = rng.uniform(size=(6, 9)) > 0.3
        image[:, :, 4] = own * most
        image[~own] = 0
    mask = rng.uniform(size=(6, 9)) > 0.5
    result = RegionMask.of(mask).masked(image)
    assert (result.shape, result.dtype) == ((6, 9, 5), image.dtype)
    assert_same_bits(result[:, :, 4] > 0, mask & own)
    assert set(np.unique(result[:, :, 4]).tolist()) == {0, most}
    assert_same_bits(result[mask][:, : min(channels, 4)], image[mask][:, : min(channels, 4)])
    assert not result[~mask].any()
    if channels == 3:
        assert (result[mask][:, 3] == most).all()


def test_the_masks_of_a_region(scene: Scene, default_device: Device) -> None:
    found = with_region_masks(scene, Start(two_walls(), LEFT), default_device, RasterizerConfig())
    middle = min(found.train_views, key=lambda view: abs(view.camera.position[0]))
    assert middle.region_mask is not None
    mask = middle.region_mask.pixels(WIDTH, HEIGHT)
    inner = mask[HEIGHT // 4 : -HEIGHT // 4]
    assert inner[:, WIDTH // 4 : WIDTH // 2 - 4].all()
    assert not inner[:, WIDTH // 2 + 4 :].any()
    assert all(view.region_mask is None for view in found.test_views), "held-out views are judged as a whole"


def test_a_region_of_everything_has_no_masks(scene: Scene, default_device: Device) -> None:
    everywhere = TrainedRegion(GROUND, np.full(2, -inf), np.full(2, inf))
    found = with_region_masks(scene, Start(hidden_model(), everywhere), default_device, RasterizerConfig())
    assert all(view.region_mask is None for view in found.views)
    assert with_region_masks(scene, NO_START, default_device, RasterizerConfig()) is scene


def test_a_training_of_a_region_uses_them(scene: Scene, default_device: Device, tmp_path: Path) -> None:
    start, config = Start(hidden_model(), replace(LEFT, farthest=inf)), replace(FEW, warmup=())
    run = Run.create(tmp_path / "run", config)
    train(scene, run.config, device=default_device, run=run, start=start)
    states = []
    for each in (with_region_masks(scene, start, default_device, config.rasterizer), scene):
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


def test_no_photograph_shows_the_region(scene: Scene, default_device: Device) -> None:
    model = two_walls()
    model.means[0] = (-300, 0, 0)
    start = Start(model, replace(LEFT, high=np.array([-250.0, inf]), farthest=500.0))
    with pytest.raises(InputError, match=r"none of the 8 training photographs shows the region in at least 1 % of its"):
        train(scene, FEW, device=default_device, start=start)


def test_photographs_that_hardly_show_the_region_are_left_out(scene: Scene, default_device: Device) -> None:
    """A Gaussian behind a wall: only cameras from one side see it."""
    model = two_walls()
    model.means[:] = (-1.0, 0, 1.0), (0.6, 0, 0)
    model.log_scales[:] = np.log([[0.2, 0.2, 0.2], [1.2, 2.0, 0.01]])
    found = with_region_masks(scene, Start(model, LEFT), default_device, RasterizerConfig())
    names = [view.name for view in found.train_views]
    assert 0 < len(names) < len(scene.train_views)
    assert found.test_views == scene.test_views
    for view in found.train_views:
        pixels = np.ones((1, 1)) if view.region_mask is None else view.region_mask.pixels(WIDTH // 2, HEIGHT // 2)
        assert pixels.mean() >= MIN_USED_PIXELS


def test_a_window_of_a_picture(scene: Scene, default_device: Device) -> None:
    """Its edges are at whole pixels of the photograph alone."""
    views = [replace(view, camera=view.camera.cropped(1, 1, WIDTH - 1, HEIGHT - 1)) for view in scene.views]
    start = Start(two_walls(), LEFT)
    cropped = with_region_masks(replace(scene, views=views), start, default_device, RasterizerConfig())
    middle = min(cropped.train_views, key=lambda view: abs(view.camera.position[0]))
    assert middle.region_mask is not None
    assert (middle.region_mask.width, middle.region_mask.height) == (middle.camera.width, middle.camera.height)


def test_the_decoder_applies_the_masks(scene: Scene) -> None:
    """At every size, after the store of decoded pixels, which all blocks share."""
    mask = np.ones((HEIGHT, WIDTH), np.bool_)
    mask[:, : WIDTH // 4] = False
    view = scene.train_views[0]
    masked = replace(view, region_mask=RegionMask.of(mask))
    assert masked.ignores
    assert not view.ignores
    whole, part = (Decoder([each], rounds=True, factors=(2.0, 1.0)) for each in (view, masked))
    assert whole._key(0, 1.0) == part._key(0, 1.0)
    for factor in (2.0, 1.0):
        (before,), (after,) = (each.pixels(0, factor, keeps=False).values() for each in (whole, part))
        left = before.shape[1] // 4
        assert after.shape == (*before.shape[:2], 5)
        assert not after[:, :left].any()
        assert_same_bits(after[:, left:, :3], before[:, left:, :3])
        assert (after[:, left:, 3:] == 255).all()
    assert part.largest() > whole.largest()
