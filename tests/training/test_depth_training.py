# SPDX-License-Identifier: Apache-2.0
"""Depth supervision: what it does to a model, and that it repeats to the last byte however training is done."""

from __future__ import annotations

import shutil
from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest
from depths import add_maps, add_tracks
from same_bytes import model_bytes
from tiny import HEIGHT, WIDTH, short, trained_to, write_scene

from clsplat.camera import DEFAULT_NEAR_PLANE
from clsplat.config.training import TrainConfig
from clsplat.device.context import Device
from clsplat.errors import InputError
from clsplat.images.writing import write_image
from clsplat.runs import scene_record
from clsplat.runs.run import Run
from clsplat.scenes.depth_sources import with_depths
from clsplat.scenes.loading import load_scene
from clsplat.scenes.scene import Scene
from clsplat.scenes.supervision.depth_samples import KnownDepth
from clsplat.training.repro_bundle import read_bundle, replay, write_bundle
from clsplat.training.stability.health import Incident
from clsplat.training.supervision.depth_targets import DepthTargets, weight_at
from clsplat.training.trainer import Trainer

CONFIG = short(iterations=40, depth="points", depth_weight=0.05)


@pytest.fixture(scope="module")
def folder(tmp_path_factory: pytest.TempPathFactory) -> Path:
    made = write_scene(tmp_path_factory.mktemp("tiny") / "scene")
    add_tracks(made)
    add_maps(made)
    return made


@pytest.fixture(scope="module")
def scene(folder: Path) -> Scene:
    return load_scene(folder)


def wrong(trainer: Trainer) -> float:
    """Weighted mean difference of nearness over the training views."""
    total = weight = 0.0
    for index, view in enumerate(trainer.views):
        camera = trainer.loader.camera(index, view.camera.width, view.camera.height)
        aims = trainer.depths.aims(index, camera, 1)
        assert aims is not None
        frame = trainer.rasterizer.forward(trainer.parameters, camera, np.zeros(3, np.float32), nearness=True)
        assert frame.blended.nearness is not None
        total += float((aims.planes[1] * np.abs(frame.blended.nearness.get() - aims.planes[0])).sum())
        weight += float(aims.planes[1].sum())
    return total / weight


@pytest.mark.slow
@pytest.mark.parametrize("source", ["points", "maps"])
def test_the_render_comes_nearer_to_what_is_known(scene: Scene, default_device: Device, source: str) -> None:
    found = {}
    for weight in (0.0, 20.0):
        config = short(iterations=40, depth=source, depth_weight=weight, warmup=())
        trainer = trained_to(40, with_depths(scene, config.depth_use), config, default_device)
        trainer.settle()
        found[weight] = wrong(trainer)
    assert found[20.0] < 0.85 * found[0.0]  # the points are wrong by a twentieth themselves


def test_the_weight_falls_and_views_count_alike(scene: Scene) -> None:
    config = TrainConfig(iterations=1000, depth="maps", depth_weight=0.5)
    assert [weight_at(config, step) for step in (0, 500, 1000)] == pytest.approx([0.5, 0.05, 0.005])
    views = with_depths(scene, config.depth_use).train_views
    for size in (48, 24):
        aims = DepthTargets(config, views, 3.0).aims(0, views[0].camera.resized(size, size * 5 // 6), 500)
        assert aims is not None
        assert aims.factor * aims.planes[1].sum() == pytest.approx(0.05 * 3.0)
    blind, camera = [replace(views[0], depth=None)], views[0].camera.resized(48, 40)
    nothing = DepthTargets(config, blind, 3.0).aims(0, camera, 1)
    assert nothing is not None
    assert nothing.factor == 0
    assert not nothing.planes.any()
    assert DepthTargets(TrainConfig(), views, 3.0).aims(0, camera, 1) is None


def test_under_a_mask_no_depth_counts(scene: Scene) -> None:
    config = TrainConfig(iterations=1000, depth="maps", depth_weight=0.5)
    views = with_depths(scene, config.depth_use).train_views
    camera, photograph = views[0].camera, np.ones((HEIGHT, WIDTH, 5), np.uint8)
    photograph[: HEIGHT // 2, :, 4] = 0
    whole = DepthTargets(config, views, 3.0).aims(0, camera, 500)
    masked = DepthTargets(config, views, 3.0).aims(0, camera, 500, photograph)
    assert whole is not None
    assert masked is not None
    assert not masked.planes[:, : HEIGHT // 2].any()
    np.testing.assert_array_equal(masked.planes[:, HEIGHT // 2 :], whole.planes[:, HEIGHT // 2 :])
    assert masked.factor * masked.planes[1].sum() == pytest.approx(0.05 * 3.0)


def test_a_step_counts_no_depth_under_its_mask(folder: Path, default_device: Device, tmp_path: Path) -> None:
    masked = Path(shutil.copytree(folder, tmp_path / "masked"))
    (masked / "masks").mkdir(exist_ok=True)
    mask = np.ones((HEIGHT, WIDTH, 3), np.float32)
    mask[: HEIGHT // 2] = 0
    for path in sorted((masked / "images").iterdir()):
        write_image(masked / "masks" / path.name, mask)
    config = short(iterations=20, depth="maps", masks="ignore", warmup=())
    scene = with_depths(load_scene(masked, masks=config.mask_use), config.depth_use)
    trainer = Trainer(scene, config, default_device)
    (inputs,) = trainer.depths.join([trainer._view_inputs(0)], 1, 1)
    depth = inputs.depth
    assert not depth.planes[1, : HEIGHT // 2].any()
    assert depth.planes[1].any()


def test_a_damaged_map_says_nothing(scene: Scene, tmp_path: Path) -> None:
    """One over a denormal is more than a float holds, or nearer than any camera sees."""
    config = TrainConfig(depth="maps")
    views = with_depths(scene, config.depth_use).train_views
    values = np.full((HEIGHT, WIDTH), 1e-45, np.float32)
    values[0], values[1], values[2] = 1e-30, 4.0, np.inf
    np.save(tmp_path / "some.npy", values)
    views[0] = replace(views[0], depth=KnownDepth(np.empty((0, 3)), np.empty(0), tmp_path / "some.npy"))
    with np.errstate(over="raise"):
        aims = DepthTargets(config, views, 3.0).aims(0, views[0].camera, 1)
    assert aims is not None
    assert np.isfinite(aims.planes).all()
    assert np.count_nonzero(aims.planes[1]) == WIDTH


def test_depths_of_a_scene_in_small_units(scene: Scene) -> None:
    """Its near plane is before all that it has, and so before what is known."""
    part = 1e-3
    views = [
        replace(
            view,
            camera=replace(view.camera, translation=part * view.camera.translation),
            depth=None if view.depth is None else replace(view.depth, points=part * view.depth.points),
        )
        for view in with_depths(scene, CONFIG.depth_use).train_views
    ]
    config, camera = replace(CONFIG, depth_weight=1.0), views[0].camera
    known = [
        DepthTargets(config, views, 3.0 * part, near).aims(0, camera, 1)
        for near in (DEFAULT_NEAR_PLANE, part * scene.near)
    ]
    assert known[0] is not None
    assert known[1] is not None
    assert not known[0].planes[1].any()
    assert known[1].planes[1].any()


@pytest.mark.slow
def test_without_weight_the_model_is_that_of_today(scene: Scene, default_device: Device, tmp_path: Path) -> None:
    """Blending's gradient has one term more, which is 0: the sums are the same."""
    plain = model_bytes(scene, short(iterations=40), default_device, tmp_path / "plain")
    assert model_bytes(scene, replace(CONFIG, depth_weight=0.0), default_device, tmp_path / "depth") == plain


@pytest.mark.slow
def test_a_bundle_has_the_depths(scene: Scene, default_device: Device, tmp_path: Path) -> None:
    config = short(iterations=20, depth="maps")
    trainer = trained_to(12, with_depths(scene, config.depth_use), config, default_device)
    trainer.settle()
    incident = Incident(12, 0, trainer.views[0].name, "loss", 1, "nothing", np.zeros(3, np.float32))
    bundle = read_bundle(write_bundle(tmp_path, trainer, incident))
    got, wanted = bundle.inputs.depth, trainer.depths.aims(0, bundle.inputs.camera, 12)
    assert got is not None
    assert wanted is not None
    np.testing.assert_array_equal(got.planes, wanted.planes)
    assert got.factor == wanted.factor
    assert not any(replay(bundle, default_device).values())


def test_held_out_photographs_are_those_of_the_training(folder: Path, default_device: Device, tmp_path: Path) -> None:
    """The record of a photograph goes on behind the digest of its file: masks and depths."""
    (folder / "masks").mkdir()
    for path in sorted((folder / "images").iterdir()):
        write_image(folder / "masks" / path.name, np.ones((HEIGHT, WIDTH, 3), np.float32))
    config = short(iterations=2, depth="maps", masks="ignore")
    scene = load_scene(folder, masks=config.mask_use)
    model_bytes(scene, config, default_device, tmp_path / "run")
    assert scene_record.of_evaluation(Run.open(tmp_path / "run"), scene.test_views) == []


def test_other_depths_are_another_scene(folder: Path, default_device: Device, tmp_path: Path) -> None:
    config = short(iterations=4, depth="maps")
    model_bytes(load_scene(folder), config, default_device, tmp_path / "run")
    changed = load_scene(folder)
    other = replace(config, depth_unit=2e-3, iterations=6)
    with pytest.raises(InputError):
        model_bytes(changed, other, default_device, tmp_path / "run", resume=True)
