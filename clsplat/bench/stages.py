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
from dataclasses import asdict, dataclass, field, replace
from pathlib import Path
from typing import Any

import numpy as np

from clsplat.arrays import Float32
from clsplat.bench.subject import Subject
from clsplat.config.rasterizer import RasterizerConfig
from clsplat.config.training import DensityConfig, OptimiserConfig, TrainConfig
from clsplat.device.context import Device
from clsplat.device.profile import Calls, StageRecord
from clsplat.gaussians import GROUPS, floats_of
from clsplat.progress import Progress, aligned, no_progress
from clsplat.rendering.rasterizer import Frame
from clsplat.rendering.renderer import Renderer, held_sh
from clsplat.scenes.data_set import Lens
from clsplat.scenes.scene import Scene, View
from clsplat.stages.blend import count_pairs
from clsplat.stages.device_gaussians import upload_gaussians
from clsplat.stages.limit import Limits, measure_limits
from clsplat.training.trainer import Trainer

FORWARD = ("transfers", "project", "duplicate", "ranges", "blend")
"""Stages that are measured in a frame; the others in a training step."""
GAUSSIAN_BYTES = 4 * floats_of(16) * 4
"""Bytes of a Gaussian of SH degree 3 in a training step: parameters, gradients and two moments."""


def bench(
    subject: Subject,
    device: Device,
    config: RasterizerConfig | None = None,
    *,
    repeat: int = 5,
    limits: Limits | None = None,
    progress: Progress | None = None,
) -> dict[str, Any]:
    """Measure every stage; returns what `clsplat bench --json` prints. The device's queue should have been made with
    profiling."""
    say = progress or no_progress
    config = (config or RasterizerConfig()).switches()
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
        drawn = (part.lists, frame.projected.splats, frame.background, subject.camera)
        added, looked_at = count_pairs(rasterizer.device, rasterizer.work, *drawn)
        contributing, evaluated = contributing + added, evaluated + looked_at
    frame_ms, frame_host, in_frame, by_wall = _measure(device, draw, repeat)
    frame_calls = calls_of(device, draw)
    say("training step", None)
    iteration_ms, iteration_host, in_step, _ = _measure(device, trainer.train_step, repeat)
    iteration_calls = calls_of(device, trainer.train_step)

    stages = {name: record for name, record in in_frame.items() if name in FORWARD}
    stages.update({name: record for name, record in in_step.items() if name not in stages})
    table: dict[str, dict[str, Any]] = {}
    for name, record in stages.items():
        rate = 1e3 * record.bytes / record.ms if record.ms > 0 else 0.0
        shares = {"bytes_per_second": rate, "share_of_copy": rate / limits.copy_bytes_per_second}
        table[name] = asdict(record) | shares
    for name, limit in (("blend", limits.pairs_per_second), ("blend_grad", limits.gradient_pairs_per_second)):
        if name in table and table[name]["ms"] > 0:
            rate = 1e3 * contributing / table[name]["ms"]
            table[name].update(pairs_per_second=rate, share_of_arithmetic=rate / limit)
    return {
        "device": device.name,
        "driver": device.driver,
        "shape": {name: getattr(device.shape, name) for name in ("lanes", "items", "by_gaussian", "subgroups")},
        "source": subject.name,
        "rasterizer": asdict(config),
        "gaussians": len(subject.gaussians),
        "visible": visible,
        "sh_degree": subject.gaussians.sh_degree,
        "width": subject.camera.width,
        "height": subject.camera.height,
        "repeat": repeat,
        "load_average": os.getloadavg()[0] if hasattr(os, "getloadavg") else None,
        "timer": "wall" if by_wall else "events",
        "frame_ms": frame_ms,
        "iteration_ms": iteration_ms,
        "frame_host_ms": frame_host,
        "iteration_host_ms": iteration_host,
        "frame_calls": asdict(frame_calls),
        "iteration_calls": asdict(iteration_calls),
        "stages": table,
        "pairs": {"listed": listed, "contributing": contributing, "evaluated": evaluated},
        "limit": asdict(limits),
    }


def calls_of(device: Device, work: Callable[[], object]) -> Calls:
    """Counts of what `work` gives the device's queue; it has been done before, so that all is built and allocated."""
    before = replace(device.calls)
    work()
    return device.calls.since(before)


def _measure(
    device: Device, work: Callable[[], object], repeat: int
) -> tuple[float, float, dict[str, StageRecord], bool]:
    """Wall time in ms with nothing recorded, and this thread's processor time then; the stages; True if their times are
    of the wall, as the driver's events give none. Medians over `repeat` rounds: plain, with events, and waiting at the
    seams of the stages."""
    for _ in range(2):
        work()
    walls: list[float] = []
    hosts: list[float] = []

    def counted() -> None:
        start = time.thread_time()
        work()
        hosts.append(1e3 * (time.thread_time() - start))

    by_events: list[dict[str, StageRecord]] = []
    by_waiting: list[dict[str, StageRecord]] = []
    for _ in range(repeat):
        walls.append(device.timed(counted)[1])
        for records, wait in ((by_events, False), (by_waiting, True)):
            with device.recorder.recording(wait=wait) as stages:
                work()
            records.append(stages)
    by_wall = not any(record.ms for stages in by_events for record in stages.values())
    medians = {}
    for name, record in by_events[0].items():
        waits = [stages[name].wall_ms for stages in by_waiting]
        times = [stages[name].kernels for stages in by_events]
        kernels = {kernel: statistics.median(run.get(kernel, 0.0) for run in times) for kernel in record.kernels}
        total = statistics.median(waits if by_wall else [sum(run.values()) for run in times])
        medians[name] = replace(record, kernels=kernels, ms=total, wall_ms=statistics.median(waits))
    return statistics.median(walls), statistics.median(hosts), medians, by_wall


@dataclass(frozen=True, eq=False)
class _Picture(View):
    """A view whose pixels are in memory."""

    pixels: Float32 = field(kw_only=True)

    def load_masked(self, width: int | None = None, height: int | None = None) -> Float32:  # noqa: ARG002  # of one size
        return self.pixels


def trainer_of(subject: Subject, device: Device, config: RasterizerConfig) -> Trainer:
    """A trainer whose steps do all the work of a real one and leave the model as it is: every rate is zero."""
    camera = subject.camera
    photograph = subject.photograph
    if photograph is None:  # the frame mirrored: a picture like it, with a gradient everywhere
        mirrored = Renderer(device, config=config).render(subject.gaussians, camera).image[:, ::-1]
        photograph = np.rint(255 * np.clip(mirrored, 0, 1)).astype(np.uint8)
    lens = Lens("PINHOLE", camera.width, camera.height, (camera.fx, camera.fy, camera.cx, camera.cy))
    pixels = photograph * np.float32(1 / 255)
    view = _Picture("bench", camera, Path("bench"), "train", lens, pixels=pixels)
    scene = Scene("bench", [view], np.zeros((0, 3)), np.zeros((0, 3), np.float32), (np.zeros(3), np.ones(3)))
    still = {group.rate: 0.0 for group in GROUPS.values()}
    settings = TrainConfig(
        sh_degree=subject.gaussians.sh_degree,
        warmup=(),
        optimiser=OptimiserConfig(means_rate_end=0.0, **still),  # type: ignore[arg-type]  # all of them are floats
        density=DensityConfig(every=0),
        rasterizer=config,
        masks=subject.masks.masks,
        alpha=subject.masks.alpha,
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
    """Text table of what `bench` measured."""
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
    lines += aligned(rows)
    note = "ms by events" if result["timer"] == "events" else "ms by wall time: the driver's events have none"
    times = f"frame {result['frame_ms']:.2f} ms, training step {result['iteration_ms']:.2f} ms"
    load = f"load average {result['load_average'] or 0:.1f}"
    counts = [("queue", *(name.replace("_", " ") for name in result["frame_calls"]), "host ms")]
    for what, key in (("frame", "frame"), ("training step", "iteration")):
        host = f"{result[f'{key}_host_ms']:.2f}"
        counts.append((what, *(str(count) for count in result[f"{key}_calls"].values()), host))
    return "\n".join([*lines, "", *aligned(counts), "", f"{times}: medians of {result['repeat']}; {note}; {load}"])
