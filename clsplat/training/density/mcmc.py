# SPDX-License-Identifier: Apache-2.0
"""MCMC density control: dead Gaussians are relocated to live ones, and the model grows to a given number.

Kheradmand et al. 2024, "3D Gaussian Splatting as Markov Chain Monte Carlo". Unlike in the paper, the model grows by
halving the Gaussians with the largest gradients (docs/decisions/0029-mcmc-grows-by-halves.md). The noise of a step is
in `optimisation.step_noise`, and the settings are `DensityConfig` in `config/training.py`. Uses no OpenCL.
"""

from __future__ import annotations

from dataclasses import replace
from functools import cache
from itertools import pairwise
from math import inf

import numpy as np
from numpy.typing import NDArray

from clsplat.arrays import Bool, Float32, Float64
from clsplat.config.training import DensityConfig, TrainConfig
from clsplat.errors import ClsplatError
from clsplat.optimisation.density_rules import MarkRules
from clsplat.training.density import SPLIT_GROUPS, ModelState, RowPlan, StatisticsNeeds, Strategy
from clsplat.training.density.adaptive import draw_offsets, is_due, long_halves

MAX_GAUSSIANS_PER_PLACE = 51
"""Maximum number of Gaussians that together replace one Gaussian."""
MAX_SHARED_OPACITY = 1 - 1e-7
"""Upper limit of opacities in computations: above it a float32 logit has no precision left."""
MIN_DRAWN_OPACITY = 1 / 255
"""Opacity up to which a Gaussian is invisible in every picture."""
SCORE_ALL_RULES = MarkRules(gradient=-inf, large=-inf)
"""Rules that score every Gaussian by its mean gradient."""


class Mcmc(Strategy):
    """MCMC density control: every `DensityConfig.every` steps it relocates dead Gaussians and adds new ones, and at the
    end it removes invisible Gaussians.

    `exploration_of` gives the noise and the penalties of each step.
    """

    def __init__(self, config: TrainConfig) -> None:
        self.config = config.density

    def needs(self, step: int = 0) -> StatisticsNeeds:
        """Return the statistics that a step gathers: gradients, until the last growth."""
        config = self.config
        return StatisticsNeeds(gradients=step < config.stop, absolute=config.absolute_gradients)

    def is_due(self, step: int) -> bool:
        """True if relocation and growth are due after this step."""
        return is_due(self.config, step)

    def before_step(self, model: ModelState) -> RowPlan:
        """Plan to halve the Gaussians with the largest gradients. Second halves go to rows of dead Gaussians first,
        then to new rows. Dead Gaussians that are left over are relocated to live ones.

        A Gaussian is dead if it is nearly transparent, has no valid rotation, or is too large on the screen.
        """
        config = self.config
        stored = model.parameters["opacity_logits"].get()
        opacities = 1 / (1 + np.exp(-stored.astype(np.float64)))
        lengths = np.square(model.parameters["quaternions"].get().astype(np.float64)).sum(axis=1)
        dead = (opacities <= config.min_opacity) | (lengths < 1e-8)
        if config.max_screen_radius > 0:
            dead |= model.statistics["radii"].get() > config.max_screen_radius
        frozen = np.zeros(model.count, np.bool_)
        if model.region is not None:
            frozen = ~model.region.contains(model.parameters["means"].get())
            dead &= ~frozen
        if (dead | frozen).all():
            raise ClsplatError(
                f"step {model.step}: every Gaussian is dead: under --density.min-opacity {config.min_opacity}, without "
                "a rotation, or larger than --density.max-screen-radius; lower --density.min-opacity or "
                "--density.opacity-weight"
            )
        more, places = wanted(config, model.step, model.count) - model.count, np.flatnonzero(dead)
        if len(places) + more == 0:
            return RowPlan(new_statistics=True)
        scores = model.marker.scores(replace(SCORE_ALL_RULES, region=model.region))
        scores[dead] = 0
        split = strongest(scores, len(places) + more)
        places, left = places[: len(split)], places[len(split) :]
        rows = np.concatenate([np.arange(model.count), split[len(places) :]])
        rows[places] = split[: len(places)]
        groups = {group: model.parameters[group].get()[rows] for group in (*SPLIT_GROUPS, "opacity_logits")}
        halves = np.concatenate([split, places, np.arange(model.count, len(rows))])
        of_split = {group: whole[split] for group, whole in groups.items()}
        for second, changed in ((False, split), (True, halves[len(split) :])):
            for group, parts in long_halves(of_split, second).items():
                groups[group][changed] = parts
        shares = self._moved(groups, rows, left, frozen, model.rng)
        changed, placed = np.union1d(halves, shares), np.concatenate([halves, left])
        fresh = np.zeros(len(rows), np.bool_)
        fresh[changed] = True
        values = {group: (changed, groups[group][changed]) for group in ("opacity_logits", "log_scales")}
        values["means"] = (placed, groups["means"][placed])
        return RowPlan(rows=rows.astype(np.uint32), fresh=fresh, values=values, new_statistics=True)

    def _moved(
        self,
        groups: dict[str, Float32],
        rows: NDArray[np.int64],
        left: NDArray[np.int64],
        frozen: Bool,
        rng: np.random.Generator,
    ) -> NDArray[np.int64]:
        """Relocate the dead Gaussians in rows `left` to live ones, drawn in proportion to opacity (Kheradmand et al.
        2024).

        groups: parameters of the new model by group, updated in place.
        rows: source rows of the new model's rows, updated in place.
        frozen: (n,), True for old rows outside the region of the training, to which none is relocated.
        Returns the rows whose values change.
        """
        if len(left) == 0:
            return left
        least, spread = self.config.min_opacity, self.config.spread
        opacities = 1 / (1 + np.exp(-groups["opacity_logits"].astype(np.float64)))
        log_scales = groups["log_scales"].astype(np.float64)
        opacities[left] = opacities[frozen[rows]] = 0
        parents = draw(opacities, len(left), rng)
        own, total = np.unique(parents, return_counts=True)
        opacities[own], by = shared(opacities[own], np.minimum(total + 1, MAX_GAUSSIANS_PER_PLACE), least)
        log_scales[own] += by[:, None]
        opacities[left], log_scales[left] = opacities[parents], log_scales[parents]
        rows[left] = rows[parents]
        changed = np.union1d(own, left)
        parts = opacities[changed]
        groups["opacity_logits"][changed] = np.log(parts / (1 - parts))
        groups["log_scales"][changed] = log_scales[changed]
        means, turned = groups["means"][parents], groups["quaternions"][parents]
        groups["means"][left] = means + spread * draw_offsets(turned, log_scales[left], rng)
        return changed

    def at_end(self, model: ModelState) -> RowPlan | None:
        """Plan to drop the Gaussians that are invisible in every picture."""
        logits = model.parameters["opacity_logits"].get().astype(np.float64)
        drawn = 1 / (1 + np.exp(-logits)) > MIN_DRAWN_OPACITY
        return None if drawn.all() or not drawn.any() else RowPlan(rows=np.flatnonzero(drawn).astype(np.uint32))


def last_growth(config: DensityConfig) -> int:
    """Return the step of the last growth, at which the number reaches max_gaussians."""
    return (config.stop - 1) // config.every * config.every


def wanted(config: DensityConfig, step: int, count: int) -> int:
    """Return the number of Gaussians after this step's growth, from `count` before it.

    The number grows by the same factor each time, so that the last growth reaches max_gaussians.
    """
    left = max(last_growth(config) - step, 0) // config.every + 1
    factor: float = (config.max_gaussians / count) ** (1 / left)
    return max(round(factor * count), count)


def strongest(scores: Float32, count: int) -> NDArray[np.int64]:
    """Return the indices, in rising order, of the `count` largest positive scores, or of all positive scores if there
    are fewer."""
    order = np.argsort(-scores, kind="stable")[:count]
    return np.sort(order[scores[order] > 0])


def draw(weights: Float64, count: int, rng: np.random.Generator) -> NDArray[np.int64]:
    """Draw indices (count,) with replacement, with probabilities proportional to the weights."""
    sums = np.cumsum(weights)
    found: NDArray[np.int64] = np.searchsorted(sums, rng.random(count) * sums[-1], side="right")
    # a random number that is rounded up to the total would select an index after the last weight
    last = int(np.flatnonzero(weights)[-1])
    found[found > last] = last
    return found


def shared(opacities: Float64, numbers: NDArray[np.int64], least: float) -> tuple[Float64, Float64]:
    """Compute the opacity of the Gaussians that together replace one Gaussian, and the increment of their log scales.

    Equation (94) of docs/gradients.md, equation (9) of Kheradmand et al. 2024. All arrays are (n,).

    opacities: opacities of the replaced Gaussians.
    numbers: for each replaced Gaussian, the number of Gaussians that replace it.
    least: lower limit of the new opacities.
    """
    whole = np.minimum(opacities, MAX_SHARED_OPACITY)
    parts = np.clip(-np.expm1(np.log1p(-whole) / numbers), least, MAX_SHARED_OPACITY)
    powers = np.arange(1, MAX_GAUSSIANS_PER_PLACE + 1)
    terms = parts[:, None] ** powers * _factors()[numbers]
    return parts, np.log(whole / terms.sum(axis=1))


@cache
def _factors() -> Float64:
    """Table of (-1)^(j - 1) C(N, j) / sqrt(j) at row N and column j - 1, for N and j up to MAX_GAUSSIANS_PER_PLACE."""
    rows = np.zeros((MAX_GAUSSIANS_PER_PLACE + 1, MAX_GAUSSIANS_PER_PLACE))
    binomials = [1.0]
    for number in range(1, MAX_GAUSSIANS_PER_PLACE + 1):
        inner = [a + b for a, b in pairwise(binomials)]
        binomials = [1.0, *inner, 1.0]
        j = np.arange(1, number + 1)
        rows[number, :number] = np.where(j % 2, 1.0, -1.0) * np.array(binomials[1:]) / np.sqrt(j)
    return rows
