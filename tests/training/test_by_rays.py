# SPDX-License-Identifier: Apache-2.0
"""Training with pinholes' pictures along rays: when it is so, and files that say so, of antialiased models too."""

from __future__ import annotations

import json
from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest
from calls import Capture, printed
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
                trainer.loader.camera(index, view.camera.width, view.camera.height).model.along_rays
                for index, view in enumerate(trainer.views)
                if view.camera.projection == "perspective"
            }
            assert kinds <= {by_rays}
            trainer.train_step()
            assert trainer.gaussians().by_rays == by_rays


DRAWN = {
    "antialiased": ("--antialiased", b"SplatRenderMode: mip", ("spz", "compressed.ply", "sog"), "antialiasing"),
    "by_rays": ("--perspective rays", b"clsplat rays", ("compressed.ply",), "projection along rays"),
}
"""By its field in a model: the flags, the comment in a PLY, formats that store it, and its name where one cannot."""


@pytest.mark.slow
@pytest.mark.parametrize("field", DRAWN)
def test_files_that_say_so(scene: Scene, folder: Path, tmp_path: Path, capsys: Capture, field: str) -> None:
    run, (flags, comment, endings, name) = tmp_path / "run", DRAWN[field]
    assert main(["train", str(folder), "-o", str(run), "--iterations", "20", *flags.split()]) == 0
    assert b"\ncomment %s\n" % comment in (run / "model.ply").read_bytes()[:2000]
    model, camera = load(run / "model.ply"), replace(scene.views[0].camera, fx=0.4 * scene.views[0].camera.fx)
    images = [Renderer().render(replace(model, **{field: on}), camera).image for on in (False, True)]
    assert np.abs(images[0] - images[1]).max() > 1e-3
    for path in (run / "model.ply", *(tmp_path / f"model.{ending}" for ending in endings)):
        capsys.readouterr()
        assert path.exists() or main(["convert", str(run), str(path)]) == 0
        assert f"cannot store {name}" not in capsys.readouterr().err
        assert getattr(load(path), field)
        assert json.loads(printed(capsys, ["info", path, "--json"]).out)[field] is True
    assert {"by_rays": "along rays"}.get(field, field) in printed(capsys, ["info", run / "model.ply"]).out
    assert f"splat cannot store {name}" in printed(capsys, ["convert", run, tmp_path / "model.splat"]).err
    assert main(f"render {run} --cameras {folder} -o {tmp_path}/{{name}}.exr --frames 1".split()) == 0


@pytest.mark.parametrize("field", DRAWN)
def test_models_that_are_drawn_differently_do_not_merge(tmp_path: Path, capsys: Capture, field: str) -> None:
    for name, on in (("plain", False), ("other", True)):
        replace(hidden_model(), **{field: on}).save(tmp_path / f"{name}.ply")
    assert not getattr(load(tmp_path / "plain.ply"), field)
    call = ["convert", str(tmp_path / "plain.ply"), str(tmp_path / "both.ply"), "--merge", str(tmp_path / "other.ply")]
    assert main(call) == 2
    drawn = {"by_rays": "drawn along rays"}.get(field, field)
    assert f"{drawn} and some are not" in capsys.readouterr().err
    assert not (tmp_path / "both.ply").exists()


def test_what_it_does_not_go_with(folder: Path, tmp_path: Path, capsys: Capture) -> None:
    call = ["train", str(folder), "-o", str(tmp_path / "run"), "--perspective", "rays", "--refine-lenses"]
    assert "not supported with --perspective rays, expected --perspective plane" in printed(capsys, call, status=2).err
    assert main(["train", str(folder), "-o", str(tmp_path / "run"), "--perspective", "fisheye"]) == 2
    assert "--perspective" in capsys.readouterr().err
    assert main([*call[:-1], "--iterations", "2", "--no-report"]) == 0
    assert main(["train", "-o", str(tmp_path / "run"), "--iterations", "3", "--resume", "--perspective", "plane"]) == 2
    assert "perspective is rays, a resumed run cannot change it to plane" in capsys.readouterr().err


@pytest.mark.slow
def test_settings_are_not_compared_along_rays(tmp_path: Path, capsys: Capture) -> None:
    replace(hidden_model(), by_rays=True).save(tmp_path / "rays.ply")
    assert main(["bench", str(tmp_path / "rays.ply"), "--plot", str(tmp_path / "plot.svg"), "--size", "64x48"]) == 2
    assert "drawn along rays" in capsys.readouterr().err
