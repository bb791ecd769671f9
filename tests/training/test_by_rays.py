# SPDX-License-Identifier: Apache-2.0
"""Training with pinholes' pictures along rays: when it is so, the same bytes however it is cut, files that say so."""

from __future__ import annotations

import json
from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest
from calls import Capture
from test_intrinsics import write_lens_scene
from tiny import CONFIG, hidden_model

from clsplat.cli.main import main
from clsplat.device.context import Device
from clsplat.models.formats import load
from clsplat.rendering.renderer import Renderer
from clsplat.scenes.loading import load_scene
from clsplat.scenes.scene import Scene
from clsplat.training.trainer import Trainer


@pytest.mark.slow
def test_it_is_so_where_the_scene_has_other_lenses(scene: Scene, default_device: Device, tmp_path: Path) -> None:
    wide = load_scene(write_lens_scene(tmp_path / "wide", "fisheye"), lenses="native")
    mixed = replace(scene, views=[*wide.views[:3], *scene.views[3:]])
    wanted = {"auto": (False, True, True), "plane": (False, False, False), "rays": (True, True, True)}
    for perspective, outcomes in wanted.items():
        config = replace(CONFIG, perspective=perspective, iterations=2)
        for each, by_rays in zip((scene, wide, mixed), outcomes, strict=True):
            trainer = Trainer(each, config, default_device)
            kinds = {
                trainer.camera(index, view.camera.width, view.camera.height).model.along_rays
                for index, view in enumerate(trainer.views)
                if view.camera.projection == "perspective"
            }
            assert kinds <= {by_rays}
            trainer.train_step()
            assert trainer.gaussians().by_rays == by_rays


@pytest.mark.slow
def test_files_that_say_so(scene: Scene, folder: Path, tmp_path: Path, capsys: Capture) -> None:
    run = tmp_path / "run"
    assert main(["train", str(folder), "-o", str(run), "--iterations", "20", "--perspective", "rays"]) == 0
    model = load(run / "model.ply")
    assert model.by_rays
    assert b"\ncomment clsplat rays\n" in (run / "model.ply").read_bytes()[:2000]
    camera = replace(scene.views[0].camera, fx=0.4 * scene.views[0].camera.fx)
    plane = Renderer().render(replace(model, by_rays=False), camera).image
    assert np.abs(plane - Renderer().render(model, camera).image).max() > 1e-3
    capsys.readouterr()
    assert main(["convert", str(run), str(tmp_path / "model.compressed.ply")]) == 0
    assert "along rays" not in capsys.readouterr().err
    for name in (tmp_path / "model.compressed.ply", run / "model.ply"):
        assert load(name).by_rays
        assert main(["info", str(name), "--json"]) == 0
        assert json.loads(capsys.readouterr().out)["by_rays"] is True
    assert main(["info", str(run / "model.ply")]) == 0
    assert "along rays" in capsys.readouterr().out
    assert main(["convert", str(run), str(tmp_path / "model.splat")]) == 0
    assert "splat cannot store drawing along rays" in capsys.readouterr().err
    assert (
        main(["render", str(run), "--cameras", str(folder), "-o", str(tmp_path / "{name}.exr"), "--frames", "1"]) == 0
    )
    again = ["train", str(folder), "-o", str(run), "--iterations", "30", "--resume", "--perspective", "plane"]
    assert main(again) == 2
    assert "perspective is rays, a resumed run cannot change it to plane" in capsys.readouterr().err


def test_what_it_does_not_go_with(folder: Path, tmp_path: Path, capsys: Capture) -> None:
    call = ["train", str(folder), "-o", str(tmp_path / "run"), "--perspective", "rays", "--refine-lenses"]
    assert main(call) == 2
    assert "not supported with --perspective rays, expected --perspective plane" in capsys.readouterr().err
    assert main(["train", str(folder), "-o", str(tmp_path / "run"), "--perspective", "fisheye"]) == 2
    assert "--perspective" in capsys.readouterr().err


def test_models_that_are_drawn_differently_do_not_merge(tmp_path: Path, capsys: Capture) -> None:
    for name, by_rays in (("plane", False), ("rays", True)):
        replace(hidden_model(), by_rays=by_rays).save(tmp_path / f"{name}.ply")
    call = ["convert", str(tmp_path / "plane.ply"), str(tmp_path / "both.ply"), "--merge", str(tmp_path / "rays.ply")]
    assert main(call) == 2
    assert "some of the models are drawn along rays and some are not" in capsys.readouterr().err
    assert not (tmp_path / "both.ply").exists()


def test_settings_are_not_compared_along_rays(tmp_path: Path, capsys: Capture) -> None:
    replace(hidden_model(), by_rays=True).save(tmp_path / "rays.ply")
    assert main(["bench", str(tmp_path / "rays.ply"), "--plot", str(tmp_path / "plot.svg"), "--size", "64x48"]) == 2
    assert "drawn along rays" in capsys.readouterr().err
