# SPDX-License-Identifier: Apache-2.0
"""The training stage of a capture. It adapts settings to the scene, and continues an interrupted training."""

from __future__ import annotations

import json
import sys
from collections.abc import Callable, Collection
from contextlib import suppress
from pathlib import Path
from typing import Any

from clsplat.api import train
from clsplat.capture.progress import CaptureProgress
from clsplat.config.presets import scheduled
from clsplat.config.training import TrainConfig
from clsplat.device.context import Device
from clsplat.errors import InputError, warn
from clsplat.evaluation.held_out import Evaluation
from clsplat.files.documents import parse_json, read_document
from clsplat.runs.run import Run, is_run
from clsplat.scenes.analysis.photo_findings import SHORT_TRAINING_STEPS, findings
from clsplat.scenes.analysis.recommendations import SCHEDULE_SETTING, answered, paragraph
from clsplat.scenes.loading import load_scene_of
from clsplat.scenes.scene import Scene
from clsplat.selftest.driver_check import require
from clsplat.selftest.result import stages_of_training
from clsplat.training.forecast import Forecast
from clsplat.training.loop import StepReport
from clsplat.training.preparation import prepared


def train_scene(
    folder: Path,
    path: Path,
    config: TrainConfig,
    device: Device,
    progress: CaptureProgress,
    given: Collection[str] | None,
) -> Run:
    """Train the scene in `folder` to a run at `path`. An unfinished run there continues, a finished one is returned.

    config: settings of a new run.
    given: names of the settings that must not change; None to change no setting. Others are adapted to the scene as
        by `clsplat train --auto`, and the schedule to the number of steps.
    Raises InputError like `clsplat.train`. The message of a KeyboardInterrupt names the step of the latest checkpoint.
    """
    earlier = Run.open(path) if is_run(path) else None
    if earlier is not None and _is_finished(earlier):
        progress("using the model trained before", 1.0)
        return earlier
    config = config if earlier is None else earlier.config
    scene = _scene(folder, config, earlier, progress)
    for text in scene.warnings:
        warn(text)
    if earlier is None and given is not None:
        scene, config = _adapted(folder, scene, config, progress, given)
    device = require(device, stages_of_training(config))
    run = Run.create(path, config, scene=folder, resume=earlier is not None)
    run.resume_command = progress.again
    views = scene.train_views
    pixels = sum(view.camera.width * view.camera.height for view in views) / len(views)
    progress.forecast = Forecast(config, len(views), pixels)
    try:
        progress(f"training on {len(views)} pictures, {len(scene.points):,} points; on {device.name}", 0.0)
        train(scene, config, device=device, run=run, resume=run.resuming, on_step=_reporting(config, progress))
    except KeyboardInterrupt as error:
        steps = run.checkpoints()
        error.args = (f"at step {steps[-1][0]}" if steps else "before the first checkpoint",)
        raise
    return run


def evaluation_of(run: Run) -> Evaluation | None:
    """Return the scores of the run's held-out views; None if no view is held out."""
    if not run.eval_path.is_file():
        return None
    result: Evaluation = json.loads(run.eval_path.read_text("utf-8"))
    return result


def _is_finished(run: Run) -> bool:
    """Return True if the run has its model and the model's evaluation, both of the last step."""
    with suppress(OSError, ValueError, InputError):
        record = parse_json(read_document(run.eval_path, "the evaluation of a run"))
        newer = run.eval_path.stat().st_mtime_ns >= run.model_path.stat().st_mtime_ns
        return newer and bool(record["step"] == run.config.iterations)
    return False


def _scene(folder: Path, config: TrainConfig, earlier: Run | None, progress: CaptureProgress) -> Scene:
    """Load the scene for a training with these settings, and check that its pictures decode.

    earlier: the run that continues; None for a new run.
    """
    scene = load_scene_of(
        config,
        folder,
        progress=progress,
        frame=config.frame_use if earlier is None else earlier.frame_to_resume(),
    )
    scene = prepared(scene, config, earlier)
    scene.check_pictures()
    return scene


def _adapted(
    folder: Path, scene: Scene, config: TrainConfig, progress: CaptureProgress, given: Collection[str]
) -> tuple[Scene, TrainConfig]:
    """Print the findings about a scene. Returns the scene and the settings that answer the findings.

    If no finding asks for a schedule, a training of up to 10,000 steps gets the short schedule.
    """
    photographs = len(scene.train_views)
    progress("inspecting the photographs")
    found = findings(scene, config.mask_use, config.iterations)
    answers, better = answered(found, config, given, photographs)
    has_schedule = any(SCHEDULE_SETTING in answer.settings for answer in answers)
    if not has_schedule and config.iterations < SHORT_TRAINING_STEPS.stop:
        answers, better = answered(found, scheduled("short", config.iterations), given, photographs)
    print(paragraph(answers, len(scene.views), auto=True, sampled=len(scene.sampled_views)), file=sys.stderr)
    if (better.mask_use, better.lenses) != (config.mask_use, config.lenses):
        scene = _scene(folder, better, None, progress)
    return scene, better


def _reporting(config: TrainConfig, progress: CaptureProgress) -> Callable[[StepReport], Any]:
    """Return the callback that reports each training step as progress of the capture."""

    def report(step: StepReport) -> None:
        if progress.forecast is not None:
            progress.forecast.see(step)
        detail = f" {step.step}/{config.iterations}  PSNR {step.psnr:.2f}  {step.gaussians:,} Gaussians"
        progress("step", step.step / config.iterations, detail)

    return report
