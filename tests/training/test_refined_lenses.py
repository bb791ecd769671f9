# SPDX-License-Identifier: Apache-2.0
"""Lenses that are refined in training: they come back, views share them, what a run has of them, refusals."""

from __future__ import annotations

import json
import shutil
from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest
from calls import refuses
from same_bytes import trained_run
from tiny import short

from clsplat.api import train
from clsplat.cli.main import main as clsplat
from clsplat.config.training import TrainConfig
from clsplat.device.context import Device
from clsplat.errors import InputError
from clsplat.evaluation.metrics import psnr
from clsplat.rendering.renderer import Renderer
from clsplat.runs.run import Run
from clsplat.scenes.dataset import Lens
from clsplat.scenes.loading import load_scene
from clsplat.scenes.scene import Scene
from clsplat.training.cameras.intrinsics import RefinedLenses
from clsplat.training.cameras.refinement import check_refinable
from clsplat.training.trainer import Trainer

CONFIG = short(iterations=40, refine_lenses=True)


def disturbed(scene: Scene, log: float, x: float, y: float) -> Scene:
    """The scene with every lens changed as `Lens.refocused` does it."""
    change = (log, x, y)
    views = [
        replace(view, camera=view.camera.refocused(*change), lens=view.lens.refocused(*change)) for view in scene.views
    ]
    return replace(scene, views=views)


@pytest.mark.slow
def test_a_lens_comes_back(scene: Scene, default_device: Device) -> None:
    """A principal point that is off by 3 % of the focal length costs 2 dB here; most of that comes back."""
    off, scores = disturbed(scene, 0.0, 0.03, 0.0), {}
    for refines in (False, True):
        config = replace(CONFIG, iterations=800, lens_reach=10.0, refine_lenses=refines)
        trainer, renderer = Trainer(off, config, default_device), Renderer(default_device)
        while trainer.step < config.iterations:
            trainer.train_step()
        model, views = trainer.gaussians(), trainer.cameras.lenses.of_views(off.test_views)
        found = [psnr(renderer.render(model, view.camera).image[:, :, :3], view.load()) for view in views]
        scores[refines] = float(np.mean(found))
    assert -0.03 < trainer.cameras.lenses.changes[0, 1] < -0.01
    assert scores[True] > scores[False] + 1


def test_what_a_run_has_of_them(folder: Path, scene: Scene, default_device: Device, tmp_path: Path) -> None:
    """refined/ has the changed lens, for held-out pictures too, and the poses as they were."""
    run = trained_run(scene, CONFIG, default_device, tmp_path / "run")
    assert "psnr_aligned" not in json.loads(run.eval_path.read_text())["mean"]
    again = load_scene(
        shutil.copytree(run.refined_path, tmp_path / "again" / "sparse").parent, images=folder / "images"
    )
    assert len({view.camera.fx for view in again.views}) == 1
    for found, given in zip(again.views, scene.views, strict=True):
        assert 0 < abs(found.camera.fx / given.camera.fx - 1) < CONFIG.lens_reach / 100
        assert found.camera.fx / given.camera.fx == pytest.approx(found.camera.fy / given.camera.fy)
        assert 0 < abs(found.camera.cx - given.camera.cx) < CONFIG.lens_reach / 100 * given.camera.fx
        np.testing.assert_allclose(found.camera.rotation, given.camera.rotation, atol=1e-12)
        np.testing.assert_allclose(found.camera.translation, given.camera.translation, atol=1e-12)


def test_views_of_one_lens_share_its_change(scene: Scene) -> None:
    other = Lens("PINHOLE", 100, 80, (90.0, 95.0, 50.0, 40.0))
    views = [replace(view, lens=other) if index % 3 == 0 else view for index, view in enumerate(scene.train_views)]
    lenses = RefinedLenses(CONFIG, views)
    camera = views[1].camera
    lenses.move(1, 40, camera, np.array([1.0, 1.0, 0.5, 0.5]))
    seen = [lenses.seen(view.lens, view.camera) is not view.camera for view in views]
    changed = [lenses.seen(view.lens, view.camera).fx != view.camera.fx for view in views]
    assert all(seen)
    assert changed == [view.lens != other for view in views]
    assert lenses.seen(Lens("PINHOLE", 7, 5, (6.0, 6.0, 3.0, 2.0)), camera) is camera  # of no training view
    lenses.move(1, 40, camera, np.array([np.nan, 1.0, 0.5, 0.5]))
    assert np.isfinite(lenses.changes).all()


def test_the_file_and_the_working_size_change_alike() -> None:
    lens = Lens("SIMPLE_PINHOLE", 400, 300, (350.0, 210.0, 140.0))
    small = lens.pinhole(np.eye(3), np.zeros(3)).resized(100, 75)
    changed = lens.refocused(0.01, 0.02, -0.03)
    from_file = changed.pinhole(np.eye(3), np.zeros(3)).resized(100, 75)
    from_small = small.refocused(0.01, 0.02, -0.03)
    for name in ("fx", "fy", "cx", "cy"):
        assert getattr(from_file, name) == pytest.approx(getattr(from_small, name))
    assert changed.refocused(-0.01, 0.0, 0.0).params[0] == pytest.approx(lens.params[0])


def test_what_is_bent_is_refused(scene: Scene) -> None:
    bent = Lens("SIMPLE_RADIAL", 100, 80, (90.0, 50.0, 40.0, 0.1))
    views = [replace(view, lens=bent) for view in scene.train_views]
    refuses(r"is SIMPLE_RADIAL, with distortion; expected photographs", check_refinable, CONFIG, views)
    check_refinable(replace(CONFIG, refine_lenses=False), views)


def test_refusals(scene: Scene, default_device: Device, tmp_path: Path) -> None:
    refuses("--refine-lenses: not supported with --batch 2", TrainConfig(refine_lenses=True, batch=2).check)
    with pytest.raises(InputError, match="--refine-lenses: not supported with 2 devices"):
        TrainConfig(refine_lenses=True).on_devices(2, explicit=False)
    refuses("over 0 and at most 50 percent", TrainConfig(lens_reach=0.0).check)
    run = Run.create(tmp_path / "run", CONFIG)
    train(scene, replace(CONFIG, iterations=4), device=default_device, run=run)
    with pytest.raises(InputError, match="refine_lenses is True, a resumed run"):
        train(scene, replace(CONFIG, refine_lenses=False), device=default_device, run=run, resume=True)


def test_a_damaged_checkpoint_is_told(scene: Scene) -> None:
    lenses = RefinedLenses(CONFIG, scene.train_views)
    good = {name.removeprefix("lenses/"): array for name, array in lenses.arrays().items()}
    lenses.load(good)
    with pytest.raises(ValueError, match=r"has no lenses/changes of shape \(1, 3\)"):
        lenses.load({**good, "changes": np.zeros((2, 3))})


def test_eval_takes_the_refined_lens(folder: Path, default_device: Device, tmp_path: Path) -> None:
    """clsplat eval RUN gives the figures that training wrote."""
    command = f"train {folder} -o {tmp_path}/run --iterations 40 --refine-lenses --no-report --warmup"
    assert clsplat([*command.split(), ""]) == 0
    path = tmp_path / "run" / "eval.json"
    before = json.loads(path.read_text())["mean"]
    assert clsplat(["eval", str(tmp_path / "run")]) == 0
    assert json.loads(path.read_text())["mean"] == before
    shutil.rmtree(tmp_path / "run" / "refined")
    assert clsplat(["eval", str(tmp_path / "run")]) == 0
    assert json.loads(path.read_text())["mean"] != before
