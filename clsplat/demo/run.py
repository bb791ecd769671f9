# SPDX-License-Identifier: Apache-2.0
"""The demo: make photos of a synthetic scene, recover their poses, train, evaluate and render a turntable.

Number of steps: DEMO_ITERATIONS in `config/cli_defaults.py`.
"""

from __future__ import annotations

import json
import sys
import time
from pathlib import Path

import numpy as np

from clsplat.api import train
from clsplat.config.cli_defaults import DEMO_ITERATIONS
from clsplat.config.training import TrainConfig
from clsplat.demo.ray_caster import write_photos
from clsplat.device.selection import open_device
from clsplat.errors import InputError, examples
from clsplat.evaluation.held_out import Evaluation
from clsplat.files.atomic import atomic_write
from clsplat.files.documents import is_file
from clsplat.gaussians import Gaussians
from clsplat.images.writing import write_image
from clsplat.progress import Progress, StageProgress, TrainProgress, no_progress
from clsplat.rendering.renderer import Renderer
from clsplat.runs.locks import locked
from clsplat.runs.run import Run
from clsplat.scenes.loading import load_scene
from clsplat.scenes.orientation.level import COLMAP_UP
from clsplat.scenes.sfm import reconstruct as sfm
from clsplat.shots.generated import turntable

DEMO_PHOTO_COUNT = 40
TURNTABLE_FRAME_COUNT = 60
DEMO_MARKER_FILE_NAME = ".clsplat-demo"
"""Marker file in a folder whose contents the demo has created."""
DEMO_FOLDERS = ("photos", "scene", "run", "turntable")
"""Folders that the demo writes in its output folder."""


def run_demo(output: Path, *, device: str | None = None, iterations: int = DEMO_ITERATIONS) -> Evaluation:
    """Run the demo: write photos/, scene/, run/ and turntable/ in `output`. Returns the evaluation, as in eval.json.

    Photos and cameras that an interrupted demo has completed are reused.
    device: name of the device, as for `clsplat devices`.
    iterations: number of training steps.
    Raises InputError if the folder has other files. Errors of COLMAP, training and rendering are passed on.
    """
    output.mkdir(parents=True, exist_ok=True)
    with locked(output, "demo"):
        claim(output)
        start = time.monotonic()
        # open the device first, so that a wrong name fails before minutes of work
        opened = open_device(device)
        report = StageProgress()
        scene_folder = make_scene(output, report)
        scene, config = load_scene(scene_folder), TrainConfig(iterations=iterations)
        run = Run.create(output / "run", config, scene=scene_folder, resume=False, overwrite=True)
        with TrainProgress(iterations) as progress:
            train(scene, config, device=opened, run=run, on_step=progress)
        result: Evaluation = json.loads(run.eval_path.read_text("utf-8"))
        gaussians, renderer = Gaussians.load(run.model_path), Renderer(opened)
        turntable_folder = output / "turntable"
        turntable_folder.mkdir(exist_ok=True)
        cameras, up = [view.camera for view in scene.views], np.array(COLMAP_UP) if scene.frame.upright else None
        for index, camera in enumerate(turntable(cameras, TURNTABLE_FRAME_COUNT, up)):
            picture = renderer.render(gaussians, camera, (0.0, 0.0, 0.0)).image
            write_image(turntable_folder / f"frame_{index:03d}.png", picture)
            report("rendering the turntable", (index + 1) / TURNTABLE_FRAME_COUNT)
    minutes, seconds = divmod(round(time.monotonic() - start), 60)
    print(
        f"done in {minutes} min {seconds} s: PSNR {result['mean']['psnr']:.2f} dB, SSIM {result['mean']['ssim']:.3f} "
        f"on {len(result['views'])} held-out photos\n"
        f"  the photos:           {output / 'photos'}\n"
        f"  held-out renders:     {run.test_path}\n"
        f"  the turntable:        {turntable_folder}\n"
        f"  the model (any viewer of splats opens it): {run.model_path}",
        file=sys.stderr,
    )
    return result


def claim(output: Path) -> None:
    """Mark a folder as the demo's. Raises InputError for an unmarked folder with files that it would replace."""
    if is_file(output / DEMO_MARKER_FILE_NAME):
        return
    existing = [name for name in DEMO_FOLDERS if (output / name).exists() or (output / name).is_symlink()]
    if existing:
        raise InputError(
            f"{output}: holds {examples(existing, len(DEMO_FOLDERS))}, which the demo did not create but "
            "would replace; choose another folder, or remove them"
        )
    atomic_write(
        output / DEMO_MARKER_FILE_NAME, b"This folder was made by clsplat demo, which may replace its content.\n"
    )


def make_scene(output: Path, progress: Progress = no_progress) -> Path:
    """Create photos in output/photos, and recover cameras and points in output/scene. Returns the scene's path.

    Results that are complete already are reused. Raises InputError if output/photos holds other files.
    """
    photos, scene = output / "photos", output / "scene"
    existing = sorted(path.name for path in photos.glob("[!.]*"))
    expected = [f"photo_{index:03d}.jpg" for index in range(DEMO_PHOTO_COUNT)]
    if not set(existing).issubset(expected):
        raise InputError(f"{photos}: holds files that the demo did not create, expected a new folder")
    if existing != expected:
        write_photos(photos, count=DEMO_PHOTO_COUNT, progress=progress)
    # fit a lens without distortion, like the ray caster's, so that the photos are not resampled
    settings = sfm.SfmSettings(camera_model="SIMPLE_PINHOLE")
    return sfm.reconstruct(photos, scene, settings, overwrite=True, progress=progress)
