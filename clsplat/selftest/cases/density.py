# SPDX-License-Identifier: Apache-2.0
"""Cases of density control: the statistics of Gaussians over views, and the list of the rows that rules mark."""

from __future__ import annotations

from dataclasses import replace
from typing import Any

import numpy as np
from numpy.random import Generator

from clsplat.arrays import Float32
from clsplat.camera import Camera
from clsplat.device.buffers import Workspace, upload
from clsplat.device.context import Device
from clsplat.gaussians import Gaussians
from clsplat.layouts.columns import SPLAT
from clsplat.optimisation.density_rules import MarkRules
from clsplat.optimisation.trained_region import TrainedRegion
from clsplat.reference import density as reference
from clsplat.selftest.case import Arrays, Case, Expected, Inputs, Read, exactly, faults
from clsplat.selftest.harness import WHITENING_FACTOR, CaseBench, StageOutcome
from clsplat.selftest.scenes import evenly
from clsplat.stages.density import CONTRIBUTION_STATISTICS, DeviceMarker, add_statistics, new_statistics
from clsplat.stages.device_gaussians import to_host, upload_gaussians
from clsplat.stages.project import Projected, Screen

MARK_RULES = MarkRules(gradient=2.0, cut_off=(3.0, 40), large=0.5, transparent=-1.0, oversized=2.0, oversized_half=1.5)
MARKED_REGION = TrainedRegion(np.eye(3)[:2], np.array([0.0, -np.inf]), np.array([1.0, 0.25]))
"""Region whose edges are coordinates of some Gaussians."""
MIN_RADIUS_MARGIN = 1e-4
"""Relative distance of a radius from a whole number of pixels. Below it, rounding errors may change the radius when it
is rounded up to whole pixels."""


def _random(rng: Generator, count: int) -> Inputs:
    """Three random views of ellipses of any size. In each a third of the Gaussians is invisible."""
    columns = {name: index for index, name in enumerate(SPLAT)}
    views = []
    for _ in range(3):
        splats = rng.normal(size=(count, len(SPLAT))).astype(np.float32)
        sides = np.exp(rng.uniform(-1, 3, (2, count)))
        splats[:, columns["L11"]], splats[:, columns["L22"]] = WHITENING_FACTOR / sides
        splats[:, columns["L12"]] = rng.uniform(-0.5, 0.5, count) * splats[:, columns["L11"]]
        screen = rng.normal(size=(count, 2)).astype(np.float32)
        views.append((splats, rng.integers(0, 3, count).astype(np.uint32), screen))
    return Inputs(views=views, camera=Camera(60, 40, 50.0, 50.0, 30.0, 20.0, np.eye(3), np.zeros(3)))


def _frozen(bench: CaseBench) -> list[Inputs]:
    screen = evenly(34, (bench.model.count, 2), -0.0625, 0.0625).astype(np.float32)
    view = (bench.projected.splats.get(), bench.projected.tile_counts.get(), screen)
    return [Inputs(views=[view, view], camera=bench.camera)]


def _launch(device: Device, _: Workspace, given: Inputs) -> Read:
    statistics = new_statistics(device, len(given.views[0][1]))
    for view in given.views:
        splats, tiles, screen = (upload(device, array) for array in view)
        add_statistics(device, statistics, given.camera, Projected(splats, tiles), Screen(screen))
    return lambda: {name: array.get() for name, array in statistics.named().items()}


def _twin(given: Inputs, got: Arrays) -> dict[str, Expected]:
    sums, seen, radii, doubtful = (np.zeros(len(got["seen"]), kind) for kind in (float, float, float, bool))
    to_ndc = 0.5 * np.array([given.camera.width, given.camera.height])
    for splats, tiles, screen in given.views:
        shown = tiles > 0
        sums += np.where(shown, np.hypot(*(to_ndc * screen.astype(np.float64)).T), 0)
        seen += shown
        # Splats of invisible Gaussians may be uninitialised memory.
        rows = np.where(shown[:, None], splats, 1.0).astype(np.float64)
        l11, l12, l22 = (rows[:, SPLAT.index(name)] / WHITENING_FACTOR for name in ("L11", "L12", "L22"))
        sxx, sxy, syy = np.stack([l12 * l12 + l22 * l22, -l11 * l12, l11 * l11]) / (l11 * l22) ** 2
        radius = 3 * np.sqrt(0.5 * (sxx + syy) + np.hypot(0.5 * (sxx - syy), sxy)) * shown
        doubtful |= np.abs(radius - np.rint(radius)) < MIN_RADIUS_MARGIN * radius
        radii = np.maximum(radii, np.ceil(radius))
    found = got["radii"]
    radii = np.where(doubtful & (np.abs(found - radii) <= 1), found, radii)
    # the bound covers the roundings of a square root and of two sums
    return {"gradient_sums": Expected(sums, 1e-6, sums), "seen": exactly(seen), "radii": exactly(radii)}


STATISTICS_CASE = Case(
    sizes=(1, 2, 63, 65, 64, 127, 129, 1025),
    random=_random,
    launch=_launch,
    twin=_twin,
    frozen=_frozen,
    digested=("gradient_sums", "seen", "radii"),
)


def _random_marks(rng: Generator, count: int) -> Inputs:
    """Random inputs of the rules that mark rows.

    Many statistics, scales and opacities equal a rule's threshold, or are the next float above or below it. Some are
    not finite.
    """

    def values(*around: float, size: tuple[int, ...] = (count,)) -> Float32:
        at = np.array(around, np.float32)
        near = (at, *(np.nextafter(at, np.float32(side)) for side in (-np.inf, np.inf)))
        every = np.concatenate([*near, [-9, 0, 9, np.nan, np.inf, -np.inf]]).astype(np.float32)
        return np.asarray(rng.choice(every, size))

    wide = bool(rng.random() < 0.5)
    names = ("gradient_sums", "seen", "radii", *(CONTRIBUTION_STATISTICS if wide else ()))
    statistics = {name: values(0.25, 1, 4) for name in names}
    statistics["gradient_sums"] = values(2, 3, 6, 9)
    statistics["seen"] = rng.integers(0, 4, count).astype(np.float32)
    further = replace(MARK_RULES, radius=4.0, contribution=0.25 if wide else -np.inf)
    zeros = np.zeros((count, 4), np.float32)
    means = rng.choice([-0.5, 0, 0.25, 1, np.nan], (count, 3)).astype(np.float32)
    gaussians = Gaussians(*(means, zeros, values(0.5, 1.5, 2, size=(count, 3)), values(-1), zeros[:, None, :3]))
    of_region = replace(further, region=MARKED_REGION)
    rules = (MarkRules(), MARK_RULES, further, replace(further, gradient=0.0, cut_off=(-np.inf, 0)), of_region)
    return Inputs(statistics=statistics, gaussians=gaussians, rules=rules, streamed=bool(rng.random() < 0.5))


def _launch_marks(device: Device, work: Workspace, given: Inputs) -> Read:
    model = upload_gaussians(device, given.gaussians)
    statistics = new_statistics(device, model.count, contributions="whole_largest" in given.statistics)
    statistics.load(given.statistics)
    held = replace(to_host(model), rows=device.row_alignment) if given.streamed else model
    marker, found = DeviceMarker(device, work, held, statistics), dict[str, Any]()
    for index, rules in enumerate(given.rules):
        found[f"scores {index}"], listed = marker.scores(rules), marker.rows(rules)
        found |= {f"rows {index}": listed.entries(), f"halves {index}": np.array([listed.halves])}
    return lambda: found


def _twin_of_marks(given: Inputs, _: Arrays) -> dict[str, Expected]:
    known, gaussians, wanted = given.statistics, given.gaussians, {}
    for index, rules in enumerate(given.rules):
        arrays = (gaussians.means, gaussians.log_scales, gaussians.opacity_logits)
        rows, halves = reference.rows(rules, known, *arrays)
        wanted[f"scores {index}"] = exactly(reference.scores(rules, known, gaussians.means))
        wanted |= {f"rows {index}": exactly(rows), f"halves {index}": exactly(np.array([halves]))}
    return wanted


MARKS_CASE = Case(
    sizes=STATISTICS_CASE.sizes,
    random=_random_marks,
    launch=_launch_marks,
    twin=_twin_of_marks,
    by_shape=False,
)


def of_statistics(bench: CaseBench) -> StageOutcome:
    """Test the statistics, and the list of marked rows. The thresholds are inside the range of each statistic."""
    outcome, gaussians = STATISTICS_CASE.outcome(bench), bench.frozen.gaussians
    known = dict(zip(STATISTICS_CASE.digested, outcome.arrays, strict=True))
    middle, limit = 0.500001 * np.median(known["gradient_sums"]), float(np.median(gaussians.log_scales.max(axis=1)))
    transparent = float(np.median(gaussians.opacity_logits)) - 1
    rules = MarkRules(gradient=float(middle), large=limit, transparent=transparent, oversized=limit + 2)
    given = Inputs(statistics=known, gaussians=gaussians, rules=[rules], streamed=False)
    wrong = faults(MARKS_CASE.errors(bench.device, given))
    return replace(outcome, trouble=outcome.trouble or ", ".join(wrong))
