# SPDX-License-Identifier: Apache-2.0
"""The demo: a capture (`clsplat.capture`) of photographs of a synthetic scene.

Number of steps: DEMO_ITERATIONS in `config/cli_defaults.py`.
"""

from __future__ import annotations

import shlex
from pathlib import Path

from clsplat.capture.folder import CaptureFolder
from clsplat.capture.pipeline import CapturePlan, make_capture
from clsplat.capture.sources import PhotographSource
from clsplat.config.cli_defaults import DEMO_ITERATIONS
from clsplat.config.training import TrainConfig
from clsplat.demo.ray_caster import write_photos
from clsplat.device.selection import open_device
from clsplat.errors import InputError
from clsplat.evaluation.held_out import Evaluation
from clsplat.progress import Progress, no_progress
from clsplat.runs.locks import locked
from clsplat.scenes.sfm.reconstruct import SfmSettings

DEMO_PHOTO_COUNT = 40
TURNTABLE_FRAME_COUNT = 60
DEMO_PHOTOS_SECONDS = 20.0
"""Expected seconds to render the demo's photographs, on two cores."""


def run_demo(output: Path, *, device: str | None = None, iterations: int = DEMO_ITERATIONS) -> Evaluation | None:
    """Run the demo: write photos/ and the results of a capture in `output`. Returns the evaluation, as in eval.json.

    What an interrupted demo has completed is used again. Results for another number of steps are replaced.
    device: the device's selector, as for `open_device`; None for the default device.
    iterations: number of training steps.
    Raises InputError if the folder has other files. Errors of COLMAP, training and rendering are passed on.
    """
    output.mkdir(parents=True, exist_ok=True)
    folder = CaptureFolder(output, frames="photos")
    plan = CapturePlan(
        again=shlex.join(["clsplat", "demo", "-o", str(output), "--iterations", str(iterations)]),
        source=f"demo {DEMO_PHOTO_COUNT}",
        config=TrainConfig(iterations=iterations),
        # fit a lens without distortion, like the ray caster's, so that the photos are not resampled
        sfm=SfmSettings(camera_model="SIMPLE_PINHOLE"),
        frames_seconds=DEMO_PHOTOS_SECONDS,
        turntable_frames=TURNTABLE_FRAME_COUNT,
    )
    with locked(output, "demo"):
        claim(folder, iterations)
        opened = open_device(device)  # first, so that a wrong name fails before minutes of work
        return make_capture(folder, lambda progress: make_photos(folder.frames, progress), plan, opened)


def claim(folder: CaptureFolder, iterations: int) -> None:
    """Record a demo in the folder, which may have the results of an earlier demo. Raises InputError for any other."""
    asked = {"demo": DEMO_PHOTO_COUNT, "iterations": iterations}
    earlier = folder.asked()
    folder.claim(asked, "demo", overwrite="demo" in earlier and earlier != asked)


def make_photos(photos: Path, progress: Progress = no_progress) -> PhotographSource:
    """Create the demo's photographs in the folder `photos` unless they are complete, and return them.

    Raises InputError if the folder holds other files.
    """
    existing = sorted(path.name for path in photos.glob("[!.]*"))
    expected = [f"photo_{index:03d}.jpg" for index in range(DEMO_PHOTO_COUNT)]
    if not set(existing).issubset(expected):
        raise InputError(f"{photos}: holds files that the demo did not create, expected a new folder")
    if existing != expected:
        write_photos(photos, count=DEMO_PHOTO_COUNT, progress=progress)
    return PhotographSource(photos, DEMO_PHOTO_COUNT)
