# SPDX-License-Identifier: Apache-2.0
"""Bilateral grids: a photograph's colours, their gradient and Adam's step."""

from __future__ import annotations

from dataclasses import dataclass, replace

import numpy as np
from numpy.random import Generator

from clsplat.arrays import Float32
from clsplat.device.buffers import Workspace, upload
from clsplat.device.context import Device
from clsplat.reference import grid as reference
from clsplat.selftest.case import Arrays, Case, Read, Wanted, exactly, fresh_readback, wide
from clsplat.selftest.cases.appearance import MOMENT_BOUND, STEP_BOUND, random_gradient, random_moments
from clsplat.selftest.cases.loss import random_pictures
from clsplat.selftest.harness import CaseBench, cropped, planes_of
from clsplat.selftest.scenes import evenly
from clsplat.stages.grid import GRID_SHAPE, Grids, apply_grid, centre_grids, grid_gradient, step_grid

GRID_PHOTOGRAPH = 1
MIN_LEVEL_DISTANCE = 1e-4
"""Distance from a luminance level below which rounding decides the slope."""


@dataclass(frozen=True, eq=False)
class GridInputs:
    """Grids of two photographs, of which the second is put on a render (H, W, 3).

    by_seen: the loss's gradient by the render's colours as seen.
    first, second: Adam's moments of both.
    """

    grids: Float32
    image: Float32
    by_seen: Float32
    first: Float32
    second: Float32
    visit: int
    rate: float
    variation_weight: float = 10.0


def _random(rng: Generator, size: tuple[int, int]) -> GridInputs:
    """Grids from next to none to wild ones; colours under 0 and over 1 among those between."""
    image, _ = random_pictures(rng, size)
    image = (image * rng.uniform(1.0, 1.5) - rng.choice([0.0, 0.2])).astype(np.float32)
    noise = rng.standard_normal((2, *GRID_SHAPE)) * 10 ** rng.uniform(-4, 0.5)
    grids = (reference.identity(GRID_SHAPE[:3]) + noise).astype(np.float32)
    by_seen = random_gradient(rng, image)
    moments = random_moments(rng, np.full(grids.shape, np.abs(by_seen).mean(), np.float32))
    weight = float(rng.choice([0.0, 10.0]))
    return GridInputs(grids, image, by_seen, *moments, int(rng.integers(1, 500)), 0.01, weight)


def _frozen(bench: CaseBench) -> list[GridInputs]:
    """One of two photographs, with the scene's blended image as the render."""
    grids = (reference.identity(GRID_SHAPE[:3]) + evenly(43, (2, *GRID_SHAPE), -0.25, 0.25)).astype(np.float32)
    pictures = (bench.blended.image.get(), evenly(44, tuple(bench.blended.image.shape), -0.25, 1.0))
    images = (cropped(each.astype(np.float32), bench.camera) for each in pictures)
    return [GridInputs(grids, *images, np.zeros_like(grids), np.zeros_like(grids), 5, 0.03125)]


def _launch(device: Device, work: Workspace, given: GridInputs) -> Read:
    height, width, _ = given.image.shape
    first, second = (upload(device, moment) for moment in (given.first, given.second))
    grids, readback = replace(Grids.on(device, given.grids), first=first, second=second), fresh_readback(device)
    image, gradient = (upload(device, planes_of(each, np.nan)) for each in (given.image, given.by_seen))
    own = (grids, GRID_PHOTOGRAPH, image)
    seen = apply_grid(device, work, *own, width, height)
    by_grid = grid_gradient(device, work, *own, gradient, width, height, given.variation_weight)
    step_grid(device, grids, GRID_PHOTOGRAPH, by_grid, given.visit, given.rate, readback)
    centre_grids(device, grids, readback)

    def read() -> Arrays:
        made = {"grids": grids.grids, "first": grids.first, "second": grids.second, "by grid": by_grid}
        found = {name: array.get() for name, array in made.items()}
        found |= {
            name: cropped(array.get(), (width, height)) for name, array in (("seen", seen), ("gradient", gradient))
        }
        for name in ("first", "second"):
            found |= {f"{name} of it": found[name][GRID_PHOTOGRAPH], f"{name} of another": found[name][0]}
        return found

    return read


def _twin(given: GridInputs, got: Arrays) -> dict[str, Wanted]:
    image, held, by_seen = wide(given.image, given.grids, given.by_seen)
    own = held[GRID_PHOTOGRAPH]
    by_image, by_grid = reference.gradient(image, own, by_seen)
    by_grid += given.variation_weight * reference.variation_gradient(own)
    moments = (each[GRID_PHOTOGRAPH] for each in wide(given.first, given.second))
    moved, first, second = reference.step(own, *moments, *wide(got["by grid"]), given.visit, given.rate)
    after = held.copy()
    after[GRID_PHOTOGRAPH] = moved
    level = image @ reference.LUMINANCE_WEIGHTS * (GRID_SHAPE[0] - 1)
    seen, centred = reference.apply(image, own), reference.centre(after)
    terms = reference.apply(np.abs(image), np.abs(own))
    return {
        "seen": Wanted(seen, max(1.0, terms.max())),
        "gradient": Wanted(by_image, sure=np.abs(level - np.rint(level)) > MIN_LEVEL_DISTANCE),
        "by grid": Wanted(by_grid),
        "first of it": Wanted(first, np.abs(first).max()),
        "second of it": Wanted(second, np.abs(second).max()),
        "grids": Wanted(centred, given.rate + 1e-2 * np.abs(centred)),
        "first of another": exactly(given.first[0]),
        "second of another": exactly(given.second[0]),
    }


GRID_CASE = Case(
    sizes=((16, 16), (17, 33), (1, 1), (70, 15)),
    random=_random,
    launch=_launch,
    twin=_twin,
    bounds={
        "seen": (1.2e-6, "relative to the largest sum of terms, a dozen roundings"),
        "gradient": (1e-5, "where the level's slope is sure; a hundred terms of either sign"),
        "by grid": (1e-5, "a hundred terms of either sign"),
        "first of it": MOMENT_BOUND,
        "second of it": MOMENT_BOUND,
        "grids": STEP_BOUND,
    },
    frozen=_frozen,
    digested=("grids", "first", "second", "by grid", "seen", "gradient"),
    by_shape=False,
)
