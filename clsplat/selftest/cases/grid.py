# SPDX-License-Identifier: Apache-2.0
"""Case of bilateral grids: the render with a photograph's grid, the gradient, and the update by Adam."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
from numpy.random import Generator

from clsplat.device.buffers import Workspace, upload
from clsplat.device.context import Device
from clsplat.layouts.columns import GRID_SHAPE
from clsplat.reference import grid as reference
from clsplat.selftest.case import Arrays, Case, Expected, Inputs, Read, exactly, fresh_readback, read_of
from clsplat.selftest.cases.appearance import moment, random_gradient, random_moments, stepped
from clsplat.selftest.cases.loss import random_pictures
from clsplat.selftest.harness import CaseBench, cropped, planes_of
from clsplat.selftest.scenes import evenly
from clsplat.stages.grid import Grids, apply_grid, centre_grids, grid_gradient, step_grid

GRID_PHOTOGRAPH = 1
"""Index of the photograph whose grid is tested; there are two photographs."""
MIN_LEVEL_DISTANCE = 1e-4
"""Least distance of a luminance from a level of the grid for a pixel's gradient to be compared. Below it, rounding may
change between which two levels the grid is interpolated."""


def _random(rng: Generator, size: tuple[int, int]) -> Inputs:
    """Random grids, from near the identity to far from it, and colours, some of them below 0 and above 1."""
    image, _ = random_pictures(rng, size)
    image = (image * rng.uniform(1.0, 1.5) - rng.choice([0.0, 0.2])).astype(np.float32)
    noise = rng.standard_normal((2, *GRID_SHAPE)) * 10 ** rng.uniform(-4, 0.5)
    by_seen = random_gradient(rng, image)
    return Inputs(
        image=image,
        by_seen=by_seen,
        grids=(reference.identity(GRID_SHAPE[:3]) + noise).astype(np.float32),
        moments=random_moments(rng, noise.shape, float(np.abs(by_seen).mean())),
        weight=float(rng.choice([0.0, 10.0])),
        visit=int(rng.integers(1, 500)),
        rate=0.01,
    )


def _frozen(bench: CaseBench) -> list[Inputs]:
    """Inputs from the self-test's scene: the blended image, and grids of two photographs; one is used."""
    grids = (reference.identity(GRID_SHAPE[:3]) + evenly(43, (2, *GRID_SHAPE), -0.25, 0.25)).astype(np.float32)
    by_seen = evenly(44, tuple(bench.blended.image.shape), -0.25, 1.0).astype(np.float32)
    image, by_seen = (cropped(each, bench.camera) for each in (bench.blended.image.get(), by_seen))
    moments = np.zeros((2, *grids.shape), np.float32)
    return [Inputs(image=image, by_seen=by_seen, grids=grids, moments=moments, weight=10.0, visit=5, rate=0.03125)]


def _launch(device: Device, work: Workspace, given: Inputs) -> Read:
    first, second = (upload(device, moment) for moment in given.moments)
    grids, readback = replace(Grids.on(device, given.grids), first=first, second=second), fresh_readback(device)
    image, gradient = (upload(device, planes_of(each, np.nan)) for each in (given.image, given.by_seen))
    own = (grids, GRID_PHOTOGRAPH, image)
    seen = apply_grid(device, work, *own, given.size)
    by_grid = grid_gradient(device, work, *own, gradient, given.size, given.weight)
    step_grid(device, grids, GRID_PHOTOGRAPH, by_grid, given.visit, given.rate, readback)
    centre_grids(device, grids, readback)
    read = read_of({"grids": grids.grids, "first": first, "second": second, "by grid": by_grid})
    planes = {"seen": seen, "gradient": gradient}
    return lambda: {**read(), **{name: cropped(array.get(), given.size) for name, array in planes.items()}}


def _twin(given: Inputs, got: Arrays) -> dict[str, Expected]:
    image, held, by_seen, moments = given.wide("image", "grids", "by_seen", "moments")
    at, (first, second) = GRID_PHOTOGRAPH, moments
    own, mean = held[at].copy(), held.mean(axis=0)
    seen, terms = reference.apply(image, own), reference.apply(np.abs(image), np.abs(own))
    by_image, by_grid = reference.gradient(image, own, by_seen)
    by_grid += given.weight * reference.variation_gradient(own)
    # Adam's twin gets the device's gradient, so that the gradient's error is compared only once, in "by grid".
    step = (got["by grid"].astype(np.float64), given.visit, given.rate)
    got |= {f"{name} of another": got[name][0] for name in ("first", "second")}
    held[at], first[at], second[at] = reference.step(own, first[at], second[at], *step)
    level = image @ reference.LUMINANCE_WEIGHTS * (GRID_SHAPE[0] - 1)
    centred = reference.centre(held, mean)
    return {
        "seen": Expected(seen, 1.2e-6, max(1.0, terms.max())),  # the bound covers about twelve roundings
        # the bound covers sums of a hundred terms with both signs
        "gradient": Expected(by_image, 1e-5, compared=np.abs(level - np.rint(level)) > MIN_LEVEL_DISTANCE),
        "by grid": Expected(by_grid, 1e-5),
        "first": moment(first),
        "second": moment(second),
        "grids": stepped(centred, given.rate),
        **{f"{name} of another": exactly(given.moments[k][0]) for k, name in enumerate(("first", "second"))},
    }


GRID_CASE = Case(
    sizes=((16, 16), (17, 33), (1, 1), (70, 15)),
    random=_random,
    launch=_launch,
    twin=_twin,
    frozen=_frozen,
    digested=("grids", "first", "second", "by grid", "seen", "gradient"),
)
