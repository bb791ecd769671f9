# SPDX-License-Identifier: Apache-2.0
"""The stages of a capture: photographs, cameras, training, report, thumbnail and turntable (`make_capture`).

Each stage uses the results that an earlier call has completed, if they were made from the same input.
"""

from __future__ import annotations

import sys
import time
from collections.abc import Callable
from dataclasses import dataclass
from pathlib import Path

import numpy as np

from clsplat.capture.folder import CaptureFolder
from clsplat.capture.pictures import ModelPictures
from clsplat.capture.progress import CaptureProgress
from clsplat.capture.sources import PhotographSource
from clsplat.capture.training import evaluation_of, train_scene
from clsplat.config.training import TrainConfig
from clsplat.device.context import Device
from clsplat.evaluation.held_out import Evaluation
from clsplat.files.atomic import atomic_write
from clsplat.files.documents import digest, load_document
from clsplat.images.video import video_missing
from clsplat.progress import Progress
from clsplat.report import REPORT_FILE_NAME
from clsplat.report.page import write_report
from clsplat.runs.run import Run
from clsplat.scenes.loading import load_scene
from clsplat.scenes.orientation.level import COLMAP_UP
from clsplat.scenes.sfm.captured_files import SFM_RECORD_FILE
from clsplat.scenes.sfm.reconstruct import DEFAULT_SFM_SETTINGS, SfmSettings, reconstruct

ASSUMED_PHOTOGRAPHS = 100
"""Number of photographs that the estimate of the remaining time assumes until their number is known."""
SFM_SECONDS_PER_PHOTOGRAPH = 0.7
"""Expected seconds of structure from motion per photograph, on two cores."""
CPU_SECONDS_PER_STEP, GPU_SECONDS_PER_STEP = 0.05, 0.005
"""Expected seconds of a training step before the first steps are measured: on two CPU cores, and on a GPU."""
SECONDS_PER_PICTURE = 0.15
"""Expected seconds to render and write a frame of a turntable, on two cores."""
SECONDS_PER_REPORT = 5.0
"""Expected seconds to write a report."""

TakePhotographs = Callable[[Progress], PhotographSource]
"""Function of the first stage, which makes or finds the photographs."""


@dataclass(frozen=True)
class CapturePlan:
    """Settings of a capture.

    again: the command that goes on after an interruption.
    source: text that identifies the input and the settings of the first stage.
    config: settings of the training.
    given: names of the training settings that must not change, while others are adapted to the scene; None to keep all
        settings.
    sfm: settings of structure from motion.
    frames_seconds: expected duration of the first stage in seconds.
    turntable_frames: number of frames of the turntable.
    """

    again: str
    source: str
    config: TrainConfig
    given: frozenset[str] | None = None
    sfm: SfmSettings = DEFAULT_SFM_SETTINGS
    frames_seconds: float = 0.0
    turntable_frames: int = 60


def make_capture(folder: CaptureFolder, take: TakePhotographs, plan: CapturePlan, device: Device) -> Evaluation | None:
    """Carry out the stages of a capture. Returns the scores as in eval.json; None if no view is held out.

    folder: the output folder, claimed for this call (`CaptureFolder.claim`).
    take: function of the first stage, which returns the photographs.
    Messages of errors begin with the stage's name. After KeyboardInterrupt, a repetition of the call goes on in the
    stage that was interrupted.
    """
    start = time.monotonic()
    with CaptureProgress(_expected(plan, device), plan.again) as progress:
        with progress.stage("frames"):
            folder.begin("frames", plan.source)
            photographs = take(progress)
        with progress.stage("cameras"):
            progress.expect("cameras", photographs.count * SFM_SECONDS_PER_PHOTOGRAPH)
            folder.begin("cameras", plan.source)
            reconstruct(
                photographs.path,
                folder.scene,
                plan.sfm,
                frames=photographs.frames,
                frames_to=photographs.frames_to,
                progress=progress,
            )
        with progress.stage("training"):
            run = _trained(folder, plan, device, progress)
        _show(folder, run, plan, device, progress)
    result = evaluation_of(run)
    print(_closing(folder, photographs.path, run, result, time.monotonic() - start), file=sys.stderr)
    return result


def _expected(plan: CapturePlan, device: Device) -> dict[str, float]:
    """Return the expected duration in seconds of each stage."""
    step = GPU_SECONDS_PER_STEP if device.kind == "gpu" else CPU_SECONDS_PER_STEP
    return {
        "frames": plan.frames_seconds,
        "cameras": ASSUMED_PHOTOGRAPHS * SFM_SECONDS_PER_PHOTOGRAPH,
        "training": plan.config.iterations * step,
        "report": SECONDS_PER_REPORT,
        "thumbnail": SECONDS_PER_PICTURE,
        "turntable": plan.turntable_frames * SECONDS_PER_PICTURE,
    }


def _trained(folder: CaptureFolder, plan: CapturePlan, device: Device, progress: CaptureProgress) -> Run:
    """Train the scene, or continue the training that an earlier call began. Returns the run."""
    record = load_document(folder.scene / SFM_RECORD_FILE, "the record of a result of sfm", "its fingerprint")
    folder.begin("training", f"{record.get('fingerprint')} {plan.config.iterations}")
    return train_scene(folder.scene, folder.run, plan.config, device, progress, plan.given)


def _show(folder: CaptureFolder, run: Run, plan: CapturePlan, device: Device, progress: CaptureProgress) -> None:
    """Write the report, the thumbnail and the turntable of the trained model."""
    source = digest(run.model_path)
    with progress.stage("report"):
        folder.begin("report", source)
        _write_report(folder, run, progress)
    with progress.stage("thumbnail"):
        folder.begin("thumbnail", source)
        scene = load_scene(folder.scene, resolution=run.config.resolution, frame=run.frame_for(folder.scene))
        up = np.array(COLMAP_UP) if scene.frame.upright else None
        pictures = ModelPictures(run, device, [view.camera for view in scene.views], plan.turntable_frames, up)
        if not folder.thumbnail.is_file():
            progress("rendering the thumbnail")
            pictures.write_thumbnail(folder.thumbnail)
    with progress.stage("turntable"):
        folder.begin("turntable", f"{source} {plan.turntable_frames}")
        pictures.write_turntable(folder.turntable, progress)


def _write_report(folder: CaptureFolder, run: Run, progress: Progress) -> None:
    """Copy the run's report to the output folder. If the training wrote no report, write one first."""
    if folder.report.is_file():
        progress("using the report written before", 1.0)
        return
    progress("writing the report", None)
    if not (run.path / REPORT_FILE_NAME).is_file():
        write_report(run)
    atomic_write(folder.report, (run.path / REPORT_FILE_NAME).read_bytes())


def _closing(folder: CaptureFolder, photographs: Path, run: Run, result: Evaluation | None, seconds: float) -> str:
    """Return the text for the end of a capture: time, scores, the command that shows the model, and the results' paths.

    photographs: folder of the photographs. result: scores of the held-out views; None if no view is held out.
    """
    minutes, rest = divmod(round(seconds), 60)
    scores = ""
    if result is not None:
        mean = result["mean"]
        scores = f": PSNR {mean['psnr']:.2f} dB, SSIM {mean['ssim']:.3f} on {len(result['views'])} held-out photos"
    lines = {
        "look at the model": f"clsplat view {run.path}",
        "the photos": photographs,
        "the held-out renders": run.test_path,
        "the model": f"{run.model_path} (any viewer of splats opens it)",
        "the report": folder.report,
        "the turntable": folder.turntable,
        "the thumbnail": folder.thumbnail,
    }
    rows = [f"  {name + ':':<22} {value}" for name, value in lines.items()]
    note = [f"no video of the turntable: {video_missing()}"] if video_missing() else []
    return "\n".join([f"done in {minutes} min {rest} s{scores}", *rows, *note])
