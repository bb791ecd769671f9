# SPDX-License-Identifier: Apache-2.0
"""The self-test's stage of bilateral grids: a photograph's colours, their gradient and Adam's step."""

from __future__ import annotations

import numpy as np

from clsplat.device.buffers import DeviceArray, upload
from clsplat.device.layout import READBACK
from clsplat.reference import grid as reference
from clsplat.selftest.harness import Array, Bench, Outcome, cropped
from clsplat.selftest.scenes import evenly
from clsplat.stages.grid import SHAPE, Grids, apply_grid, centre_grids, grid_gradient, step_grid

VIEW, VISIT, RATE, WEIGHT = 1, 5, 0.03125, 10.0
SURE = 1e-4
"""Distance from a level of luminance under which a rounding decides the slope."""


def of_grid(bench: Bench) -> Outcome:
    """The grid of one photograph of two, whose picture is what the scene's blending has made."""
    device, camera, image = bench.device, bench.camera, bench.blended.image
    size = (camera.width, camera.height)
    values = (reference.identity(SHAPE[:3]) + evenly(43, (2, *SHAPE), -0.25, 0.25)).astype(np.float32)
    by_seen = evenly(44, tuple(image.shape), -0.25, 1.0).astype(np.float32)
    readback = upload(device, np.zeros(len(READBACK), np.uint32))

    def launch() -> tuple[Grids, DeviceArray, DeviceArray, DeviceArray]:
        grids, gradient = Grids.on(device, values), upload(device, by_seen)
        seen = apply_grid(device, bench.work, grids, VIEW, image, *size)
        by_grid = grid_gradient(device, bench.work, grids, VIEW, image, gradient, *size, WEIGHT)
        step_grid(device, grids, VIEW, by_grid, VISIT, RATE, readback)
        centre_grids(device, grids, readback)
        return grids, seen, gradient, by_grid

    def take(results: tuple[Grids, DeviceArray, DeviceArray, DeviceArray]) -> list[Array]:
        grids, seen, gradient, by_grid = results
        made = (grids.grids, grids.first, grids.second, by_grid)
        return [*(array.get() for array in made), cropped(seen.get(), camera), cropped(gradient.get(), camera)]

    _, outcome = bench.twice(launch, take)
    got = dict(zip(("grids", "first", "second", "by grid", "seen", "gradient"), outcome.arrays, strict=True))
    picture, held = cropped(image.get(), camera).astype(np.float64), values.astype(np.float64)
    by_image, by_grid = reference.gradient(picture, held[VIEW], cropped(by_seen, camera).astype(np.float64))
    by_grid += WEIGHT * reference.variation_gradient(held[VIEW])
    zeros = np.zeros(SHAPE)
    moved, first, second = reference.step(held[VIEW], zeros, zeros, by_grid, VISIT, RATE)
    after = held.copy()
    after[VIEW] = moved
    level = picture @ reference.LUMINANCE * (SHAPE[0] - 1)
    sure = np.abs(level - np.rint(level)) > SURE
    return outcome.compared(
        {
            "seen": (got["seen"], reference.apply(picture, held[VIEW])),
            "gradient": (got["gradient"][sure], by_image[sure]),
            "gradient by the grid": (got["by grid"], by_grid),
            "first": (got["first"][VIEW], first),
            "second": (got["second"][VIEW], second),
            "grids": (got["grids"], reference.centre(after)),
        }
    )
