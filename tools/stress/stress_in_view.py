# SPDX-License-Identifier: Apache-2.0
"""Compare steps of a large model with steps of the same views in models of just the chunks that each view shows.

    tools/stress/run in_view [--gaussians 20e6] [--degree 0] [--width 200,800] [--height 9,4] [--views 8] [--blocks 20]
        [--dense] [--device DEVICE] [--json]

The large model is the plain of `run large`, all in memory. For each of its views there is a small model of the chunks
that the view shows. Both models take a step of the same view, one after the other in this process, and each of them is
first in half of the pairs. A block is as many pairs as there are steps between two measurements of bounds. Prints
medians over the blocks: a step's wall time, its processor time of all threads, and the ratios of both. What a ratio
exceeds 1 by is the cost of the chunks out of view.

--width: widths of the photographs in pixels. --height: heights of the cameras above the plain, which decide how many
chunks a view shows.
"""

from __future__ import annotations

import gc
import json
import tempfile
import time
from collections.abc import Sequence
from dataclasses import dataclass, replace
from pathlib import Path
from typing import Any

import numpy as np
from measuring import number, plain_parser, require, tool
from plain import CELL, settings, write_scene
from stress_large import take_plain

from clsplat.arrays import Float64
from clsplat.config.training import TrainConfig
from clsplat.device.context import Device
from clsplat.device.selection import open_device
from clsplat.layouts.columns import CHUNK_ROWS
from clsplat.progress import aligned
from clsplat.scenes.loading import load_scene
from clsplat.scenes.scene import Scene
from clsplat.training.step.visible_chunks import STEPS_PER_MEASUREMENT, VisibleChunks
from clsplat.training.trainer import Trainer

EPOCHS_BEFORE = 4
"""Passes through all views before steps are timed: kernels are built, and bounds are measured."""


@dataclass(frozen=True)
class Case:
    """Number of Gaussians, width of the photographs in pixels, height of the cameras in world units, views."""

    count: int
    width: int
    height: float
    views: int


def trainer_of(
    scene: Scene, config: TrainConfig, device: Device, count: int, only: Sequence[int] | None = None
) -> Trainer:
    """A trainer whose model is the plain, or some of its cells. only: numbers of these cells."""
    trainer = Trainer(scene, config, device)
    take_plain(trainer, count, only)
    return trainer


def chunks_in_view(trainer: Trainer, view: int) -> list[int]:
    """Numbers of the chunks that a view of the trainer may show."""
    (chunks,) = (component for component in trainer.components if isinstance(component, VisibleChunks))
    found: list[int] = chunks.in_view(trainer.local(trainer.views[view].camera)).tolist()
    return found


def timed_step(trainer: Trainer) -> Float64:
    """Make a step, and return its wall time and the processor time of all threads (2,), in milliseconds."""
    begin = np.array([time.perf_counter(), time.process_time()])
    trainer.train_step()
    trainer.device.queue.finish()
    taken: Float64 = 1e3 * (np.array([time.perf_counter(), time.process_time()]) - begin)
    return taken


def paired_steps(large: Trainer, small: Sequence[Trainer], blocks: int) -> Float64:
    """Mean times (blocks, 2, 2) of steps: of the large model, then of the small ones; wall time, then processor time.

    small: the trainer of each view's chunks.
    """
    found: list[list[Float64]] = []
    while len(found) < blocks * STEPS_PER_MEASUREMENT:
        queue = large.position.queue
        if not queue:  # the next view is unknown: the first step of a pass is not timed
            large.train_step()
            continue
        of_view = small[queue[-1]]
        order = (large, of_view) if len(found) % 2 else (of_view, large)
        taken = {trainer: timed_step(trainer) for trainer in order}
        found.append([taken[large], taken[of_view]])
    means: Float64 = np.reshape(found, (blocks, STEPS_PER_MEASUREMENT, 2, 2)).mean(axis=1)
    return means


def measured(case: Case, config: TrainConfig, device: Device, blocks: int) -> dict[str, Any]:
    """Measure one case, and return its row of the table."""
    cells = -(-case.count // CHUNK_ROWS)
    with tempfile.TemporaryDirectory() as folder:
        write_scene(Path(folder), cells, case.views, near=False, height=case.height, width=case.width)
        scene = replace(load_scene(Path(folder), test_every=0), unit=CELL)
        large = trainer_of(scene, config, device, case.count)
        for _ in range(EPOCHS_BEFORE * case.views):
            large.train_step()
        seen = [chunks_in_view(large, view) for view in range(case.views)]
        small = []
        for view, chunks in zip(large.views, seen, strict=True):
            of_view = replace(scene, views=[view] * case.views)  # a pass is as long as that of the large model
            rows = sum(min(CHUNK_ROWS, case.count - CHUNK_ROWS * chunk) for chunk in chunks)
            small.append(trainer_of(of_view, config, device, rows, chunks))
            for _ in range(EPOCHS_BEFORE * case.views):
                small[-1].train_step()
        times = paired_steps(large, small, blocks)
        for trainer in (large, *small):
            trainer.close()
            trainer.model.free()
    ratios = times[:, 0] / times[:, 1]
    row: dict[str, Any] = {**vars(case), "chunks": float(np.mean([len(chunks) for chunks in seen]))}
    for place, kind in enumerate(("wall", "processor")):
        row[f"{kind}_ms"], row[f"{kind}_ms_small"] = np.median(times[:, :, place], axis=0).tolist()
        row[f"{kind}_ratio"] = float(np.median(ratios[:, place]))
    return row


@tool("stress_in_view")
def main(arguments: Sequence[str]) -> int:
    """Measure, and print the table. Returns the exit status."""
    parser = plain_parser(__doc__)
    parser.add_argument("--gaussians", type=number, default=20_000_000)
    parser.add_argument("--degree", type=int, default=0)
    parser.add_argument("--width", default="200,800")
    parser.add_argument("--height", default="9,4")
    parser.add_argument("--views", type=int, default=8)
    parser.add_argument("--blocks", type=int, default=20)
    parser.add_argument("--dense", action="store_true")
    parser.add_argument("--device")
    parser.add_argument("--json", action="store_true")
    options = parser.parse_args(arguments)
    require(options.views > 1, f"--views {options.views}: expected at least 2, as a pass's first step is not timed")
    require(options.blocks > 0, f"--blocks {options.blocks}: expected at least 1")
    device = open_device(options.device)
    config = replace(settings(1000, options.degree, dense=options.dense), iterations=1_000_000)
    rows = []
    for width in map(number, options.width.split(",")):
        for height in map(float, options.height.split(",")):
            rows.append(measured(Case(options.gaussians, width, height, options.views), config, device, options.blocks))
            gc.collect()
    titles = ("Gaussians", "pixels", "height", "chunks in view", "wall ms", "just these", "ratio", "processor ms")
    cells = [
        (
            *(f"{row['count']:,}", f"{row['width']}", f"{row['height']:g}", f"{row['chunks']:.0f}"),
            *(f"{row['wall_ms']:.2f}", f"{row['wall_ms_small']:.2f}", f"{row['wall_ratio']:.3f}"),
            *(f"{row['processor_ms']:.2f}", f"{row['processor_ms_small']:.2f}", f"{row['processor_ratio']:.3f}"),
        )
        for row in rows
    ]
    print(json.dumps(rows) if options.json else "\n".join(aligned([(*titles, "just these", "ratio"), *cells])))
    return 0
