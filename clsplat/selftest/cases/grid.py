# SPDX-License-Identifier: Apache-2.0
"""Self-test of the bilateral grids: a photograph's colours, their gradient and Adam's step."""

from __future__ import annotations

import numpy as np

from clsplat.device.buffers import DeviceArray, upload
from clsplat.layouts.columns import READBACK
from clsplat.reference import grid as reference
from clsplat.selftest.harness import Array, CaseBench, StageOutcome, cropped
from clsplat.selftest.scenes import evenly
from clsplat.stages.grid import GRID_SHAPE, Grids, apply_grid, centre_grids, grid_gradient, step_grid

GRID_PHOTOGRAPH, GRID_VISIT, GRID_RATE, CASE_VARIATION_WEIGHT = 1, 5, 0.03125, 10.0
MIN_LEVEL_DISTANCE = 1e-4
"""Distance from a luminance level below which rounding decides the slope."""


def of_grid(bench: CaseBench) -> StageOutcome:
    """Test the grid of one of two photographs, with the scene's blended image as the render."""
    device, camera, image = bench.device, bench.camera, bench.blended.image
    size = (camera.width, camera.height)
    values = (reference.identity(GRID_SHAPE[:3]) + evenly(43, (2, *GRID_SHAPE), -0.25, 0.25)).astype(np.float32)
    by_seen = evenly(44, tuple(image.shape), -0.25, 1.0).astype(np.float32)
    readback = upload(device, np.zeros(len(READBACK), np.uint32))

    def launch() -> tuple[Grids, DeviceArray, DeviceArray, DeviceArray]:
        grids, gradient = Grids.on(device, values), upload(device, by_seen)
        seen = apply_grid(device, bench.work, grids, GRID_PHOTOGRAPH, image, *size)
        by_grid = grid_gradient(
            device, bench.work, grids, GRID_PHOTOGRAPH, image, gradient, *size, CASE_VARIATION_WEIGHT
        )
        step_grid(device, grids, GRID_PHOTOGRAPH, by_grid, GRID_VISIT, GRID_RATE, readback)
        centre_grids(device, grids, readback)
        return grids, seen, gradient, by_grid

    def take(results: tuple[Grids, DeviceArray, DeviceArray, DeviceArray]) -> list[Array]:
        grids, seen, gradient, by_grid = results
        made = (grids.grids, grids.first, grids.second, by_grid)
        return [*(array.get() for array in made), cropped(seen.get(), camera), cropped(gradient.get(), camera)]

    _, outcome = bench.twice(launch, take)
    got = dict(zip(("grids", "first", "second", "by grid", "seen", "gradient"), outcome.arrays, strict=True))
    picture, held = cropped(image.get(), camera).astype(np.float64), values.astype(np.float64)
    by_image, by_grid = reference.gradient(picture, held[GRID_PHOTOGRAPH], cropped(by_seen, camera).astype(np.float64))
    by_grid += CASE_VARIATION_WEIGHT * reference.variation_gradient(held[GRID_PHOTOGRAPH])
    zeros = np.zeros(GRID_SHAPE)
    moved, first, second = reference.step(held[GRID_PHOTOGRAPH], zeros, zeros, by_grid, GRID_VISIT, GRID_RATE)
    after = held.copy()
    after[GRID_PHOTOGRAPH] = moved
    level = picture @ reference.LUMINANCE_WEIGHTS * (GRID_SHAPE[0] - 1)
    sure = np.abs(level - np.rint(level)) > MIN_LEVEL_DISTANCE
    return outcome.compared(
        {
            "seen": (got["seen"], reference.apply(picture, held[GRID_PHOTOGRAPH])),
            "gradient": (got["gradient"][sure], by_image[sure]),
            "gradient by the grid": (got["by grid"], by_grid),
            "first": (got["first"][GRID_PHOTOGRAPH], first),
            "second": (got["second"][GRID_PHOTOGRAPH], second),
            "grids": (got["grids"], reference.centre(after)),
        }
    )
