# SPDX-License-Identifier: Apache-2.0
"""`clsplat bench`: cost of each stage of a frame and of a training step, compared with measured limits of the device.

docs/performance.md explains each figure.
"""

from __future__ import annotations

import os
import statistics
import time
from collections.abc import Callable, Mapping, Sequence
from dataclasses import asdict, dataclass, field, replace
from functools import partial
from pathlib import Path
from typing import Any

import numpy as np

from clsplat.arrays import Float32
from clsplat.bench.workload import Subject
from clsplat.config.rasterizer import RasterizerConfig
from clsplat.config.training import DensityConfig, OptimiserConfig, TrainConfig
from clsplat.device.context import Device
from clsplat.device.profile import Calls, StageRecord
from clsplat.gaussians import PARAMETER_GROUPS, floats_of
from clsplat.progress import Progress, aligned, no_progress
from clsplat.rendering.rasterizer import ForwardPass, Rasterizer
from clsplat.rendering.renderer import Renderer, held_sh
from clsplat.scenes.dataset import Lens
from clsplat.scenes.scene import Scene, View
from clsplat.stages.blend import count_pairs
from clsplat.stages.device_gaussians import upload_gaussians
from clsplat.stages.peak import Limits, measure_limits
from clsplat.training.trainer import Trainer

FRAME_STAGES = ("transfers", "project", "duplicate", "ranges", "blend")
"""Stages that are measured in a frame. The others are measured in a training step."""
TRAINING_BYTES_PER_GAUSSIAN = 4 * floats_of(16) * 4
"""Bytes per Gaussian in a training step, with SH degree 3: parameters, gradients and two moments."""


def bench(
    subject: Subject,
    device: Device,
    config: RasterizerConfig | None = None,
    *,
    repeat: int = 5,
    limits: Limits | None = None,
    progress: Progress | None = None,
) -> dict[str, Any]:
    """Measure every stage of a frame and of a training step. Returns the object that `clsplat bench --json` prints.

    The device's queue should have been created with profiling, as kernels' times come from its events.

    repeat: number of rounds in which the frame and the step are measured. Times are medians.
    limits: the device's measured limits; None measures them.
    """
    say = progress or no_progress
    config = (config or RasterizerConfig()).switches()
    say("limits", None)
    limits = limits or measure_limits(device)
    say("frame", None)
    trainer = trainer_of(subject, device, config)
    rasterizer, gaussians = trainer.rasterizer, trainer.parameters
    if held_kind(config) != held_kind(RasterizerConfig()):  # SH is stored in another form: upload a second model
        gaussians = upload_gaussians(device, subject.gaussians, held_sh(subject.gaussians, config))
    draw = partial(rasterizer.forward, gaussians, subject.camera, trainer.background, backward=False)
    frame = draw()
    visible = int(np.count_nonzero(frame.projected.tile_counts.get()))
    pairs = _pairs_of(rasterizer, frame)
    of_frame = _measure(device, draw, repeat)
    say("training step", None)
    of_step = _measure(device, trainer.train_step, repeat)

    stages = {name: record for name, record in of_frame.stages.items() if name in FRAME_STAGES}
    stages.update({name: record for name, record in of_step.stages.items() if name not in stages})
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
        "timer": "wall" if of_frame.by_wall else "events",
        "frame_ms": of_frame.wall_ms,
        "iteration_ms": of_step.wall_ms,
        "frame_host_ms": of_frame.host_ms,
        "iteration_host_ms": of_step.host_ms,
        "frame_calls": asdict(of_frame.calls),
        "iteration_calls": asdict(of_step.calls),
        "stages": _table(stages, limits, pairs["contributing"]),
        "pairs": pairs,
        "limit": asdict(limits),
    }


def _pairs_of(rasterizer: Rasterizer, frame: ForwardPass) -> dict[str, int]:
    """Count the (tile, Gaussian) pairs of a frame, and the (pixel, Gaussian) pairs that contribute or are evaluated."""
    pairs = contributing = evaluated = 0
    for band in frame.bands:
        listed = rasterizer.listed(frame, band)
        pairs += listed.counted.pairs
        drawn = (listed.lists, frame.projected.splats, frame.background, frame.camera)
        added, looked_at = count_pairs(rasterizer.device, rasterizer.work, *drawn)
        contributing, evaluated = contributing + added, evaluated + looked_at
    return {"listed": pairs, "contributing": contributing, "evaluated": evaluated}


def _table(stages: Mapping[str, StageRecord], limits: Limits, contributing: int) -> dict[str, dict[str, Any]]:
    """Return a record for each stage: its measurements, bytes and pairs per second, and these rates as fractions of
    the device's limits.

    limits: the device's rates of copying and of blending pairs, which stages are compared with.
    contributing: number of (pixel, Gaussian) pairs that change a pixel.
    """
    table: dict[str, dict[str, Any]] = {}
    for name, record in stages.items():
        rate = 1e3 * record.bytes / record.ms if record.ms > 0 else 0.0
        shares = {"bytes_per_second": rate, "share_of_copy": rate / limits.copy_bytes_per_second}
        table[name] = asdict(record) | shares
    for name, limit in (("blend", limits.pairs_per_second), ("blend_grad", limits.gradient_pairs_per_second)):
        if name in table and table[name]["ms"] > 0:
            rate = 1e3 * contributing / table[name]["ms"]
            table[name].update(pairs_per_second=rate, share_of_arithmetic=rate / limit)
    return table


def calls_of(device: Device, work: Callable[[], object]) -> Calls:
    """Count the queue calls of `work`.

    Call `work` once before this function, so that it no longer builds kernels or allocates arrays.
    """
    before = replace(device.calls)
    work()
    return device.calls.since(before)


@dataclass(frozen=True)
class _Cost:
    """Cost of a frame or a training step. Times are medians.

    wall_ms, host_ms: elapsed time, and processor time of this thread.
    calls: numbers of OpenCL queue calls, by kind.
    by_wall: True if the stages' times are elapsed times, because the driver's events have no times.
    """

    wall_ms: float
    host_ms: float
    calls: Calls
    stages: dict[str, StageRecord]
    by_wall: bool


def _measure(device: Device, work: Callable[[], object], repeat: int) -> _Cost:
    """Measure the cost of `work`, in `repeat` rounds.

    In each round, `work` runs three times: without recording, with events, and with waits between stages. Elapsed time
    and processor time are measured without recording.
    """
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
    return _Cost(statistics.median(walls), statistics.median(hosts), calls_of(device, work), medians, by_wall)


_VIEWS = 8
"""Number of times that the view is in the scene. In the last step of an epoch the next view is not known, so that its
chunks are not culled ahead. With longer epochs, there are fewer such steps."""


@dataclass(frozen=True, eq=False)
class _Picture(View):
    """View with one photograph, the array `pixels` (H, W, 3 or 5), whatever size is requested."""

    pixels: Float32 = field(kw_only=True)

    def load_sizes(self, sizes: Sequence[tuple[int, int]], *, reduce: bool = False) -> list[Float32]:  # noqa: ARG002
        return [self.pixels for _ in sizes]


def trainer_of(subject: Subject, device: Device, config: RasterizerConfig) -> Trainer:
    """Make a trainer whose steps do all the work of training. Learning rates are zero, so the model does not change."""
    camera = subject.camera
    photograph = subject.photograph
    if photograph is None:  # train on the mirrored frame: similar colours, but a gradient everywhere
        mirrored = Renderer(device, config=config).render(subject.gaussians, camera).image[:, ::-1]
        photograph = np.rint(255 * np.clip(mirrored, 0, 1)).astype(np.uint8)
    lens = Lens("PINHOLE", camera.width, camera.height, (camera.fx, camera.fy, camera.cx, camera.cy))
    pixels = photograph * np.float32(1 / 255)
    view = _Picture("bench", camera, Path("bench"), "train", lens, pixels=pixels)
    scene = Scene("bench", [view] * _VIEWS, np.zeros((0, 3)), np.zeros((0, 3), np.float32), (np.zeros(3), np.ones(3)))
    still = {group.rate: 0.0 for group in PARAMETER_GROUPS.values()}
    settings = TrainConfig(
        sh_degree=subject.gaussians.sh_degree,
        warmup=(),
        optimiser=OptimiserConfig(means_rate_end=0.0, **still),  # type: ignore[arg-type]  # all rates are floats
        density=DensityConfig(every=0),
        rasterizer=config,
        masks=subject.masks.masks,
        alpha=subject.masks.alpha,
    )
    return Trainer(scene, settings, device, subject.gaussians)


def picture_of(frame: ForwardPass) -> Float32:
    """Copy the frame's image (H, W, 3) to the host."""
    camera = frame.camera
    planes: Float32 = frame.blended.image.get()[:, : camera.height, : camera.width]
    return np.ascontiguousarray(planes.transpose(1, 2, 0))


def held_kind(config: RasterizerConfig) -> tuple[object, ...]:
    """Return the values of the switches that determine how SH coefficients are stored on the device."""
    return config.sh_tolerance, config.sh_storage


def table(result: dict[str, Any]) -> str:
    """Format a result of `bench` as text tables."""
    stages, limit, pairs = result["stages"], result["limit"], result["pairs"]
    driver, size = result["driver"].split("  ")[0], f"{result['width']}x{result['height']}"
    arithmetic, gradient, copying = (
        limit[name] * 1e-9 for name in ("pairs_per_second", "gradient_pairs_per_second", "copy_bytes_per_second")
    )
    seen = f"{result['gaussians']:,} Gaussians, SH degree {result['sh_degree']}, {result['visible']:,} visible"
    most = f"{arithmetic:.2f} Gpairs/s for blending arithmetic, {gradient:.2f} Gpairs/s for its gradient"
    of_pixels = f"{pairs['contributing']:,} contribute and {pairs['evaluated']:,} are evaluated"
    lines = [
        f"{result['device']}, {driver}, {limit['lanes']} lanes x {limit['items']} items",
        f"{result['source']}: {seen}, at {size}",
        f"(tile, Gaussian) pairs: {pairs['listed']:,}; (pixel, Gaussian) pairs: {of_pixels}",
        f"limits: {most}, {copying:.1f} GB/s for copying",
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
    note = (
        "ms from events" if result["timer"] == "events" else "ms from wall time, as the driver's events have no times"
    )
    times = f"frame {result['frame_ms']:.2f} ms, training step {result['iteration_ms']:.2f} ms"
    load = f"load average {result['load_average'] or 0:.1f}"
    counts = [("queue", *(name.replace("_", " ") for name in result["frame_calls"]), "host ms")]
    for what, key in (("frame", "frame"), ("training step", "iteration")):
        host = f"{result[f'{key}_host_ms']:.2f}"
        counts.append((what, *(str(count) for count in result[f"{key}_calls"].values()), host))
    return "\n".join([*lines, "", *aligned(counts), "", f"{times}: medians of {result['repeat']} runs; {note}; {load}"])
