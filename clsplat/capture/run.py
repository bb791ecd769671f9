# SPDX-License-Identifier: Apache-2.0
"""`run_capture`: from photographs or videos to a model, its report and pictures."""

from __future__ import annotations

import json
from collections.abc import Collection, Sequence
from pathlib import Path

from clsplat.capture.folder import CaptureFolder
from clsplat.capture.pipeline import CapturePlan, make_capture
from clsplat.capture.sources import check_sources, photographs_of
from clsplat.config.training import TrainConfig
from clsplat.device.selection import open_device
from clsplat.evaluation.held_out import Evaluation
from clsplat.runs.locks import locked
from clsplat.selftest.driver_check import require

CAPTURE_TURNTABLE_FRAMES = 120
"""Number of frames of the turntable: five seconds of video."""
FRAMES_SECONDS_PER_VIDEO = 60.0
"""Expected seconds to take the frames of a video, whose length is not known beforehand."""


def run_capture(
    sources: Sequence[Path],
    output: Path,
    *,
    iterations: int,
    again: str,
    frames: int | None = None,
    given: Collection[str] = (),
    device: str | None = None,
    overwrite: bool = False,
) -> Evaluation | None:
    """Write frames/, scene/, run/, report.html, thumbnail.png, turntable/ and capture.json to the folder `output`.

    sources: one folder with photographs, videos or both, or else video files.
    iterations: number of training steps.
    frames: number of frames of each video; None for a number by its length and motion.
    again: the command that goes on after an interruption.
    given: names of the training settings that the findings about the scene must not change, such as "iterations".
    device: selector of the device, as for --device; None for the default device.
    overwrite: accept and replace the results in the output folder (`CaptureFolder.claim`).

    Returns the scores of the held-out views, as in eval.json; None if no view is held out. Raises InputError for wrong
    input. Messages of errors in a stage begin with its name.
    """
    check_sources(sources, output, frames)
    opened = require(open_device(device))  # first, so that a wrong name fails before minutes of work
    photographs = {"input": [str(path.resolve()) for path in sources], "frames": frames}
    folder = CaptureFolder(output)
    output.mkdir(parents=True, exist_ok=True)
    plan = CapturePlan(
        again=again,
        source=json.dumps(photographs),
        config=TrainConfig(iterations=iterations),
        given=frozenset(given),
        frames_seconds=0.0 if sources[0].is_dir() else FRAMES_SECONDS_PER_VIDEO * len(sources),
        turntable_frames=CAPTURE_TURNTABLE_FRAMES,
    )

    with locked(output, "capture"):
        folder.claim({**photographs, "iterations": iterations}, "capture", overwrite=overwrite)
        return make_capture(folder, lambda progress: photographs_of(sources, folder, frames, progress), plan, opened)
