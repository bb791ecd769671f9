# SPDX-License-Identifier: Apache-2.0
"""Adaptive density control (Kerbl et al. 2023, section 5): clone, split and prune. Uses no OpenCL.

Steps and thresholds are settings: `DensityConfig` in `config/training.py`.
"""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import replace
from functools import partial
from math import inf

import numpy as np

from clsplat.arrays import Float32, Float64
from clsplat.config.points import SKY_RADIUS_RATIO
from clsplat.config.training import DensityConfig, TrainConfig
from clsplat.errors import ClsplatError
from clsplat.optimisation.density_rules import MarkRules, edge
from clsplat.training.density import SPLIT_GROUPS, ModelState, RowPlan, StatisticsNeeds, Strategy

HALF_OFFSET_DEVIATIONS, LONG_AXIS_HALF_RATIO, SHORT_AXIS_HALF_RATIO, HALF_OPACITY_RATIO = 1.35, 0.55, 0.893, 0.6
"""Constants of halves along the longest axis (Improved-GS, Deng et al. 2025).

HALF_OFFSET_DEVIATIONS: distance of the halves' means from the original mean, in standard deviations.
LONG_AXIS_HALF_RATIO, SHORT_AXIS_HALF_RATIO: factor on the scale of the longest axis, and on the two other scales.
HALF_OPACITY_RATIO: factor on the opacity.
"""
SCORED_ROWS = 1 << 16
"""Number of scores that are compared with a given score at a time, which limits the size of copies."""


class Adaptive(Strategy):
    """Density control of Kerbl et al. (clone, split, prune, reset opacities), with the extensions of
    `DensityConfig`."""

    def __init__(self, config: TrainConfig) -> None:
        self.config, self.white, self.sky = config.density, config.background == "white", config.sky > 0

    def needs(self, step: int = 0) -> StatisticsNeeds:
        """Return the statistics that the rules use after `step` steps.

        Gradients are needed while Gaussians are densified, and contributions while a pruning that uses them is still to
        come.
        """
        config = self.config
        densifies = config.every > 0 and step < config.stop
        prunes = config.min_contribution > 0 and (config.prune_every > 0 or densifies)
        return StatisticsNeeds(
            gradients=step < config.stop,
            absolute=config.absolute_gradients,
            contributions=prunes,
        )

    def is_due(self, step: int) -> bool:
        """True if Gaussians are densified or pruned, or opacities are reset."""
        rows_change = is_due(self.config, step) or is_pruning_due(self.config, step)
        return rows_change or is_reset_due(self.config, step, white=self.white)

    def before_step(self, model: ModelState) -> RowPlan:
        """Plan to densify or prune, and then to reset opacities, each only if it is due."""
        config, step, made = self.config, model.step, RowPlan()
        if (densifies := is_due(config, step)) or is_pruning_due(config, step):
            made = plan(config, model, sky=self.sky) if densifies else plan_pruning(config, model)
            if made.listed is not None and made.listed.count == 0:
                raise ClsplatError(
                    f"step {step}: every Gaussian was pruned; lower --density.min-opacity"
                    + (" or --density.min-contribution" if config.min_contribution > 0 else "")
                )
        if is_reset_due(config, step, white=self.white):
            changes = {"opacity_logits": partial(reset_opacities, config)}
            made = replace(
                made,
                changes=changes,
                region=model.region,
                restarted=("opacity_logits",),
                forget_contributions=True,
            )
        return made


def is_due(config: DensityConfig, step: int) -> bool:
    """True if Gaussians are cloned, split and pruned after this step."""
    return config.every > 0 and config.start < step < config.stop and step % config.every == 0


def is_pruning_due(config: DensityConfig, step: int) -> bool:
    """True if Gaussians are pruned by opacity and contribution after this step, even without densification."""
    return config.prune_every > 0 and step > config.start and step % config.prune_every == 0


def is_reset_due(config: DensityConfig, step: int, *, white: bool) -> bool:
    """True if opacities are reset after this step. With a white background they are reset once more, at the start of
    densification, as in the authors' code."""
    if config.every <= 0 or step >= config.stop:
        return False
    return (config.opacity_reset_every > 0 and step % config.opacity_reset_every == 0) or (
        white and step == config.start
    )


def plan(config: DensityConfig, model: ModelState, *, sky: bool = False) -> RowPlan:
    """Plan to clone small and to split large Gaussians with a large mean gradient, and to prune Gaussians that are
    transparent, oversized or contribute little.

    sky: True if the model has sky Gaussians. The size limit of all Gaussians is then relative to SKY_RADIUS_RATIO
        (`config.points`) times the extent.
    In the plan the remaining Gaussians come first, in their order. Clones and halves are marked as fresh.
    """
    # Each rule compares in float32, as NumPy does with a float32 array and a Python number.
    size = SKY_RADIUS_RATIO * model.extent if sky else model.length_unit
    too_large = config.max_world_fraction * size
    dense = config.dense_fraction * model.length_unit
    shrinks = 1 / LONG_AXIS_HALF_RATIO if config.long_axis else config.split_factor
    rules = replace(
        _pruning(config, model),
        gradient=0.0 if config.growth == "budget" else edge(lambda mean: mean >= config.gradient_threshold),
        large=-inf if config.long_axis else edge(lambda log_scale: np.exp(log_scale) > dense),
    )
    if config.opacity_reset_every > 0 and model.step > config.opacity_reset_every:
        rules = replace(
            rules,
            oversized=edge(lambda log_scale: np.exp(log_scale) > too_large),
            oversized_half=edge(lambda log_scale: np.exp(log_scale) / shrinks > too_large),
        )
        if config.max_screen_radius > 0:
            rules = replace(rules, radius=edge(lambda radius: radius > config.max_screen_radius))
    listed = model.marker.rows(replace(rules, cut_off=_cut_off(config, model, rules)))
    if config.long_axis:
        return RowPlan(listed=listed, halves=long_halves, halved=(*SPLIT_GROUPS, "opacity_logits"), new_statistics=True)
    return RowPlan(listed=listed, halves=partial(draw_halves, config, rng=model.rng), new_statistics=True)


def plan_pruning(config: DensityConfig, model: ModelState) -> RowPlan:
    """Plan a pruning without densification: of Gaussians that are transparent or contribute little."""
    return RowPlan(listed=model.marker.rows(_pruning(config, model)))


def _pruning(config: DensityConfig, model: ModelState) -> MarkRules:
    """Rules for pruning transparent Gaussians and Gaussians that no view needs.

    Contributions are in pixels, and infinite while unknown. The largest contribution is the maximum over the views of
    the last complete epoch and of the current epoch.
    """
    opaque = np.log(config.min_opacity / (1 - config.min_opacity))
    rules = MarkRules(transparent=edge(lambda logit: logit >= opaque), region=model.region)
    if "whole_totals" not in model.statistics:
        return rules
    if config.min_contribution > 0:
        rules = replace(rules, contribution=edge(lambda largest: largest >= config.min_contribution))
    return rules


def _cut_off(config: DensityConfig, model: ModelState, rules: MarkRules) -> tuple[float, int]:
    """Return score and row of the weakest Gaussian that may still be cloned or split, for `MarkRules.cut_off`.

    Scores are computed only if max_gaussians may leave too little room for all Gaussians that pass the other rules.
    """
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
    return weakest(scores, room)


def weakest(scores: Float32, count: int) -> tuple[float, int]:
    """Score and row of the Gaussian with the smallest score among the `count` Gaussians with the largest scores.

    Gaussians with equal scores are taken in the order of their rows. Makes one copy of the scores.
    """
    value = np.partition(scores, len(scores) - count)[len(scores) - count]
    equal = count - np.count_nonzero(scores > value)
    for begin in range(0, len(scores), SCORED_ROWS):
        rows = np.flatnonzero(scores[begin : begin + SCORED_ROWS] == value)
        if equal <= len(rows):
            return float(value), begin + int(rows[equal - 1])
        equal -= len(rows)
    raise AssertionError(f"the scores have NaN, or are fewer than {count}")


def budget(config: DensityConfig, step: int, count: int) -> int:
    """Number of Gaussians after this step's densification, from `count` before it.

    In Taming 3DGS (Mallick et al. 2024), A(x) = B - (B - S)(1 - x/N)^2 is the number of Gaussians after x of N
    densifications, from S at first to B at last. So each densification reduces the gap to B, here max_gaussians, by a
    known ratio, even if Gaussians were pruned in between.
    """
    last = (config.stop - 1) // config.every * config.every
    before = max(step - config.every, config.start)
    left = ((last - step) / (last - before)) ** 2 if step < last else 0.0
    return config.max_gaussians - round((config.max_gaussians - count) * left)


def draw_halves(
    config: DensityConfig,
    split: Mapping[str, Float32],
    second: bool,  # noqa: ARG001
    *,
    rng: np.random.Generator,
) -> dict[str, Float32]:
    """Draw the means and log scales of one half of each split Gaussian, for `RowPlan.halves`.

    split: parameters of the Gaussians that are split, one array for each parameter group in SPLIT_GROUPS.
    second: not used, because both halves are drawn from the same distribution.
    """
    means, log_scales = split_halves(config, split, rng)
    return {"means": means, "log_scales": log_scales}


def long_halves(split: Mapping[str, Float32], second: bool) -> dict[str, Float32]:
    """Compute one half of each split Gaussian, moved along its longest axis: equation (102) of docs/gradients.md.

    Returns means, log scales and opacity logits.

    split: the groups SPLIT_GROUPS and opacity_logits of the split Gaussians.
    second: True for the second halves, which are moved in the opposite direction.
    """
    log_scales = split["log_scales"].astype(np.float64)
    longest = log_scales.argmax(axis=1)
    offsets, rows = np.zeros_like(log_scales), np.arange(len(log_scales))
    offsets[rows, longest] = HALF_OFFSET_DEVIATIONS * np.exp(log_scales[rows, longest])
    turned = rotated(split["quaternions"], offsets)
    log_scales += np.log(SHORT_AXIS_HALF_RATIO)
    log_scales[rows, longest] += np.log(LONG_AXIS_HALF_RATIO) - np.log(SHORT_AXIS_HALF_RATIO)
    # If an opacity has the logit o', p times this opacity has the logit ln p - ln(e^-o' + 1 - p).
    part, logits = HALF_OPACITY_RATIO, split["opacity_logits"].astype(np.float64)
    opacities = np.log(part) - np.logaddexp(-logits, np.log(1 - part))
    means = split["means"] - turned if second else split["means"] + turned
    return {
        "means": means.astype(np.float32),
        "log_scales": log_scales.astype(np.float32),
        "opacity_logits": opacities.astype(np.float32),
    }


def split_halves(
    config: DensityConfig, split: Mapping[str, Float32], rng: np.random.Generator
) -> tuple[Float32, Float32]:
    """Return means (m, 3), drawn from the split Gaussians, and smaller log scales (m, 3): one half of each.

    split: parameters of the Gaussians that are split, one array for each parameter group in SPLIT_GROUPS.
    """
    means, log_scales = split["means"], split["log_scales"]
    offsets = draw_offsets(split["quaternions"], log_scales, rng)
    smaller = log_scales - np.float32(np.log(config.split_factor))
    return (means + offsets).astype(np.float32), smaller.astype(np.float32)


def draw_offsets(quaternions: Float32 | Float64, log_scales: Float32 | Float64, rng: np.random.Generator) -> Float64:
    """Offsets (m, 3) from the means, drawn from Gaussians with quaternions (m, 4) and log scales (m, 3)."""
    return rotated(quaternions, rng.standard_normal(log_scales.shape) * np.exp(log_scales.astype(np.float64)))


def rotated(quaternions: Float32 | Float64, offsets: Float64) -> Float64:
    """Rotate offsets (m, 3) by quaternions (m, 4) from the Gaussians' own axes to the world's."""
    q = quaternions.astype(np.float64)
    q /= np.maximum(np.linalg.norm(q, axis=1, keepdims=True), 1e-300)  # zero stays zero; such a Gaussian is never drawn
    w, axis = q[:, :1], q[:, 1:]
    twice = 2 * np.cross(axis, offsets)
    turned: Float64 = offsets + w * twice + np.cross(axis, twice)
    return turned


def reset_opacities(config: DensityConfig, opacity_logits: Float32) -> Float32:
    """Return the opacity logits, lowered to the logit of `opacity_reset_to` where they are above it."""
    ceiling = np.log(config.opacity_reset_to / (1 - config.opacity_reset_to))
    return np.minimum(opacity_logits, np.float32(ceiling))
