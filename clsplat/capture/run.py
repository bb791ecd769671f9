# SPDX-License-Identifier: Apache-2.0
"""`run_capture`: from people's own photographs or videos to a model, its report and pictures."""

from __future__ import annotations

from collections.abc import Collection, Sequence
from pathlib import Path

from clsplat.capture.folder import CaptureFolder
from clsplat.capture.pipeline import CapturePlan, make_capture
from clsplat.capture.sources import check_sources
from clsplat.config.presets import scheduled
from clsplat.device.selection import open_device
from clsplat.evaluation.held_out import Evaluation
from clsplat.progress import Progress
from clsplat.runs.locks import locked
from clsplat.scenes.analysis.photo_findings import SHORT_TRAINING_STEPS
from clsplat.selftest.driver_check import require

CAPTURE_TURNTABLE_FRAMES = 120
"""Number of frames of the turntable: five seconds of video."""


def run_capture(
    sources: Sequence[Path],
    output: Path,
    *,
    iterations: int,
    again: str,
    given: Collection[str] = (),
    device: str | None = None,
    overwrite: bool = False,
) -> Evaluation | None:
    """Write frames/, scene/, run/, report.html, thumbnail.png, turntable/ and capture.json to the folder `output`.

    sources: a folder of photographs, or videos.
    iterations: number of training steps.
    again: the command that goes on after an interruption.
    given: names of the training settings that the findings about the scene must not change, such as "iterations".
    device: name of the device, as for `clsplat devices`.
    overwrite: replace the results of another call in the output folder.

    Returns the scores of the held-out views, as in eval.json. Raises InputError for wrong input.
    Errors of a stage begin with the stage.
    """
    check_sources(sources, output)
    opened = require(open_device(device))  # first, so that a wrong name fails before minutes of work
    asked = {"input": [str(path.resolve()) for path in sources], "iterations": iterations}
    folder = CaptureFolder(output)
    output.mkdir(parents=True, exist_ok=True)
    plan = CapturePlan(
        again=again,
        source=f"{asked['input']}",
        config=scheduled("short" if iterations < SHORT_TRAINING_STEPS.stop else "paper", iterations),
        given=frozenset(given),
        turntable_frames=CAPTURE_TURNTABLE_FRAMES,
    )

    def take(progress: Progress) -> Path:
        progress("using the photographs where they are", 1.0)
        return sources[0]

    with locked(output, "capture"):
        folder.claim(asked, "capture", overwrite=overwrite)
        return make_capture(folder, take, plan, opened)
