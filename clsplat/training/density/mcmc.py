# SPDX-License-Identifier: Apache-2.0
"""Density control as sampling (Kheradmand et al. 2024, "3D Gaussian Splatting as Markov Chain Monte Carlo"): dead
Gaussians move to live ones, the model grows to a given number, and noise explores. It grows where the picture is wrong,
which is not as published (docs/decisions/0027-the-long-axis.md). Policy only: no device."""

from __future__ import annotations

from dataclasses import replace
from functools import cache
from itertools import pairwise
from math import inf

import numpy as np
from numpy.typing import NDArray

from clsplat.arrays import Float32, Float64
from clsplat.config.exploring import Exploration, step_key
from clsplat.config.marking import MarkRules
from clsplat.config.training import DensityConfig, TrainConfig
from clsplat.errors import ClsplatError
from clsplat.training.density import ModelState, RowPlan, StatisticsNeeds, Strategy, penalties
from clsplat.training.density.adaptive import draw_offsets, is_due

MOST = 51
"""Gaussians that share the place of one, at most."""
GROWTH = 1.05
"""Factor by which the number grows each time, at least."""
OPAQUE = 1 - 1e-7
"""Opacity that is counted as no more than this, and from which on a logit has no room left in float32."""
DRAWN = 1 / 255
"""Opacity up to which a Gaussian is in no picture."""
EVERY = MarkRules(gradient=-inf, large=-inf)
"""Rules by which every Gaussian has its mean gradient for a score."""


class Mcmc(Strategy):
    """Relocation and growth each `every` steps, noise and penalties each step, and a model without what is never drawn
    at the end."""

    def __init__(self, config: TrainConfig) -> None:
        self.train, self.config = config, config.density

    def needs(self, step: int = 0) -> StatisticsNeeds:
        """Gradients as long as the model grows, and radii where Gaussians move for being large on the screen."""
        config = self.config
        moves = config.max_screen_radius > 0 and step < config.stop
        return StatisticsNeeds(gradients=moves or step <= halfway(config))

    def is_due(self, step: int) -> bool:
        """True if Gaussians move."""
        return is_due(self.config, step)

    def before_step(self, model: ModelState) -> RowPlan:
        """Move the dead to the places of live ones, then add some there. A Gaussian is dead if nearly transparent,
        without a rotation, or too large on the screen."""
        config, rng = self.config, model.rng
        stored = model.parameters["opacity_logits"].get()
        log_scales = model.parameters["log_scales"].get().astype(np.float64)
        opacities = 1 / (1 + np.exp(-stored.astype(np.float64)))
        lengths = np.square(model.parameters["quaternions"].get().astype(np.float64)).sum(axis=1)
        dead = (opacities <= config.min_opacity) | (lengths < 1e-8)
        if config.max_screen_radius > 0:
            dead |= model.statistics["radii"].get() > config.max_screen_radius
        if dead.all():
            raise ClsplatError(
                f"step {model.step}: every Gaussian is under --density.min-opacity {config.min_opacity}; lower that or "
                "--density.opacity-weight"
            )
        count, moved = model.count, int(dead.sum())
        more = wanted(config, model.step, count) - count
        rows, fresh = np.arange(count + more), np.zeros(count + more, np.bool_)
        fresh[count:] = True
        opacities = np.concatenate([opacities, np.zeros(more)])
        log_scales = np.concatenate([log_scales, np.zeros((more, 3))])
        wrong = grown_from(model.marker.scores(EVERY), dead) if more else None
        for places, weights in (
            (np.flatnonzero(dead), np.where(dead, 0.0, opacities[:count])),
            (np.arange(count, count + more), wrong),
        ):
            chances = opacities[:count] if weights is None else weights
            parents = draw(chances, len(places), rng)
            own, total = np.unique(parents, return_counts=True)
            opacities[own], by = shared(opacities[own], np.minimum(total + 1, MOST), config.min_opacity)
            log_scales[own] += by[:, None]
            rows[places] = rows[parents]
            opacities[places], log_scales[places] = opacities[parents], log_scales[parents]
            fresh[places] = fresh[own] = True
        if moved + more == 0:
            return RowPlan(new_statistics=True)
        changed = np.flatnonzero(fresh)
        logits = np.log(opacities[changed] / (1 - opacities[changed])).astype(np.float32)
        values = {
            "opacity_logits": (changed, logits),
            "log_scales": (changed, log_scales[changed].astype(np.float32)),
        }
        if config.spread > 0:
            new = np.concatenate([np.flatnonzero(dead), np.arange(count, count + more)])
            means, turned = (model.parameters[group].get()[rows[new]] for group in ("means", "quaternions"))
            offsets = config.spread * draw_offsets(turned, log_scales[new], rng)
            values["means"] = (new, (means + offsets).astype(np.float32))
        return RowPlan(rows=rows.astype(np.uint32), fresh=fresh, values=values, new_statistics=True)

    def exploration(self, step: int, means_rate: float, count: int, extent: float) -> Exploration:
        """Penalties whatever the step, noise until the cooldown begins; in units in which the scene's extent is 1."""
        config, train = self.config, self.train
        cools = step > train.iterations - train.optimiser.cooldown
        return replace(
            penalties(config.opacity_weight, config.scale_weight, count, extent),
            amount=0.0 if cools else config.noise_rate * means_rate / extent**2,
            dead=config.min_opacity,
            key=step_key(train.seed, step),
        )

    def at_end(self, model: ModelState) -> RowPlan | None:
        """Drop what is drawn in no picture."""
        logits = model.parameters["opacity_logits"].get().astype(np.float64)
        drawn = 1 / (1 + np.exp(-logits)) > DRAWN
        return None if drawn.all() or not drawn.any() else RowPlan(rows=np.flatnonzero(drawn).astype(np.uint32))


def halfway(config: DensityConfig) -> int:
    """Step in the middle of growth and moves, at which the cap is reached."""
    return (config.start + config.stop) // 2


def grown_from(scores: Float32, dead: NDArray[np.bool_]) -> Float64 | None:
    """Weights (n,) by which Gaussians are drawn to grow from: mean gradients on the screen, 0 for the dead; None if all
    are 0."""
    weights = np.where(dead, 0.0, np.maximum(scores, 0)).astype(np.float64)
    return weights if weights.any() else None


def wanted(config: DensityConfig, step: int, count: int) -> int:
    """Number of Gaussians after this step's growth, when there are `count` before it: a twentieth more, or as many as
    let the cap be reached halfway from `start` to `stop`."""
    left = max(halfway(config) - step, 0) // config.every + 1
    factor: float = max(GROWTH, (config.max_gaussians / count) ** (1 / left))
    return max(min(config.max_gaussians, round(factor * count)), count)


def draw(weights: Float64, count: int, rng: np.random.Generator) -> NDArray[np.int64]:
    """Indices (count,) drawn with replacement, each as likely as its weight."""
    sums = np.cumsum(weights)
    found: NDArray[np.int64] = np.searchsorted(sums, rng.random(count) * sums[-1], side="right")
    last = int(np.flatnonzero(weights)[-1])  # a product that was rounded up to the sum is of this one
    found[found > last] = last
    return found


def shared(opacities: Float64, numbers: NDArray[np.int64], least: float) -> tuple[Float64, Float64]:
    """Opacity of each of `numbers` Gaussians that together look like one of `opacities`, and what is added to its log
    scales: docs/gradients.md, (94). All (n,)."""
    whole = np.minimum(opacities, OPAQUE)
    parts = np.clip(-np.expm1(np.log1p(-whole) / numbers), least, OPAQUE)
    powers = np.arange(1, MOST + 1)
    terms = parts[:, None] ** powers * _factors()[numbers]
    return parts, np.log(whole / terms.sum(axis=1))


@cache
def _factors() -> Float64:
    """(-1)^(j - 1) C(N, j) / sqrt(j) at row N and column j - 1, (MOST + 1, MOST)."""
    rows = np.zeros((MOST + 1, MOST))
    binomials = [1.0]
    for number in range(1, MOST + 1):
        inner = [a + b for a, b in pairwise(binomials)]
        binomials = [1.0, *inner, 1.0]
        j = np.arange(1, number + 1)
        rows[number, :number] = np.where(j % 2, 1.0, -1.0) * np.array(binomials[1:]) / np.sqrt(j)
    return rows
