# SPDX-License-Identifier: Apache-2.0
"""What training may leave out: hidden Gaussians' steps, steps of the higher SH bands."""

from __future__ import annotations

from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest
from tiny import run_steps, short, write_scene

from clsplat.config.training import OptimiserConfig
from clsplat.device.context import Device
from clsplat.gaussians import Gaussians
from clsplat.images.reading import read_image
from clsplat.images.writing import write_image
from clsplat.scenes.loading import load_scene
from clsplat.scenes.scene import Scene
from clsplat.scenes.start.initialise import from_points
from clsplat.stages.device_gaussians import download_gaussians
from clsplat.training.trainer import Trainer


def with_one_behind(scene: Scene) -> Gaussians:
    """Its last Gaussian lies far behind each camera."""
    points = np.concatenate([scene.points, [[0.0, 0.0, -500.0]]]).astype(np.float32)
    colors = np.concatenate([scene.point_colors, scene.point_colors[:1]])
    model = from_points(points, colors)
    model.sh = np.pad(model.sh, ((0, 0), (0, 3), (0, 0)))  # degree 1
    model.log_scales[-1] = model.log_scales[0]
    return model


@pytest.mark.parametrize("sparse", [False, True])
def test_sparse_steps_leave_the_hidden(scene: Scene, default_device: Device, sparse: bool) -> None:
    """Dense Adam goes on moving a hidden Gaussian by what its first moment remembers."""
    config = replace(short(warmup=(), density={"every": 0}), optimiser=OptimiserConfig(sparse=sparse))
    model = with_one_behind(scene)
    trainer = Trainer(scene, config, default_device, model)
    moment = trainer.model.first["means"].get()
    moment[-1] = 0.5
    trainer.model.first["means"].set(moment)
    run_steps(3, trainer)
    after = download_gaussians(trainer.parameters)
    assert np.all(np.any(after.means[:-1] != model.means[:-1], axis=1)), "those in view move"
    assert np.array_equal(after.means[-1], model.means[-1]) == sparse
    assert np.array_equal(trainer.model.first["means"].get()[-1], moment[-1]) == sparse


@pytest.mark.parametrize("batch", [1, 2])
@pytest.mark.parametrize("sparse", [False, True])
def test_sparse_steps_leave_what_is_masked(tmp_path: Path, default_device: Device, batch: int, sparse: bool) -> None:
    """Photographs that a mask leaves out show all Gaussians, but their loss has no gradient."""
    folder = write_scene(tmp_path / "scene")
    (folder / "masks").mkdir()
    for photograph in (folder / "images").iterdir():
        write_image(folder / "masks" / photograph.name, np.zeros_like(read_image(photograph)))
    config = replace(
        short(warmup=(), density={"every": 0}, batch=batch), masks="ignore", optimiser=OptimiserConfig(sparse=sparse)
    )
    trainer = Trainer(load_scene(folder, masks=config.mask_use), config, default_device)
    moment = np.full_like(trainer.model.first["means"].get(), 0.5)
    trainer.model.first["means"].set(moment)
    before = download_gaussians(trainer.parameters)
    run_steps(2, trainer)
    assert np.array_equal(download_gaussians(trainer.parameters).means, before.means) == sparse
    assert np.array_equal(trainer.model.first["means"].get(), moment) == sparse


@pytest.mark.slow
def test_sh_rest_moves_in_its_steps_alone(scene: Scene, default_device: Device) -> None:
    config = replace(short(warmup=(), density={"every": 0}), optimiser=OptimiserConfig(sh_rest_every=3))
    model = with_one_behind(scene)
    trainer = Trainer(scene, replace(config, sh_degree_every=1), default_device, model)
    for step in range(1, 8):
        before = trainer.parameters["sh_rest"].get(), trainer.parameters["sh_dc"].get()
        trainer.train_step()
        after = trainer.parameters["sh_rest"].get(), trainer.parameters["sh_dc"].get()
        kept = np.zeros_like(after[0])
        kept[:, : before[0].shape[1]] = before[0]
        assert np.array_equal(after[0], kept) == (step % 3 != 0)
        assert not np.array_equal(after[1], before[1]), "the constant moves in every step"
