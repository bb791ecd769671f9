# SPDX-License-Identifier: Apache-2.0
"""Training with --antialiased: the same bytes however it is cut, scales that the pictures show, files that say so."""

from __future__ import annotations

import json
from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest
from calls import Capture
from tiny import CONFIG, run_steps

from clsplat.cli.main import main
from clsplat.device.context import Device
from clsplat.gaussians import Gaussians
from clsplat.models.formats import load
from clsplat.reference.sampling import sampling_limits
from clsplat.rendering.renderer import Renderer
from clsplat.scenes.scene import Scene
from clsplat.stages.device_gaussians import AnyGaussians
from clsplat.training import mip_filter
from clsplat.training.mip_filter import MipFilter
from clsplat.training.trainer import Trainer

SMOOTH = replace(CONFIG, antialiased=True)


def test_no_scale_is_less_than_the_pictures_show(scene: Scene, default_device: Device) -> None:
    trainer = Trainer(scene, replace(SMOOTH, density=replace(SMOOTH.density, every=0)), default_device)
    start = trainer.gaussians().means.astype(np.float64)
    run_steps(30, trainer)
    model = trainer.gaussians()
    cameras = [trainer.local(view.camera) for view in trainer.views]
    limits = sampling_limits(start, cameras)  # they were worked out once, before the first step
    assert np.isfinite(limits).any()
    assert (model.log_scales >= limits[:, None] - 1e-4).all()
    assert model.antialiased


@pytest.mark.parametrize("views", [1, 2, 3, 8])
def test_the_cameras_are_looked_at_every_hundred_steps(
    views: int, scene: Scene, default_device: Device, monkeypatch: pytest.MonkeyPatch
) -> None:
    looked: list[int] = []
    renew = MipFilter.before_step

    def noted(self: MipFilter, gaussians: AnyGaussians) -> None:
        looked.append(trainer.step)
        renew(self, gaussians)

    monkeypatch.setattr(mip_filter, "SAMPLING_LIMIT_INTERVAL_STEPS", 12)
    monkeypatch.setattr(MipFilter, "before_step", noted)
    config = replace(SMOOTH, density=replace(SMOOTH.density, every=0), batch=views, iterations=48)
    trainer = Trainer(scene, config, default_device)
    while trainer.step < 48:
        trainer.train_step()
    assert [(step - 1) // 12 for step in looked] == [0, 1, 2, 3]


@pytest.mark.slow
def test_files_that_say_so(scene: Scene, folder: Path, tmp_path: Path, capsys: Capture) -> None:
    run = tmp_path / "run"
    assert main(["train", str(folder), "-o", str(run), "--iterations", "20", "--antialiased"]) == 0
    model = load(run / "model.ply")
    assert model.antialiased
    assert b"\ncomment SplatRenderMode: mip\n" in (run / "model.ply").read_bytes()[:2000]
    camera = scene.views[0].camera
    plain = Renderer().render(replace(model, antialiased=False), camera).image
    smooth = Renderer().render(model, camera).image
    assert np.abs(plain - smooth).max() > 1e-3
    for name in ("model.spz", "model.compressed.ply", "model.sog"):
        capsys.readouterr()
        assert main(["convert", str(run), str(tmp_path / name)]) == 0
        assert load(tmp_path / name).antialiased
        assert "cannot store antialiasing" not in capsys.readouterr().err
        assert main(["info", str(tmp_path / name), "--json"]) == 0
        assert json.loads(capsys.readouterr().out)["antialiased"] is True
    assert main(["info", str(run / "model.ply")]) == 0
    assert "antialiased" in capsys.readouterr().out
    assert main(["convert", str(run), str(tmp_path / "model.splat")]) == 0
    assert "splat cannot store antialiasing" in capsys.readouterr().err


def test_models_that_are_drawn_differently_do_not_merge(tmp_path: Path, scene: Scene, capsys: Capture) -> None:
    plain = Gaussians.load(_saved(tmp_path / "plain.ply", antialiased=False))
    assert not plain.antialiased
    _saved(tmp_path / "smooth.ply", antialiased=True)
    call = ["convert", str(tmp_path / "plain.ply"), str(tmp_path / "both.ply"), "--merge", str(tmp_path / "smooth.ply")]
    assert main(call) == 2
    assert "some are not" in capsys.readouterr().err
    assert not (tmp_path / "both.ply").exists()


def _saved(path: Path, *, antialiased: bool) -> Path:
    zeros = np.zeros((2, 3), np.float32)
    model = Gaussians(
        zeros, np.ones((2, 4), np.float32), zeros - 2, np.zeros(2, np.float32), np.zeros((2, 1, 3), np.float32),
        antialiased=antialiased,
    )  # fmt: skip
    model.save(path)
    return path
