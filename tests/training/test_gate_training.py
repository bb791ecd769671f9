# SPDX-License-Identifier: Apache-2.0
"""Trainings with a gate on refined cameras: bad ones are gone back from, good ones stay, and a run goes on alike."""

from __future__ import annotations

import warnings
from collections.abc import Callable
from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest
from calls import warned, warnings_of
from compare import assert_same_arrays
from held_out import psnr_of
from same_bytes import gone_on, outcome, trained_run
from tiny import short, trained_to, write_scene

from clsplat.api import train
from clsplat.config.training import OptimiserConfig, TrainConfig
from clsplat.device.context import Device
from clsplat.evaluation.held_out import EvaluatedModel, evaluate
from clsplat.images.alpha import background_colour
from clsplat.rendering.renderer import Renderer
from clsplat.report.run_numbers import read_run_numbers
from clsplat.runs.run import Run
from clsplat.scenes.loading import load_scene
from clsplat.scenes.scene import Scene
from clsplat.training.cameras.poses import Poses
from clsplat.training.loop import StepReport
from clsplat.training.trainer import Trainer

FAST = OptimiserConfig(means_rate=5e-3, sh_dc_rate=0.02, scales_rate=0.02, opacities_rate=0.1)
REFINED = {"refine_poses": True, "pose_reach": 0.5, "refine_gate": 0.5}
CONFIG = short(iterations=60, report=False, density={"every": 0}, optimiser=FAST, **REFINED)
"""Nothing but the cameras makes a model of this worse on its way, and it follows them quickly."""


@pytest.fixture
def sabotaged(monkeypatch: pytest.MonkeyPatch) -> None:
    """Steps uphill, of 6 degrees and as much of a world unit along each motion, after the second measurement."""
    moved = Poses.move

    def move(poses: Poses, view: int, step: int, gradient: np.ndarray) -> None:
        if step > 12:
            poses.cameras[view] = poses.cameras[view].moved(0.1 * np.sign(gradient))
        else:
            moved(poses, view, step, gradient)

    monkeypatch.setattr(Poses, "move", move)


def poses_of(trainer: Trainer) -> np.ndarray:
    cameras = trainer.cameras.poses.cameras
    return np.array([np.append(camera.rotation, camera.translation) for camera in cameras])


def test_bad_poses_are_gone_back_from(
    scene: Scene, default_device: Device, tmp_path: Path, sabotaged: None, undisturbed: bytes
) -> None:
    """To the poses of the best measurement, and the run says so."""
    run = Run.create(tmp_path / "run", CONFIG)
    told = warnings_of(lambda: train(scene, CONFIG, device=default_device, run=run))
    told = [text for text in told if "held-out views had" in text]
    gate = run.read_metrics()[-1]["gate"]
    ended, steps = gate["ended"], [each["step"] for each in gate["measured"]]
    figures = {each["step"]: each["psnr"] for each in gate["measured"]}
    assert steps == list(range(6, 61, 6))
    assert gate["best"] in (12, 18)
    assert ended is not None
    last, before = figures[ended], figures[ended - 6]
    assert max(last, before) < figures[gate["best"]] - CONFIG.refine_gate
    assert ended < 54
    assert figures[60] > last + 0.5  # what is left of the training makes good use of them
    assert len(told) == 1
    assert f"the cameras of step {gate['best']} are restored" in told[0]
    assert any(f"ended at step {ended}" in note for note in read_run_numbers(run).notes)
    assert run.model_path.read_bytes() != undisturbed


def test_the_cameras_stay_then(scene: Scene, default_device: Device, sabotaged: None) -> None:
    trainer, seen = Trainer(scene, CONFIG, default_device), {}

    def make_steps() -> None:
        while trainer.step < 50:
            trainer.train_step()
            seen[trainer.step] = poses_of(trainer)

    warned("held-out views had", make_steps)
    best, ended = trainer.cameras.gate.best[0], trainer.cameras.gate.ended
    assert ended is not None
    assert ended < 50
    assert not np.array_equal(seen[ended], seen[best])
    for step in (ended + 1, 50):  # the step after a measurement begins with what it decided
        np.testing.assert_array_equal(seen[step], seen[best])


def test_good_poses_are_let_be(scene: Scene, default_device: Device, tmp_path: Path, undisturbed: bytes) -> None:
    """A gate that never closes changes no byte."""
    config = replace(CONFIG, refine_gate=0.0)
    run = trained_run(scene, config, default_device, tmp_path / "run")
    assert run.model_path.read_bytes() == undisturbed
    assert not any("gate" in record for record in run.read_metrics())
    trainer = trained_to(CONFIG.iterations, scene, CONFIG, default_device)
    assert trainer.cameras.gate.ended is None
    assert len(trainer.cameras.gate.measured) == 9  # the last is the loop's


def test_poses_and_lenses_go_back_together(scene: Scene, default_device: Device) -> None:
    """To the bit, with their moments."""
    cameras = Trainer(scene, replace(CONFIG, refine_lenses=True), default_device).cameras

    def move(step: int) -> None:
        for view in range(len(scene.train_views)):
            cameras.poses.move(view, step, np.arange(1.0, 7.0))
            cameras.lenses.move(view, step, cameras.of(view), np.arange(1.0, 5.0))

    move(7)
    kept = {name: array.copy() for name, array in cameras.refined_arrays().items()}
    move(8)
    assert not any(np.array_equal(array, kept[name]) for name, array in cameras.refined_arrays().items())
    cameras.go_back(kept)
    for name, array in cameras.refined_arrays().items():
        np.testing.assert_array_equal(array, kept[name])


@pytest.mark.slow
@pytest.mark.parametrize("stop", [18, 42, 48, 54])
def test_a_run_goes_on_alike(scene: Scene, default_device: Device, tmp_path: Path, sabotaged: None, stop: int) -> None:
    """Killed before the poses go back, with checkpoints until then, at it, and after it."""
    config = replace(CONFIG, checkpoint_every=6)
    with warnings.catch_warnings():
        warnings.simplefilter("ignore")
        whole = outcome(scene, config, default_device, tmp_path / "whole")
        run = Run.create(tmp_path / "run", config)
        with pytest.raises(KeyboardInterrupt):
            train(scene, config, device=default_device, run=run, on_step=stopping(stop))
        assert max(step for step, _ in run.checkpoints()) == stop - 6
        resumed = Run.create(run.path, config, resume=True)
        assert_same_arrays(gone_on(scene, config, default_device, resumed), whole)
    records = [folder.read_metrics()[-1]["gate"] for folder in (run, Run.open(tmp_path / "whole"))]
    assert records[0] == records[1]


def stopping(at: int) -> Callable[[StepReport], None]:
    def stop(report: StepReport) -> None:
        if report.step == at:
            raise KeyboardInterrupt

    return stop


@pytest.mark.parametrize("background", ["black", "white"])
def test_the_measure_is_that_of_an_evaluation(tmp_path: Path, default_device: Device, background: str) -> None:
    """Of photographs with alpha, before any pose has moved."""
    scene = load_scene(write_scene(tmp_path / "scene", alpha=True))
    config: TrainConfig = replace(CONFIG, background=background)
    trainer, renderer = Trainer(scene, config, default_device), Renderer(default_device)
    behind, model = background_colour(background), trainer.gaussians()
    found = psnr_of(trainer, [view.camera for view in scene.test_views])
    result = evaluate(
        lambda view: renderer.render(model, view.camera, behind).image,
        scene.test_views,
        behind,
        model=EvaluatedModel(None, 0, None),
    )
    assert found == pytest.approx(result["mean"]["psnr"], abs=1e-4)  # pixels of 8 bits are floats there
