# SPDX-License-Identifier: Apache-2.0
"""Workloads of benchmarks: Gaussians, camera and photograph of a synthetic scene, a model, a run or a scene."""

from __future__ import annotations

from dataclasses import dataclass, replace
from functools import partial
from pathlib import Path

import numpy as np
from numpy.typing import NDArray

from clsplat.camera import Camera
from clsplat.config.masks import NO_MASKS, MaskUse
from clsplat.config.training import TrainConfig
from clsplat.gaussians import Gaussians
from clsplat.models.formats import is_model_name
from clsplat.progress import Progress
from clsplat.runs.run import run_of
from clsplat.scenes.loading import load_scene, load_scene_of
from clsplat.scenes.start.initialise import from_scene


@dataclass(frozen=True, eq=False)
class Subject:
    """Workload of a benchmark: what is rendered and trained on.

    camera: camera from which frames are rendered.
    photograph: (H, W, 3) uint8, the target of a training step; None makes a target from the frame.
    masks: meaning of masks and alpha channels. Unless it is NO_MASKS, the photograph is (H, W, 5), as from
        `View.load_masked`.
    """

    name: str
    gaussians: Gaussians
    camera: Camera
    photograph: NDArray[np.uint8] | None = None
    masks: MaskUse = NO_MASKS


def synthetic(count: int = 200_000, width: int = 1024, height: int = 768) -> Subject:
    """Make a synthetic scene, the same in every call.

    count: number of Gaussians.
    width, height: size of the frame in pixels.

    The default has 1.0 M (tile, Gaussian) pairs and 56 M (Gaussian, pixel) pairs.
    """
    rng = np.random.default_rng(0)
    focal = 0.9 * width
    camera = Camera(width, height, focal, focal, width / 2, height / 2, np.eye(3), np.zeros(3))
    depths = rng.uniform(2.0, 10.0, (count, 1))
    pixels = rng.uniform(-0.05, 1.05, (count, 2)) * (width, height)
    means = np.concatenate([(pixels - (camera.cx, camera.cy)) / focal * depths, depths], axis=1)
    sizes = 1.5 * np.sqrt(width * height / count)
    sizes = sizes * np.exp(rng.normal(0.0, 0.5, (count, 1)) + rng.normal(0.0, 0.5, (count, 3)))
    opacities = 0.005 + 0.99 * rng.beta(0.6, 0.8, count)
    sh = rng.normal(0.0, 0.1, (count, 16, 3))
    sh[:, 0] = rng.uniform(-1.5, 1.5, (count, 3))
    scales, logits = np.log(sizes * depths / focal), np.log(opacities) - np.log1p(-opacities)
    single = partial(np.ascontiguousarray, dtype=np.float32)
    arrays = (single(means), single(rng.normal(size=(count, 4))), single(scales), single(logits), single(sh))
    return Subject("synthetic", Gaussians(*arrays), camera)


def load_subject(path: Path, size: tuple[int, int] | None = None, progress: Progress | None = None) -> Subject:
    """Load the workload at a path: a run, a model file or a scene. Raises InputError.

    A run, or a run's model file, gives the model and the first view of the run's scene. Another model file gives the
    model and a camera in front of it. A scene gives the initial Gaussians and the first view.
    size: width and height of the frame in pixels; None for the camera's.
    progress: function that is called with a text and the completed fraction; None for no calls.
    """
    run = run_of(path)
    if run is not None and not path.is_dir() and path != run.model_path:
        run = None
    if run is not None or is_model_name(path):
        gaussians = Gaussians.load(run.model_path if run else path)
        if run is None or run.scene is None or not run.scene.exists():
            return Subject(str(path), *facing(gaussians, *(size or (1024, 768))))
        config = run.config
        masks = config.mask_use
        scene = load_scene_of(config, run.scene, frame=run.frame_for(run.scene), progress=progress)
    else:
        scene, masks = load_scene(path, progress=progress), NO_MASKS
        gaussians = from_scene(scene, TrainConfig().random_points, np.random.default_rng(0))
    view = (scene.train_views or scene.views)[0]
    camera = view.camera.resized(*size) if size else view.camera
    pixels = view.load_masked(camera.width, camera.height)
    if masks == NO_MASKS:
        pixels = pixels[:, :, :3]
    camera, gaussians = gaussians.local(camera), replace(gaussians, origin=np.zeros(3))
    return Subject(str(path), gaussians, camera, np.rint(255 * np.clip(pixels, 0, 1)).astype(np.uint8), masks)


def facing(gaussians: Gaussians, width: int, height: int) -> tuple[Gaussians, Camera]:
    """Return a copy of the Gaussians with origin zero, and a camera without rotation that sees most of them.

    width, height: size of the camera's picture in pixels.
    """
    low, middle, high = np.quantile(gaussians.means.astype(np.float64), (0.05, 0.5, 0.95), axis=0)
    focal = 0.9 * width
    half = np.maximum(high - middle, middle - low)
    distance = max(float(np.max(2 * focal * half[:2] / (width, height))) + float(half[2]), 0.1)
    position = middle - np.array([0.0, 0.0, distance])
    camera = Camera(width, height, focal, focal, width / 2, height / 2, np.eye(3), -position)
    return replace(gaussians, origin=np.zeros(3)), camera.along_rays(gaussians.by_rays)
