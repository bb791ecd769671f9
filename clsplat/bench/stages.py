# SPDX-License-Identifier: Apache-2.0
"""`clsplat bench`: what each stage of a frame and of a training step costs, held against the device's own limits, and
run time against error for every switch of the rasterizer.

docs/performance.md says what each figure means.
"""

from __future__ import annotations

import os
import statistics
import time
from collections.abc import Callable
from dataclasses import asdict, dataclass, field, fields, replace
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import NDArray

from clsplat.camera import Camera
from clsplat.config.training import DensityConfig, OptimiserConfig, RasterizerConfig, TrainConfig
from clsplat.device.context import Device
from clsplat.device.profile import StageRecord
from clsplat.gaussians import Gaussians
from clsplat.models.formats import is_model_name
from clsplat.rendering.rasterizer import Frame, Renderer, held_sh
from clsplat.runs.run import Run, is_run
from clsplat.scenes.initialise import from_scene
from clsplat.scenes.lens import Lens
from clsplat.scenes.scene import Scene, View, load_scene
from clsplat.stages.blend import count_pairs
from clsplat.stages.limit import Limits, measure_limits
from clsplat.stages.project import upload_gaussians
from clsplat.training.trainer import Trainer

Float32 = NDArray[np.float32]
Float64 = NDArray[np.float64]
Progress = Callable[[str, float | None], None]

FORWARD = ("transfers", "project", "duplicate", "ranges", "blend")
"""Stages that are measured in a frame; the others in a training step."""
GAUSSIAN_BYTES = 4 * 59 * 4
"""Of a Gaussian of SH degree 3 in a training step: parameters, gradients and two moments."""


@dataclass(frozen=True, eq=False)
class Subject:
    """What is measured: a model, a view of it, and the photograph (H, W, 3) uint8 that a training step compares with,
    or None for one made up from the frame itself."""

    name: str
    gaussians: Gaussians
    camera: Camera
    photograph: NDArray[np.uint8] | None = None


def synthetic(count: int = 200_000, width: int = 1024, height: int = 768) -> Subject:
    """A made-up scene, the same every time; as it stands 1.0 M (tile, Gaussian) pairs, 56 M (Gaussian, pixel) ones."""
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
    arrays = (
        means,
        rng.normal(size=(count, 4)),
        np.log(sizes * depths / focal),
        np.log(opacities) - np.log1p(-opacities),
        sh,
    )
    means32, quaternions, log_scales, logits, coefficients = (
        np.ascontiguousarray(array, np.float32) for array in arrays
    )
    gaussians = Gaussians(means32, quaternions, log_scales, logits, coefficients)
    return Subject("synthetic", gaussians, camera)


def load_subject(path: Path, size: tuple[int, int] | None = None, progress: Progress | None = None) -> Subject:
    """A run: its model from the first view of its scene. A model file: as a run's, if it lies in one, else from a
    camera in front of it. A scene: the Gaussians that training starts from. Raises InputError."""
    run = next((Run.open(folder) for folder in (path, path.parent) if is_run(folder)), None)
    if run is not None and (path.is_dir() or path == run.model_path):
        gaussians = Gaussians.load(run.model_path)
        if run.scene is None or not run.scene.exists():
            return Subject(str(path), *facing(gaussians, *(size or (1024, 768))))
        config = run.config
        scene = load_scene(run.scene, resolution=config.resolution, test_every=config.test_every, progress=progress)
    elif is_model_name(path):
        gaussians = Gaussians.load(path)
        return Subject(str(path), *facing(gaussians, *(size or (1024, 768))))
    else:
        scene = load_scene(path, progress=progress)
        gaussians = from_scene(scene, TrainConfig().random_points, np.random.default_rng(0))
    view = (scene.train_views or scene.views)[0]
    camera = view.camera.resized(*size) if size else view.camera
    pixels = view.load(camera.width, camera.height)[:, :, :3]
    camera, gaussians = gaussians.local(camera), replace(gaussians, origin=np.zeros(3))
    return Subject(str(path), gaussians, camera, np.rint(255 * np.clip(pixels, 0, 1)).astype(np.uint8))


def facing(gaussians: Gaussians, width: int, height: int) -> tuple[Gaussians, Camera]:
    """The Gaussians, their means counted from where they are, and a camera with the world's axes that has nine tenths
    of them in its image."""
    low, middle, high = np.quantile(gaussians.means.astype(np.float64), (0.05, 0.5, 0.95), axis=0)
    focal = 0.9 * width
    half = np.maximum(high - middle, middle - low)
    distance = max(float(np.max(2 * focal * half[:2] / (width, height))) + float(half[2]), 0.1)
    position = middle - np.array([0.0, 0.0, distance])
    camera = Camera(width, height, focal, focal, width / 2, height / 2, np.eye(3), -position)
    return replace(gaussians, origin=np.zeros(3)), camera


def bench(
    subject: Subject,
    device: Device,
    config: RasterizerConfig | None = None,
    *,
    repeat: int = 5,
    limits: Limits | None = None,
    progress: Progress | None = None,
) -> dict[str, Any]:
    """What `clsplat bench --json` prints. The device's queue should have been made with profiling."""
    say = progress or (lambda *_: None)
    config = config or RasterizerConfig()
    say("limits", None)
    limits = limits or measure_limits(device)
    say("frame", None)
    trainer = trainer_of(subject, device, config)
    rasterizer, gaussians = trainer.rasterizer, trainer.parameters
    if held_kind(config) != held_kind(RasterizerConfig()):  # a frame's, not a training step's
        gaussians = upload_gaussians(device, subject.gaussians, held_sh(subject.gaussians, config))

    def draw() -> Frame:
        return rasterizer.forward(gaussians, subject.camera, trainer.background, backward=False)

    frame = draw()
    visible = int(np.count_nonzero(frame.projected.tile_counts.get()))
    listed = contributing = evaluated = 0
    for band in frame.bands:
        part = rasterizer.part(frame, band)
        listed += part.counted.pairs
        added, looked_at = count_pairs(
            rasterizer.device,
            rasterizer.work,
            part.lists,
            frame.projected.splats,
            frame.background,
            subject.camera,
            band,
        )
        contributing, evaluated = contributing + added, evaluated + looked_at
    in_frame = _measure(device, draw, repeat)
    say("training step", None)
    in_step = _measure(device, trainer.train_step, repeat)

    stages = {name: record for name, record in in_frame.stages.items() if name in FORWARD}
    stages.update({name: record for name, record in in_step.stages.items() if name not in stages})
    table = {name: _row(record, limits) for name, record in stages.items()}
    for name, limit in (("blend", limits.pairs_per_second), ("blend_grad", limits.gradient_pairs_per_second)):
        if name in table and table[name]["ms"] > 0:
            rate = 1e3 * contributing / table[name]["ms"]
            table[name].update(pairs_per_second=rate, share_of_arithmetic=rate / limit)
    return {
        "device": device.name,
        "driver": device.driver,
        "shape": {"lanes": device.shape.lanes, "items": device.shape.items},
        "source": subject.name,
        "rasterizer": asdict(config),
        "gaussians": len(subject.gaussians),
        "visible": visible,
        "sh_degree": subject.gaussians.sh_degree,
        "width": subject.camera.width,
        "height": subject.camera.height,
        "repeat": repeat,
        "load_average": os.getloadavg()[0] if hasattr(os, "getloadavg") else None,
        "timer": "wall" if in_frame.by_wall else "events",
        "frame_ms": in_frame.ms,
        "iteration_ms": in_step.ms,
        "stages": table,
        "pairs": {"listed": listed, "contributing": contributing, "evaluated": evaluated},
        "limit": asdict(limits),
    }


@dataclass(frozen=True)
class _Measured:
    """ms: wall time, nothing recorded; stages: medians; by_wall: the driver's events give no times."""

    ms: float
    stages: dict[str, StageRecord]
    by_wall: bool


def _measure(device: Device, work: Callable[[], object], repeat: int) -> _Measured:
    """Medians over `repeat` rounds: plain, with events, and waiting at the seams of the stages."""
    for _ in range(2):
        work()
    walls: list[float] = []
    by_events: list[dict[str, StageRecord]] = []
    by_waiting: list[dict[str, StageRecord]] = []
    for _ in range(repeat):
        walls.append(wall_ms(device, work))
        for records, wait in ((by_events, False), (by_waiting, True)):
            with device.recorder.recording(device, wait=wait) as stages:
                work()
            records.append(stages)
    by_wall = not any(record.ms for stages in by_events for record in stages.values())
    medians = {}
    for name, record in by_events[0].items():
        waits = [stages[name].wall_ms for stages in by_waiting]
        times = [stages[name].kernels for stages in by_events]
        kernels = {kernel: statistics.median(each.get(kernel, 0.0) for each in times) for kernel in record.kernels}
        total = statistics.median(waits if by_wall else [sum(each.values()) for each in times])
        medians[name] = replace(record, kernels=kernels, ms=total, wall_ms=statistics.median(waits))
    return _Measured(statistics.median(walls), medians, by_wall)


def wall_ms(device: Device, work: Callable[[], object]) -> float:
    """Milliseconds of `work`, from an idle device to an idle device."""
    device.finish()
    start = time.perf_counter()
    work()
    device.finish()
    return 1e3 * (time.perf_counter() - start)


def _row(record: StageRecord, limits: Limits) -> dict[str, Any]:
    rate = 1e3 * record.bytes / record.ms if record.ms > 0 else 0.0
    return {
        "ms": record.ms,
        "wall_ms": record.wall_ms,
        "launches": record.launches,
        "bytes": record.bytes,
        "bytes_per_second": rate,
        "share_of_copy": rate / limits.copy_bytes_per_second,
        "kernels": record.kernels,
    }


@dataclass(frozen=True, eq=False)
class _Picture(View):
    """A view whose pixels are in memory."""

    pixels: Float32 = field(kw_only=True)

    def load(self, width: int | None = None, height: int | None = None) -> Float32:  # noqa: ARG002  # of one size
        return self.pixels


def trainer_of(subject: Subject, device: Device, config: RasterizerConfig) -> Trainer:
    """A trainer whose steps do all the work of a real one and leave the model as it is: every rate is zero."""
    camera = subject.camera
    photograph = subject.photograph
    if photograph is None:  # the frame mirrored: a picture like it, with a gradient everywhere
        mirrored = Renderer(device, config=config).render(subject.gaussians, camera).image[:, ::-1]
        photograph = np.rint(255 * np.clip(mirrored, 0, 1)).astype(np.uint8)
    lens = Lens("PINHOLE", camera.width, camera.height, (camera.fx, camera.fy, camera.cx, camera.cy))
    pixels = (photograph / np.float32(255)).astype(np.float32)
    view = _Picture("bench", camera, Path("bench"), "train", lens, pixels=pixels)
    scene = Scene("bench", [view], np.zeros((0, 3)), np.zeros((0, 3), np.float32), (np.zeros(3), np.ones(3)))
    names = [each.name for each in fields(OptimiserConfig)]
    still = {name: 0.0 for name in names if "_rate" in name and name != "means_rate_steps"}
    settings = TrainConfig(
        sh_degree=subject.gaussians.sh_degree,
        warmup=(),
        optimiser=OptimiserConfig(**still),  # type: ignore[arg-type]  # all of them are floats
        density=DensityConfig(every=0),
        rasterizer=config,
    )
    return Trainer(scene, settings, device, subject.gaussians)


def picture_of(frame: Frame) -> Float32:
    """(H, W, 3) on the host."""
    camera = frame.camera
    planes: Float32 = frame.blended.image.get()[:, : camera.height, : camera.width]
    return np.ascontiguousarray(planes.transpose(1, 2, 0))


def held_kind(config: RasterizerConfig) -> tuple[object, ...]:
    """The switches of which a model on the device depends."""
    return config.sh_tolerance, config.sh_storage


def table(result: dict[str, Any]) -> str:
    """What `bench` measured, for people."""
    stages, limit, pairs = result["stages"], result["limit"], result["pairs"]
    driver, size = result["driver"].split("  ")[0], f"{result['width']}x{result['height']}"
    arithmetic, gradient, copying = (
        limit[name] * 1e-9 for name in ("pairs_per_second", "gradient_pairs_per_second", "copy_bytes_per_second")
    )
    seen = f"{result['gaussians']:,} Gaussians, SH degree {result['sh_degree']}, {result['visible']:,} visible"
    most = f"{arithmetic:.2f} Gpairs/s of blending arithmetic, {gradient:.2f} of its gradient's"
    of_pixels = f"{pairs['contributing']:,} that contribute, {pairs['evaluated']:,} evaluated"
    lines = [
        f"{result['device']}, {driver}, {limit['lanes']} lanes x {limit['items']} items",
        f"{result['source']}: {seen}, at {size}",
        f"pairs: {pairs['listed']:,} of tiles; of pixels {of_pixels}",
        f"limits: {most}, {copying:.1f} GB/s of copying",
        "",
    ]
    header = ("stage", "ms", "wall ms", "launches", "MB", "GB/s", "of copy", "Gpairs/s", "of arithmetic")
    rows: list[tuple[str, ...]] = [header]
    for name, row in stages.items():
        rate = row.get("pairs_per_second")
        rows.append(
            (
                name,
                f"{row['ms']:.3f}",
                f"{row['wall_ms']:.3f}",
                str(row["launches"]),
                f"{row['bytes'] * 1e-6:.1f}",
                f"{row['bytes_per_second'] * 1e-9:.2f}",
                f"{row['share_of_copy']:.0%}",
                "" if rate is None else f"{rate * 1e-9:.3f}",
                "" if rate is None else f"{row['share_of_arithmetic']:.0%}",
            )
        )
    lines += columns(rows)
    note = "ms by events" if result["timer"] == "events" else "ms by wall time: the driver's events have none"
    times = f"frame {result['frame_ms']:.2f} ms, training step {result['iteration_ms']:.2f} ms"
    load = f"load average {result['load_average'] or 0:.1f}"
    return "\n".join([*lines, "", f"{times}: medians of {result['repeat']}; {note}; {load}"])


def columns(rows: list[tuple[str, ...]]) -> list[str]:
    """Aligned: the first column to the left, the others to the right."""
    widths = [max(len(row[column]) for row in rows) for column in range(len(rows[0]))]
    return [
        "  ".join(
            cell.ljust(width) if column == 0 else cell.rjust(width)
            for column, (cell, width) in enumerate(zip(row, widths, strict=True))
        ).rstrip()
        for row in rows
    ]
