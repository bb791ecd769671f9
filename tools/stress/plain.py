# SPDX-License-Identifier: Apache-2.0
"""Make a scene for tests of large models: a plain of cells with Gaussians, each made from a seed, and cameras above it.

This module uses little of clsplat, so that other versions of clsplat can be measured on the same scene.
"""

from __future__ import annotations

import time
from collections.abc import Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import numpy as np

from clsplat.arrays import Float32
from clsplat.config.training import DensityConfig, OptimiserConfig, TrainConfig
from clsplat.gaussians import PARAMETER_GROUPS
from clsplat.images.writing import write_image

WIDTH, HEIGHT, FOCAL = 320, 240, 300.0
CELL = 1.0
"""Side of a cell, world units."""
CELL_ROWS = 1024
"""Number of Gaussians in a cell: a chunk."""
CAMERA_HEIGHT = 9.0
"""World units above the plain. A camera sees some 11 x 8 cells."""


@dataclass(frozen=True)
class SeededArray:
    """A parameter group of the plain, of which any rows can be made.

    only: numbers of the plain's cells that the array consists of; None for the first cells.
    """

    group: str
    shape: tuple[int, ...]
    only: Sequence[int] | None = None

    def get_rows(self, start: int, stop: int) -> Float32:
        """Rows [start, stop), cut from whole cells."""
        cells = range(start // CELL_ROWS, -(-stop // CELL_ROWS))
        numbers = cells if self.only is None else [self.only[place] for place in cells]
        made = np.concatenate([_cell(self.group, number, self.shape[1:]) for number in numbers])
        first = CELL_ROWS * cells[0]
        return made[start - first : stop - first]

    def get(self) -> Float32:
        """All rows."""
        return self.get_rows(0, self.shape[0])


def _cell(group: str, number: int, shape: tuple[int, ...]) -> Float32:
    rng = np.random.default_rng((list(PARAMETER_GROUPS).index(group), number))
    values = rng.random((CELL_ROWS, *shape), np.float32)
    if group == "means":
        x, y = (_every_second_bit(number >> axis) for axis in range(2))
        return ((values * (1.0, 1.0, 0.2) + (x, y, 0.0)) * CELL).astype(np.float32)
    if group == "log_scales":
        return (values - 4.5).astype(np.float32)
    return (values - 0.5).astype(np.float32) * np.float32(0.1 if group == "sh_rest" else 1.0)


def _every_second_bit(number: int) -> int:
    """The even bits of a number, moved together: a coordinate of a Z-order curve."""
    return sum((number >> 2 * bit & 1) << bit for bit in range(24))


def write_scene(
    folder: Path, cells: int, views: int, *, near: bool, height: float = CAMERA_HEIGHT, width: int = WIDTH
) -> None:
    """Write a COLMAP folder of cameras above the plain, which look down, with photographs of noise.

    near: True for cameras beside each other, as on a flight; False for cameras anywhere.
    height: of the cameras above the plain, world units.
    width: of the photographs, pixels. It does not change what a camera sees.
    """
    rng, tall, focal = np.random.default_rng(1), width * HEIGHT // WIDTH, FOCAL * width / WIDTH
    sparse, images = folder / "sparse" / "0", folder / "images"
    sparse.mkdir(parents=True)
    images.mkdir()
    camera = f"1 PINHOLE {width} {tall} {focal} {focal} {width / 2} {tall / 2}\n"
    (sparse / "cameras.txt").write_text(camera)
    lines = []
    for index in range(views):
        number = cells // 3 + 8 * index if near else int(rng.integers(cells))
        x, y = CELL * _every_second_bit(number), CELL * _every_second_bit(number >> 1)
        place = f"{-x} {y} {height * CELL}"  # half a turn around x: the camera looks down
        lines.append(f"{index + 1} 0 1 0 0 {place} 1 {index:04d}.png\n\n")
        write_image(images / f"{index:04d}.png", rng.random((tall, width, 3)).astype(np.float32))
    (sparse / "images.txt").write_text("".join(lines))
    points = [f"{index + 1} {index % 10} {index // 10} 0 90 90 90 0.1\n" for index in range(100)]
    (sparse / "points3D.txt").write_text("".join(points))


def settings(steps: int, degree: int, *, dense: bool) -> TrainConfig:
    """Settings of a training without density control, so that rows stay where they are. dense: True for dense Adam."""
    optimiser, density = OptimiserConfig(sparse=not dense), DensityConfig(every=0)
    iterations = max(steps, 1000)
    return TrainConfig(
        iterations=iterations, sh_degree=degree, sh_degree_every=0, warmup=(), optimiser=optimiser, density=density
    )


def timed_steps(trainer: Any, steps: int) -> dict[str, float]:
    """Train, and return the median and the mean of a step's time, the mean of the second half of the steps, and the
    median processor time of all threads, in milliseconds."""
    times = []
    for _ in range(steps):
        begin = np.array([time.perf_counter(), time.process_time()])
        trainer.train_step()
        trainer.device.queue.finish()
        times.append(1e3 * (np.array([time.perf_counter(), time.process_time()]) - begin))
    (median, processor), mean = np.median(times, axis=0), np.mean(times, axis=0)[0]
    later = float(np.mean(times[steps // 2 :], axis=0)[0])
    return {"median_ms": float(median), "mean_ms": float(mean), "later_ms": later, "processor_ms": float(processor)}
