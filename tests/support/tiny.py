# SPDX-License-Identifier: Apache-2.0
"""A scene that trains in seconds: a COLMAP folder with pictures of a hidden model, rendered by the float64 twin."""

from __future__ import annotations

from dataclasses import replace
from functools import cache
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import NDArray
from scenes import make_gaussians

from clsplat.camera import Camera
from clsplat.config.training import DensityConfig, OptimiserConfig, TrainConfig
from clsplat.device.context import Device
from clsplat.gaussians import Gaussians
from clsplat.images.writing import write_image
from clsplat.reference.render import render
from clsplat.scenes.scene import Scene
from clsplat.stages.device_gaussians import upload_gaussians
from clsplat.training.trainer import Trainer

WIDTH, HEIGHT, FOCAL = 48, 40, 50.0
VIEWS = 10
"""Number of views. The default split holds out two of them, the first and the ninth."""
DISTANCE = 4.0

CONFIG = TrainConfig(
    iterations=40,
    sh_degree=2,
    sh_degree_every=12,
    warmup=(4, 9),
    checkpoint_every=0,
    optimiser=OptimiserConfig(means_rate_steps=400, means_rate=1e-3, means_rate_end=1e-4),
    density=DensityConfig(
        every=5,
        start=10,
        stop=38,
        gradient_threshold=4e-3,
        dense_fraction=0.04,
        opacity_reset_every=20,
        opacity_reset_to=0.1,
        max_world_fraction=0.08,
    ),
)
"""A training of 40 steps with all events: warm-up, SH degrees, density control and opacity reset."""

EVENTS = {"warm-up": 3, "resolution": 4, "densification": 15, "SH degree": 12, "opacity reset": 20, "nothing": 33}
"""Steps after which tests stop CONFIG, by the event that is then due or has just happened."""


def hidden_model(count: int = 40) -> Gaussians:
    """The model that the pictures show: coloured Gaussians in a ball of radius 1 around the origin."""
    rng = np.random.default_rng(12)
    means = rng.normal(size=(count, 3))
    means *= (rng.uniform(0.1, 1.0, count) ** (1 / 3) / np.linalg.norm(means, axis=1))[:, None]
    sh = np.zeros((count, 1, 3))
    sh[:, 0] = rng.uniform(-1.6, 1.6, (count, 3))
    log_scales = np.log(rng.uniform(0.08, 0.3, (count, 3)))
    return make_gaussians(means, rng.normal(size=(count, 4)), log_scales, rng.uniform(0.6, 0.98, count), sh)


def cameras() -> list[Camera]:
    """Cameras on an arc of 120 degrees around the origin, in turn slightly above and below it."""
    made = []
    for index, angle in enumerate(np.linspace(-np.pi / 3, np.pi / 3, VIEWS)):
        position = DISTANCE * np.array([np.sin(angle), 0.15 * (-1) ** index, -np.cos(angle)])
        forward = -position / np.linalg.norm(position)
        right = np.cross([0.0, 1.0, 0.0], forward)
        right /= np.linalg.norm(right)
        rotation = np.stack([right, np.cross(forward, right), forward])
        made.append(Camera(WIDTH, HEIGHT, FOCAL, FOCAL, WIDTH / 2, HEIGHT / 2, rotation, -rotation @ position))
    return made


@cache
def pictures() -> list[tuple[NDArray[np.float64], NDArray[np.float64]]]:
    """Image (H, W, 3) over black, and alpha (H, W), of every camera."""
    model = hidden_model()
    return [render(model, camera) for camera in cameras()]


def write_scene(folder: Path, *, alpha: bool = False, points: bool = True) -> Path:
    """Write the scene as a COLMAP folder with text files and 8-bit PNGs. Returns the folder.

    alpha: write RGBA pictures.
    points: False for a model without points.
    """
    model, sparse, images = hidden_model(), folder / "sparse" / "0", folder / "images"
    sparse.mkdir(parents=True)
    images.mkdir()
    (sparse / "cameras.txt").write_text(f"1 PINHOLE {WIDTH} {HEIGHT} {FOCAL} {FOCAL} {WIDTH / 2} {HEIGHT / 2}\n")
    lines = []
    for index, (camera, (image, opacity)) in enumerate(zip(cameras(), pictures(), strict=True)):
        q, t = quaternion(camera.rotation), camera.translation
        pose = " ".join(f"{value:.17g}" for value in (*q, *t))
        lines.append(f"{index + 1} {pose} 1 {index:02d}.png\n\n")
        pixels = image
        if alpha:
            straight = np.divide(image, opacity[:, :, None], out=np.zeros_like(image), where=opacity[:, :, None] > 0)
            pixels = np.concatenate([straight, opacity[:, :, None]], axis=2)
        write_image(images / f"{index:02d}.png", np.clip(pixels, 0, 1).astype(np.float32))
    (sparse / "images.txt").write_text("".join(lines))
    rng = np.random.default_rng(1)
    colors = np.clip(255 * (0.5 + 0.28209479177387814 * model.sh[:, 0]), 0, 255).astype(int)
    listed = model.means + rng.normal(0, 0.05, model.means.shape)
    rows = [
        f"{index + 1} {' '.join(map(repr, point.tolist()))} {' '.join(map(str, color))} 0.1\n"
        for index, (point, color) in enumerate(zip(listed, colors, strict=True))
    ]
    (sparse / "points3D.txt").write_text("".join(rows) if points else "")
    return folder


def quaternion(rotation: NDArray[np.float64]) -> NDArray[np.float64]:
    """w x y z of a rotation by less than 180 degrees."""
    w = np.sqrt(1 + np.trace(rotation)) / 2
    x, y, z = (rotation[i, j] - rotation[j, i] for i, j in ((2, 1), (0, 2), (1, 0)))
    return np.array([w, x / (4 * w), y / (4 * w), z / (4 * w)])


def short(**changes: object) -> TrainConfig:
    """CONFIG with changes. density: a dictionary with changes of CONFIG.density."""
    density = changes.pop("density", {})
    config = replace(CONFIG, **changes)  # type: ignore[arg-type]
    return replace(config, density=replace(config.density, **density))  # type: ignore[arg-type]


FEW = short(iterations=3, sh_degree_every=1, report=False, density={"every": 0})
"""A training of three steps, without density control."""


def run_steps(count: int, trainer: Trainer) -> None:
    for _ in range(count):
        trainer.train_step()


def trained_to(step: int, scene: Scene, config: TrainConfig, device: Device, **options: Any) -> Trainer:
    """The trainer after `step` steps. options: arguments of `Trainer`."""
    trainer = Trainer(scene, config, device, **options)
    run_steps(step, trainer)
    return trainer


def loss_curve(scene: Scene, device: Device) -> list[float]:
    """Losses of 20 steps with all events, for `golden/loss_curve.json`.

    Nothing in this training depends on the last bits. All Gaussians are cloned or split when this is due, so that none
    is close to a threshold. None starts as a ball: for a ball the gradient of the rotation is only rounding, which Adam
    would turn into full steps.
    """
    rng = np.random.default_rng(3)
    start = hidden_model()
    start.means += rng.normal(0, 0.05, start.means.shape).astype(np.float32)
    start.log_scales += rng.normal(0.1, 0.2, start.log_scales.shape).astype(np.float32)
    start.sh *= np.float32(0.5)
    density = {"start": 3, "stop": 13, "gradient_threshold": 0.0, "opacity_reset_every": 12}
    trainer = Trainer(scene, short(warmup=(2, 4), sh_degree_every=7, density=density), device)
    trainer.model.set(upload_gaussians(device, start))
    return [trainer.train_step().read()[0] for _ in range(20)]
