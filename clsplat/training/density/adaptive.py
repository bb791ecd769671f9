# SPDX-License-Identifier: Apache-2.0
"""Adaptive density control (Kerbl et al. 2023, section 5): what to clone, split and prune. Policy only: no device."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import replace
from functools import partial
from math import inf

import numpy as np

from clsplat.arrays import Float32, Float64
from clsplat.config.exploring import Exploration
from clsplat.config.marking import MarkRules, edge
from clsplat.config.training import DensityConfig, TrainConfig
from clsplat.errors import ClsplatError
from clsplat.training.density import HALVED, ModelState, RowPlan, StatisticsNeeds, Strategy, penalties

LONG_OFFSET, LONG_SCALE, SHORT_SCALE, LONG_OPACITY = 1.35, 0.55, 0.893, 0.6
"""Of halves along the longest axis: the distance of their means from the middle, in standard deviations; what is left
of that axis, of the others, and of the opacity (Improved-GS, Deng et al. 2025)."""


class Adaptive(Strategy):
    """The strategy of Kerbl et al., with what `DensityConfig` adds to it."""

    def __init__(self, config: TrainConfig) -> None:
        self.config, self.white, self.penalty = config.density, config.background == "white", config.penalty

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

    def exploration(self, step: int, means_rate: float, count: int, extent: float) -> Exploration | None:  # noqa: ARG002
        """Penalties alone, whatever the step."""
        return penalties(self.penalty, self.penalty, count, extent) if self.penalty > 0 else None

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
    all_wanted = config.growth == "budget" and config.edge_views == 0
    shrinks = 1 / LONG_SCALE if config.long_axis else config.split_factor
    rules = replace(
        _pruning(config, model),
        gradient=0.0 if all_wanted else edge(lambda mean: mean >= config.gradient_threshold),
        large=-inf if config.long_axis else edge(lambda log_scale: np.exp(log_scale) > dense),
    )
    if config.views_agree > 1 and "agreeing" in model.statistics:
        rules = replace(rules, agreeing=edge(lambda views: views >= config.views_agree))
    if config.opacity_reset_every > 0 and model.step > config.opacity_reset_every:
        rules = replace(
            rules,
            oversized=edge(lambda log_scale: np.exp(log_scale) > too_large),
            oversized_half=edge(lambda log_scale: np.exp(log_scale) / shrinks > too_large),
        )
        if config.max_screen_radius > 0:
            rules = replace(rules, radius=edge(lambda radius: radius > config.max_screen_radius))
    scores = None
    if config.edge_views > 0:
        scores = edge_scores(model.marker.scores(rules), _edges(config, model), model.rng)
    listed = model.marker.rows(replace(rules, strongest=_strongest(config, model, rules, scores)), scores)
    if config.long_axis:
        return RowPlan(listed=listed, halves=long_halves, halved=(*HALVED, "opacity_logits"), new_statistics=True)
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


def _edges(config: DensityConfig, model: ModelState) -> Float32:
    assert model.edges is not None, "a trainer has them"
    return model.edges(config.edge_views)


def edge_scores(scores: Float32, edges: Float32, rng: np.random.Generator) -> Float32:
    """Scores whose largest k are those of k Gaussians drawn without replacement, each as likely as what it adds to
    edges (Efraimidis and Spirakis 2006). (n,); what is less than 0 stays as it is."""
    drawn = edges.astype(np.float64) / rng.standard_exponential(len(edges))
    return np.where(scores < 0, scores, np.minimum(drawn, np.finfo(np.float32).max).astype(np.float32))


def _strongest(
    config: DensityConfig, model: ModelState, rules: MarkRules, scores: Float32 | None = None
) -> tuple[float, int]:
    """Score and row of the weakest Gaussian that there is room to clone or split, for `MarkRules`. The marker's scores
    are looked at only where room may be short; scores: others in their place."""
    room = config.max_gaussians - model.count
    if config.growth == "budget":
        room = budget(config, model.step, model.count) - model.count
    if room >= model.count:
        return -inf, 0
    if room <= 0:
        return inf, 0
    if scores is None:
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


def long_halves(split: Mapping[str, Float32]) -> dict[str, Float32]:
    """New means, log scales and opacities of first halves and then second ones, on both sides of the middle of the
    longest axis: docs/gradients.md, (102). By the groups HALVED and opacity_logits of what is split."""
    log_scales = split["log_scales"].astype(np.float64)
    longest = log_scales.argmax(axis=1)
    offsets, rows = np.zeros_like(log_scales), np.arange(len(log_scales))
    offsets[rows, longest] = LONG_OFFSET * np.exp(log_scales[rows, longest])
    turned = rotated(split["quaternions"], offsets)
    log_scales += np.log(SHORT_SCALE)
    log_scales[rows, longest] += np.log(LONG_SCALE) - np.log(SHORT_SCALE)
    # The logit of a part p of an opacity is ln p - ln(e^-o' + 1 - p).
    part, logits = LONG_OPACITY, split["opacity_logits"].astype(np.float64)
    opacities = np.log(part) - np.logaddexp(-logits, np.log(1 - part))
    means = np.concatenate([split["means"] + turned, split["means"] - turned])
    return {
        "means": means.astype(np.float32),
        "log_scales": np.tile(log_scales, (2, 1)).astype(np.float32),
        "opacity_logits": np.tile(opacities, 2).astype(np.float32),
    }


def split_halves(
    config: DensityConfig, *, means: Float32, quaternions: Float32, log_scales: Float32, rng: np.random.Generator
) -> tuple[Float32, Float32]:
    """Means and log scales of halves: drawn from the Gaussian they come from, and smaller. (m, 3), (m, 4), (m, 3)."""
    offsets = draw_offsets(quaternions, log_scales, rng)
    smaller = log_scales - np.float32(np.log(config.split_factor))
    return (means + offsets).astype(np.float32), smaller.astype(np.float32)


def draw_offsets(quaternions: Float32 | Float64, log_scales: Float32 | Float64, rng: np.random.Generator) -> Float64:
    """Places drawn from Gaussians (m,), from their means: (m, 3); quaternions (m, 4), log scales (m, 3)."""
    return rotated(quaternions, rng.standard_normal(log_scales.shape) * np.exp(log_scales.astype(np.float64)))


def rotated(quaternions: Float32 | Float64, offsets: Float64) -> Float64:
    """Offsets (m, 3) along the axes of Gaussians, turned by their quaternions (m, 4)."""
    q = quaternions.astype(np.float64)
    q /= np.maximum(np.linalg.norm(q, axis=1, keepdims=True), 1e-300)  # of length 0, which is not drawn: no rotation
    w, axis = q[:, :1], q[:, 1:]
    twice = 2 * np.cross(axis, offsets)
    turned: Float64 = offsets + w * twice + np.cross(axis, twice)
    return turned


def reset_opacities(config: DensityConfig, opacity_logits: Float32) -> Float32:
    """Opacities of at most `opacity_reset_to`."""
    ceiling = np.log(config.opacity_reset_to / (1 - config.opacity_reset_to))
    return np.minimum(opacity_logits, np.float32(ceiling))
