# SPDX-License-Identifier: Apache-2.0
"""grid.cl against the float64 twin, and the twin against finite differences."""

from __future__ import annotations

import numpy as np
from compare import assert_close, assert_close_gradient, assert_same_bits

from clsplat.device.buffers import Workspace, upload
from clsplat.device.context import Device
from clsplat.layouts.columns import GRID_SHAPE, READBACK
from clsplat.reference import grid as reference
from clsplat.selftest.harness import planes_of
from clsplat.stages.grid import Grids, apply_grid, centre_grids, grid_gradient, step_grid


def some_grids(rng: np.random.Generator, count: int) -> np.ndarray:
    return (reference.identity(GRID_SHAPE[:3]) + rng.normal(0, 0.1, (count, *GRID_SHAPE))).astype(np.float32)


def some_image(rng: np.random.Generator, height: int, width: int) -> np.ndarray:
    """An image with colours under 0 and over 1, and no luminance near a level, where the slope has a kink."""
    image = rng.uniform(-0.2, 1.3, (height, width, 3))
    level = image @ reference.LUMINANCE_WEIGHTS * (GRID_SHAPE[0] - 1)
    low = np.floor(level)
    return image + ((low + 0.05 + 0.9 * (level - low) - level) / (GRID_SHAPE[0] - 1))[..., None]


def test_a_grid_of_identities_changes_nothing(shaped_device: Device) -> None:
    image = np.random.default_rng(3).random((20, 30, 3)).astype(np.float32)
    work = Workspace(shaped_device)
    grids = Grids.on(shaped_device, reference.identity(GRID_SHAPE[:3])[None].astype(np.float32))
    seen = apply_grid(shaped_device, work, grids, 0, upload(shaped_device, planes_of(image, np.nan)), (30, 20))
    assert_close(seen.get()[:, :20, :30].transpose(1, 2, 0), image, relative=3e-7)


def test_the_variations_gradient_alone(shaped_device: Device) -> None:
    values = some_grids(np.random.default_rng(4), 2)
    work, grids = Workspace(shaped_device), Grids.on(shaped_device, values)
    planes = upload(shaped_device, planes_of(np.full((8, 8, 3), 0.4, np.float32), np.nan))
    none = upload(shaped_device, planes_of(np.zeros((8, 8, 3), np.float32), np.nan))
    by_grid = grid_gradient(shaped_device, work, grids, 1, planes, none, (8, 8), 10.0)
    assert_close_gradient(by_grid.get(), 10 * reference.variation_gradient(values[1].astype(np.float64)), 1e-6)


def test_a_step_that_stopped_or_is_not_finite(shaped_device: Device) -> None:
    before = some_grids(np.random.default_rng(6), 1)
    grids, values = Grids.on(shaped_device, before), np.zeros(len(READBACK), np.uint32)
    values[READBACK.index("STOPPED")] = 1
    by_grid = upload(shaped_device, np.ones(GRID_SHAPE, np.float32))
    step_grid(shaped_device, grids, 0, by_grid, 1, 0.1, upload(shaped_device, values))
    assert_same_bits(grids.grids.get(), before)
    assert not grids.first.get().any()
    centre_grids(shaped_device, grids, upload(shaped_device, values))
    assert_same_bits(grids.grids.get(), before)
    by_grid.fill(np.nan)
    step_grid(shaped_device, grids, 0, by_grid, 1, 0.1, upload(shaped_device, 0 * values))
    assert_same_bits(grids.grids.get(), before)


def test_the_twin_against_finite_differences() -> None:
    rng = np.random.default_rng(7)
    image, weights, grid = some_image(rng, 6, 5), rng.normal(0, 1, (6, 5, 3)), some_grids(rng, 1)[0].astype(np.float64)
    by_image, by_grid = reference.gradient(image, grid, weights)
    for _ in range(5):
        step = 1e-6 * rng.normal(0, 1, grid.shape)
        changed = reference.apply(image, grid + step) - reference.apply(image, grid - step)
        assert_close((weights * changed).sum() / 2, (by_grid * step).sum(), relative=1e-6)
    numeric = np.zeros_like(image)
    for at in np.ndindex(image.shape):
        step = np.zeros_like(image)
        step[at] = 1e-6
        changed = reference.apply(image + step, grid) - reference.apply(image - step, grid)
        numeric[at] = (weights * changed).sum() / 2e-6
    assert_close_gradient(by_image, numeric, 1e-7)


def test_the_variation_against_finite_differences() -> None:
    rng = np.random.default_rng(8)
    grid = some_grids(rng, 1)[0].astype(np.float64)
    by_grid = reference.variation_gradient(grid)
    for _ in range(5):
        step = 1e-4 * rng.normal(0, 1, grid.shape)
        changed = (reference.variation(grid + step) - reference.variation(grid - step)) / 2
        assert_close(changed, (by_grid * step).sum(), relative=1e-8)
    assert reference.variation(reference.identity(GRID_SHAPE[:3])) == 0
