# SPDX-License-Identifier: Apache-2.0
"""Adaptive density control (Kerbl et al. 2023, section 5): what to clone, split and prune. Policy only: no device."""

from __future__ import annotations

from dataclasses import replace
from typing import Any

import numpy as np
from numpy.typing import NDArray

from clsplat.arrays import Float32
from clsplat.config.training import DensityConfig, TrainConfig
from clsplat.errors import ClsplatError
from clsplat.training.density import ModelState, RowPlan, StatisticsNeeds, Strategy


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
        config, step = self.config, model.step
        logits, made = model.parameters["opacity_logits"].get(), RowPlan()
        if (densifies := is_due(config, step)) or is_pruning_due(config, step):
            made = plan(config, model) if densifies else plan_pruning(config, model)
            logits = logits[made.rows]
            if len(logits) == 0:
                raise ClsplatError(
                    f"step {step}: every Gaussian was pruned; lower --density.min-opacity"
                    + (" or --density.min-contribution" if config.min_contribution > 0 else "")
                )
        if is_reset_due(config, step, white=self.white):
            values = {**made.values, "opacity_logits": (np.arange(len(logits)), reset_opacities(config, logits))}
            made = replace(made, values=values, restarted=("opacity_logits",), forget_contributions=True)
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
    gradient_sums, seen, radii = (model.statistics[name].get() for name in ("gradient_sums", "seen", "radii"))
    useless = _useless(config, model)
    with np.errstate(invalid="ignore"):
        gradients = np.asarray(gradient_sums / np.maximum(seen, 1), np.float32)
    gradients[~np.isfinite(gradients)] = 0  # statistics that something has spoilt ask for nothing
    wanted = _wanted(config, model, gradients, useless)
    sizes = np.exp(model.parameters["log_scales"].get().max(axis=1))
    large = sizes > config.dense_fraction * model.extent
    to_clone, to_split = np.flatnonzero(wanted & ~large), np.flatnonzero(wanted & large)
    kept = np.flatnonzero(~(wanted & large))

    rows = np.concatenate([kept, to_clone, to_split, to_split])
    origin = np.repeat([0, 1, 2], [len(kept), len(to_clone), 2 * len(to_split)])
    sizes_after = np.where(origin == 2, sizes[rows] / config.split_factor, sizes[rows])
    prune = _transparent(config, model)[rows] | useless[rows]
    if config.opacity_reset_every > 0 and model.step > config.opacity_reset_every:
        prune |= sizes_after > config.max_world_fraction * model.extent
        if config.max_screen_radius > 0:
            prune |= (radii[rows] > config.max_screen_radius) & (origin == 0)
    rows, origin = rows[~prune].astype(np.uint32), origin[~prune]
    return RowPlan(rows, origin > 0, _halves(config, model, rows, np.flatnonzero(origin == 2)), new_statistics=True)


def plan_pruning(config: DensityConfig, model: ModelState) -> RowPlan:
    """Prune the transparent and what hardly contributes, and nothing else."""
    rows = np.flatnonzero(~(_transparent(config, model) | _useless(config, model))).astype(np.uint32)
    return RowPlan(rows, np.zeros(len(rows), bool))


def _halves(
    config: DensityConfig, model: ModelState, rows: NDArray[np.uint32], halves: NDArray[np.intp]
) -> dict[str, tuple[NDArray[Any], Float32]]:
    """New means and log scales of the halves of what is split, which are some of `rows`."""
    if len(halves) == 0:
        return {}
    names = ("means", "quaternions", "log_scales")
    origins = {name: model.parameters[name].get()[rows[halves]] for name in names}
    means, log_scales = split_halves(config, **origins, rng=model.rng)
    return {"means": (halves, means), "log_scales": (halves, log_scales)}


def _transparent(config: DensityConfig, model: ModelState) -> NDArray[np.bool_]:
    logits = model.parameters["opacity_logits"].get()
    transparent: NDArray[np.bool_] = logits < np.log(config.min_opacity / (1 - config.min_opacity))
    return transparent


def _useless(config: DensityConfig, model: ModelState) -> NDArray[np.bool_]:
    """Gaussians that no view needs, and at the steps of `prune_at` a fraction of those whose use is known.

    Contributions are in pixels, and infinite where they are not known yet. Totals are over the views of the last whole
    epoch, the largest are of any view in that epoch and the one under way.
    """
    if "whole_totals" not in model.statistics:
        return np.zeros(model.count, bool)
    totals, whole, current = (
        model.statistics[name].get() for name in ("whole_totals", "whole_largest", "current_largest")
    )
    useless: NDArray[np.bool_] = (config.min_contribution > 0) & (np.maximum(current, whole) < config.min_contribution)
    if model.step in config.prune_at:
        known = np.flatnonzero(np.isfinite(totals))
        least = np.argsort(totals[known], kind="stable")[: int(config.prune_fraction * len(known))]
        useless[known[least]] = True
    return useless


def _wanted(
    config: DensityConfig, model: ModelState, gradients: Float32, useless: NDArray[np.bool_]
) -> NDArray[np.bool_]:
    """Gaussians to clone or split, by mean gradients (n,)."""
    room = config.max_gaussians - len(gradients)
    if config.growth == "budget":
        wanted = (gradients > 0) & ~useless
        room = budget(config, model.step, len(gradients)) - len(gradients)
    else:
        wanted = (gradients >= config.gradient_threshold) & ~useless
    if config.views_agree > 1 and "agreeing" in model.statistics:
        wanted &= model.statistics["agreeing"].get() >= config.views_agree
    if wanted.sum() > room:
        strongest = np.argsort(-np.where(wanted, gradients, -1), kind="stable")[: max(room, 0)]
        wanted = wanted & np.isin(np.arange(len(gradients)), strongest)
    return wanted


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


def split_halves(
    config: DensityConfig, *, means: Float32, quaternions: Float32, log_scales: Float32, rng: np.random.Generator
) -> tuple[Float32, Float32]:
    """Means and log scales of halves: drawn from the Gaussian they come from, and smaller. (m, 3), (m, 4), (m, 3)."""
    offsets = rng.standard_normal(means.shape) * np.exp(log_scales.astype(np.float64))
    q = quaternions.astype(np.float64)
    q /= np.maximum(np.linalg.norm(q, axis=1, keepdims=True), 1e-300)  # of length 0, which is not drawn: no rotation
    w, axis = q[:, :1], q[:, 1:]
    twice = 2 * np.cross(axis, offsets)
    rotated = offsets + w * twice + np.cross(axis, twice)
    smaller = log_scales - np.float32(np.log(config.split_factor))
    return (means + rotated).astype(np.float32), smaller.astype(np.float32)


def reset_opacities(config: DensityConfig, opacity_logits: Float32) -> Float32:
    """Opacities of at most `opacity_reset_to`."""
    ceiling = np.log(config.opacity_reset_to / (1 - config.opacity_reset_to))
    return np.minimum(opacity_logits, np.float32(ceiling))
