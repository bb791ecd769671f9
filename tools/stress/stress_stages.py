# SPDX-License-Identifier: Apache-2.0
"""Stress test of single stages: cases of `clsplat.selftest.cases` with random inputs, and lenses' gradients."""

from __future__ import annotations

import numpy as np
from measuring import Result
from numpy.random import Generator
from stress_cases import DEGREE, STRESSORS
from stress_projection import exact, in_order, on_image, random_sums, there_and_back

from clsplat.device.buffers import Workspace
from clsplat.device.context import Device
from clsplat.reference.project import lens_grad, project
from clsplat.selftest.case import Case, Deviation, faults
from clsplat.selftest.cases.table import CASES
from clsplat.stages.pose import LENS_NUMBERS, lens_rows, sum_of, sums_of

LENS_BOUND = 1e-5
"""Bound of a lens gradient's error, relative to the sum of the terms' magnitudes.

It allows a few roundings of partial sums, and of the shape on the image.
"""
KINDS = ("ordinary", "anisotropy", "edge_on", "off_centre", "focal_lengths")


def worst_errors(device: Device, case: Case, rng: Generator, many: int) -> dict[str, Deviation]:
    """The largest errors of a case over `many` random inputs, half with the case's own sizes, half with random ones."""
    worst: dict[str, Deviation] = {}
    work = Workspace(device)
    for turn in range(many):
        size = case.sizes[int(rng.integers(len(case.sizes)))]
        if turn % 2:
            size = tuple(map(int, rng.integers(1, 41, 2))) if isinstance(size, tuple) else int(rng.integers(1, 2000))
        for name, error in case.errors(device, case.random(rng, size), work).items():
            worst[name] = max(worst.get(name, error), error)
    return worst


def lenses(device: Device, rng: Generator, many: int) -> float:
    """The largest relative error of the gradients with respect to a lens, over `many` views of the stressors KINDS.

    The gradients follow from random sums like those of blending's gradient.
    """
    worst, work = 0.0, Workspace(device)
    for turn in range(many):
        made = STRESSORS[KINDS[turn % len(KINDS)]].make(rng, 300)
        camera, sums, by_lens = made.camera, random_sums(rng, 300), work.array("lens", (300, LENS_NUMBERS))
        projected, _, _ = there_and_back(device, work, made, sums, by_lens=by_lens)
        rows = sums_of(work, 300, LENS_NUMBERS)
        lens_rows(device, projected.tile_counts, by_lens, rows)
        got, shown = sum_of(device, work, rows).get()[0], projected.tile_counts.get() > 0
        arrays = exact(made.gaussians)
        seen = project(*in_order(arrays), camera, DEGREE)
        sums[~shown] = 0
        wanted = lens_grad(*in_order(arrays)[:3], camera, seen, on_image(seen, sums))
        size = np.abs(by_lens.get()[shown].astype(float)).sum(axis=0)
        worst = max(worst, float((np.abs(got - wanted) / np.maximum(size, 1e-30)).max()))
    return worst


def stages(device: Device, seed: int, many: int) -> Result:
    """Errors by name with their bounds, and descriptions of faults. many: number of inputs for each stage."""
    rng = np.random.default_rng([seed, 77])
    worst = {"lens": Deviation(lenses(device, rng, many), LENS_BOUND)}
    for name, case in CASES.items():
        worst |= {f"{name}: {part}": error for part, error in worst_errors(device, case, rng, many).items()}
    errors = {name: {"error": error, "bound": bound} for name, (error, bound) in worst.items()}
    return {"errors": errors, "faults": faults(worst)}
