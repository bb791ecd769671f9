# SPDX-License-Identifier: Apache-2.0
"""Adaptive density control (Kerbl et al. 2023, section 5): what to clone, split and prune. Policy only: no device."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import replace
from functools import partial
from math import inf

import numpy as np

from clsplat.arrays import Float32, Float64
from clsplat.config.marking import MarkRules, edge
from clsplat.config.training import DensityConfig, TrainConfig
from clsplat.errors import ClsplatError
from clsplat.training.density import HALVED, ModelState, RowPlan, StatisticsNeeds, Strategy


class Adaptive(Strategy):
    """The strategy of Kerbl et al., with what `DensityConfig` adds to it."""

    def __init__(self, config: TrainConfig) -> None:
        self.config, self.white = config.density, config.background == "white"

    def needs(self, step: int = 0) -> StatisticsNeeds:
        """Gradients as long as Gaussians are densified, the others where some pruning at the end of this step or later
        goes by them."""
        config = self.config
        densifies = config.every > 0 and step < config.stop
        prunes = config.min_contribution > 0 and (config.prune_every > 0 or densifies)
        prunes_a_share = config.prune_fraction > 0 and step <= max(config.prune_at, default=-1)
        return StatisticsNeeds(
            gradients=step < config.stop,
            absolute=config.absolute_gradients,
            agreement=config.every > 0 and config.views_agree > 1,
            threshold=config.gradient_threshold,
            contributions=prunes or prunes_a_share,
        )

    def is_due(self, step: int) -> bool:
        """True if Gaussians are densified or pruned, or opacities are reset."""
        rows_change = is_due(self.config, step) or is_pruning_due(self.config, step)
        return rows_change or is_reset_due(self.config, step, white=self.white)

    def before_step(self, model: ModelState) -> RowPlan:
        """Densify or prune, then reset opacities, whichever is due."""
        config, step, made = self.config, model.step, RowPlan()
        if (densifies := is_due(config, step)) or is_pruning_due(config, step):
            made = plan(config, model) if densifies else plan_pruning(config, model)
            if made.listed is not None and made.listed.count == 0:
                raise ClsplatError(
                    f"step {step}: every Gaussian was pruned; lower --density.min-opacity"
                    + (" or --density.min-contribution" if config.min_contribution > 0 else "")
                )
        if is_reset_due(config, step, white=self.white):
            changes = {"opacity_logits": partial(reset_opacities, config)}
            made = replace(made, changes=changes, restarted=("opacity_logits",), forget_contributions=True)
        return made


def is_due(config: DensityConfig, step: int) -> bool:
    """True if Gaussians are cloned, split and pruned after this step."""
    return config.every > 0 and config.start < step < config.stop and step % config.every == 0


def is_pruning_due(config: DensityConfig, step: int) -> bool:
    """True if Gaussians are pruned by opacity and contribution after this step, densified or not."""
    regular = config.prune_every > 0 and step > config.start and step % config.prune_every == 0
    return regular or step in config.prune_at


def is_reset_due(config: DensityConfig, step: int, *, white: bool) -> bool:
    """True if opacities are reset after this step; once early before a white background, as in the authors' code."""
    if config.every <= 0 or step >= config.stop:
        return False
    return (config.opacity_reset_every > 0 and step % config.opacity_reset_every == 0) or (
        white and step == config.start
    )


def plan(config: DensityConfig, model: ModelState) -> RowPlan:
    """Clone the small and split the large among those with a large mean gradient; prune the transparent, the oversized
    and what hardly contributes. Kept ones come first and in order; fresh are clones and halves of splits."""
    # Each rule in the float widths of a comparison of arrays: of float32 with a Python number.
    too_large, dense = config.max_world_fraction * model.extent, config.dense_fraction * model.extent
    rules = replace(
        _pruning(config, model),
        gradient=0.0 if config.growth == "budget" else edge(lambda mean: mean >= config.gradient_threshold),
        large=edge(lambda log_scale: np.exp(log_scale) > dense),
    )
    if config.views_agree > 1 and "agreeing" in model.statistics:
        rules = replace(rules, agreeing=edge(lambda views: views >= config.views_agree))
    if config.opacity_reset_every > 0 and model.step > config.opacity_reset_every:
        rules = replace(
            rules,
            oversized=edge(lambda log_scale: np.exp(log_scale) > too_large),
            oversized_half=edge(lambda log_scale: np.exp(log_scale) / config.split_factor > too_large),
        )
        if config.max_screen_radius > 0:
            rules = replace(rules, radius=edge(lambda radius: radius > config.max_screen_radius))
    listed = model.marker.rows(replace(rules, strongest=_strongest(config, model, rules)))
    return RowPlan(listed=listed, halves=partial(draw_halves, config, rng=model.rng), new_statistics=True)


def plan_pruning(config: DensityConfig, model: ModelState) -> RowPlan:
    """Prune the transparent and what hardly contributes, and nothing else."""
    return RowPlan(listed=model.marker.rows(_pruning(config, model)))


def _pruning(config: DensityConfig, model: ModelState) -> MarkRules:
    """The rules by which the transparent go and those that no view needs, and at the steps of `prune_at` a fraction of
    those whose use is known.

    Contributions are in pixels, and infinite where they are not known yet. Totals are over the views of the last whole
    epoch, the largest are of any view in that epoch and the one under way.
    """
    opaque = np.log(config.min_opacity / (1 - config.min_opacity))
    rules = MarkRules(transparent=edge(lambda logit: logit >= opaque))
    if "whole_totals" not in model.statistics:
        return rules
    if config.min_contribution > 0:
        rules = replace(rules, contribution=edge(lambda largest: largest >= config.min_contribution))
    if model.step in config.prune_at:
        totals = model.statistics["whole_totals"].get()
        known = np.flatnonzero(np.isfinite(totals))
        least = np.argsort(totals[known], kind="stable")[: int(config.prune_fraction * len(known))]
        if len(least):
            rules = replace(rules, least=(float(totals[known[least[-1]]]), int(known[least[-1]])))
    return rules


def _strongest(config: DensityConfig, model: ModelState, rules: MarkRules) -> tuple[float, int]:
    """Score and row of the weakest Gaussian that there is room to clone or split, for `MarkRules`. Scores are looked at
    only where room may be short."""
    room = config.max_gaussians - model.count
    if config.growth == "budget":
        room = budget(config, model.step, model.count) - model.count
    if room >= model.count:
        return -inf, 0
    if room <= 0:
        return inf, 0
    scores = model.marker.scores(rules)
    if np.count_nonzero(scores >= 0) <= room:
        return -inf, 0
    last = int(np.argsort(-scores, kind="stable")[room - 1])
    return float(scores[last]), last


def budget(config: DensityConfig, step: int, count: int) -> int:
    """Number of Gaussians wanted after this step's densification, when there are `count` before it.

    Taming 3DGS (Mallick et al. 2024): A(x) = (B - S - k N)/N^2 x^2 + k x + S with k = 2 (B - S)/N, from S to B in N
    densifications. That is B - (B - S)(1 - x/N)^2, so that each brings what is still missing down by a known ratio:
    what was pruned in between is made up for on the way. The last densification reaches B.
    """
    last = (config.stop - 1) // config.every * config.every
    before = max(step - config.every, config.start)
    left = ((last - step) / (last - before)) ** 2 if step < last else 0.0
    return config.max_gaussians - round((config.max_gaussians - count) * left)


def draw_halves(config: DensityConfig, split: Mapping[str, Float32], *, rng: np.random.Generator) -> dict[str, Float32]:
    """New means and log scales of all first halves and then all second ones, by the groups HALVED of what is split."""
    means, log_scales = split_halves(config, **{name: np.tile(split[name], (2, 1)) for name in HALVED}, rng=rng)
    return {"means": means, "log_scales": log_scales}


def split_halves(
    config: DensityConfig, *, means: Float32, quaternions: Float32, log_scales: Float32, rng: np.random.Generator
) -> tuple[Float32, Float32]:
    """Means and log scales of halves: drawn from the Gaussian they come from, and smaller. (m, 3), (m, 4), (m, 3)."""
    offsets = draw_offsets(quaternions, log_scales, rng)
    smaller = log_scales - np.float32(np.log(config.split_factor))
    return (means + offsets).astype(np.float32), smaller.astype(np.float32)


def draw_offsets(quaternions: Float32 | Float64, log_scales: Float32 | Float64, rng: np.random.Generator) -> Float64:
    """Places drawn from Gaussians (m,), from their means: (m, 3); quaternions (m, 4), log scales (m, 3)."""
    offsets = rng.standard_normal(log_scales.shape) * np.exp(log_scales.astype(np.float64))
    q = quaternions.astype(np.float64)
    q /= np.maximum(np.linalg.norm(q, axis=1, keepdims=True), 1e-300)  # of length 0, which is not drawn: no rotation
    w, axis = q[:, :1], q[:, 1:]
    twice = 2 * np.cross(axis, offsets)
    rotated: Float64 = offsets + w * twice + np.cross(axis, twice)
    return rotated


def reset_opacities(config: DensityConfig, opacity_logits: Float32) -> Float32:
    """Opacities of at most `opacity_reset_to`."""
    ceiling = np.log(config.opacity_reset_to / (1 - config.opacity_reset_to))
    return np.minimum(opacity_logits, np.float32(ceiling))
