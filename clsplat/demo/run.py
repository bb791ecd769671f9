# SPDX-License-Identifier: Apache-2.0
"""The demo: photos of a scene of our own, their poses thrown away and recovered, trained, measured and shown."""

from __future__ import annotations

import json
import sys
import time
from pathlib import Path
from typing import Any

from clsplat.api import train
from clsplat.config.training import TrainConfig
from clsplat.config.verbs import DEMO_ITERATIONS
from clsplat.demo.ray_caster import write_photos
from clsplat.device.context import open_device
from clsplat.errors import InputError, examples
from clsplat.files import atomic_write, is_file
from clsplat.gaussians import Gaussians
from clsplat.images.writing import write_image
from clsplat.progress import Progress, StageProgress, TrainProgress, no_progress
from clsplat.rendering.renderer import Renderer
from clsplat.runs.locks import locked
from clsplat.runs.run import Run
from clsplat.scenes import sfm
from clsplat.scenes.loading import load_scene
from clsplat.shots.generated import turntable

PHOTOS = 40
TURNTABLE_FRAMES = 60
MARK = ".clsplat-demo"
"""The file that says of a folder that a demo has made what is in it."""
MADE = ("photos", "scene", "run", "turntable")


def run_demo(output: Path, *, device: str | None = None, iterations: int = DEMO_ITERATIONS) -> dict[str, Any]:
    """Make everything below output: photos/, scene/, run/ and turntable/; returns the evaluation, as in eval.json.

    What an earlier, interrupted demo has finished is used again. device: as `clsplat devices` names it; iterations: of
    training. Raises InputError for a folder that holds something else, and what the steps raise.
    """
    output.mkdir(parents=True, exist_ok=True)
    with locked(output, "demo"):
        claim(output)
        start = time.monotonic()
        # before minutes of work: is there a device of that name?
        opened = open_device(device)
        report = StageProgress()
        scene_folder = make_scene(output, report)
        scene, config = load_scene(scene_folder), TrainConfig(iterations=iterations)
        run = Run.create(output / "run", config, scene=scene_folder, resume=False, overwrite=True)
        with TrainProgress(iterations) as progress:
            train(scene, config, device=opened, run=run, on_step=progress)
        result: dict[str, Any] = json.loads(run.eval_path.read_text("utf-8"))
        gaussians, renderer = Gaussians.load(run.model_path), Renderer(opened)
        turntable_folder = output / "turntable"
        turntable_folder.mkdir(exist_ok=True)
        for index, camera in enumerate(turntable([view.camera for view in scene.views], TURNTABLE_FRAMES)):
            picture = renderer.render(gaussians, camera, (0.0, 0.0, 0.0)).image
            write_image(turntable_folder / f"frame_{index:03d}.png", picture)
            report("rendering the turntable", (index + 1) / TURNTABLE_FRAMES)
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
    """Mark a folder as a demo's. Raises InputError where it has what a demo would replace, and is not marked."""
    if is_file(output / MARK):
        return
    existing = [name for name in MADE if (output / name).exists() or (output / name).is_symlink()]
    if existing:
        raise InputError(
            f"{output}: holds {examples(existing, len(MADE))}, which no demo has made and a demo would replace; choose "
            "another folder, or remove them"
        )
    atomic_write(output / MARK, b"What is beside this file was made by clsplat demo, which may replace it.\n")


def make_scene(output: Path, progress: Progress = no_progress) -> Path:
    """Photos in output/photos and the scene recovered from them in output/scene, whose path is returned.

    Both are used again where they are complete. Raises InputError where output/photos holds other files.
    """
    photos, scene = output / "photos", output / "scene"
    existing = sorted(path.name for path in photos.glob("[!.]*"))
    expected = [f"photo_{index:03d}.jpg" for index in range(PHOTOS)]
    if not set(existing).issubset(expected):
        raise InputError(f"{photos}: holds files that are not the demo's, expected a new folder")
    if existing != expected:
        write_photos(photos, count=PHOTOS, progress=progress)
    # the ray caster's lens has no distortion, as ours is known to have none: photos need no resampling
    return sfm.reconstruct(photos, scene, camera_model="SIMPLE_PINHOLE", overwrite=True, progress=progress)
