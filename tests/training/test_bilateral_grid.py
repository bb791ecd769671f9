# SPDX-License-Identifier: Apache-2.0
"""Bilateral grids of photographs, learnt with the model."""

from __future__ import annotations

import json
from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest
from held_out import change_photographs
from same_bytes import trained_run
from tiny import CONFIG

from clsplat.cli.main import main
from clsplat.device.context import Device
from clsplat.layouts.columns import GRID_SHAPE
from clsplat.scenes.scene import Scene
from clsplat.training.trainer import Trainer

WITH_GRIDS = replace(CONFIG, appearance="grid")


def test_only_grids_of_trained_views_move(default_device: Device, scene: Scene) -> None:
    trainer = Trainer(scene, WITH_GRIDS, default_device)
    trainer.train_step()
    trainer.train_step()
    moved = trainer.checkpoint()[0]["appearance/first"].reshape(len(scene.train_views), -1).any(axis=1)
    assert moved.sum() == 2


def test_a_run_keeps_its_grids(
    default_device: Device,
    scene: Scene,
    monkeypatch: pytest.MonkeyPatch,
    tmp_path: Path,
    capsys: pytest.CaptureFixture[str],
) -> None:
    """Photographs that are darker by turns: their grids are, and their mean is the identity at the end."""
    count = len(scene.train_views)
    change_photographs(monkeypatch, lambda index, values: values * np.float32(0.6 if index % 2 else 1.0))
    density = replace(CONFIG.density, every=0)
    config = replace(WITH_GRIDS, iterations=20 * count + 2, density=density, warmup=())  # it ends within a pass
    run = trained_run(scene, config, default_device, tmp_path / "run")
    record = json.loads(run.appearance_path.read_text("utf-8"))
    assert record["kind"] == "grid"
    with np.load(run.appearance_path.with_suffix(".npz")) as file:
        grids = file["grids"]
    assert grids.shape == (count, *GRID_SHAPE)
    np.testing.assert_allclose(grids.mean(axis=0), np.broadcast_to(np.eye(3, 4), GRID_SHAPE), atol=1e-6)
    gains = grids[:, :, :, :, range(3), range(3)].mean(axis=(1, 2, 3, 4))
    assert gains[::2].min() > gains[1::2].max()
    assert "psnr_corrected" in json.loads(run.eval_path.read_text("utf-8"))["mean"]
    cameras = str(scene.train_views[1].path.parents[1])
    names = ["--appearance", scene.train_views[1].name]
    assert main(["render", str(run.path), "--cameras", cameras, "-o", f"{tmp_path}/{{name}}.png", *names]) == 2
    assert "is of --appearance grid, which is only for training" in capsys.readouterr().err
