# SPDX-License-Identifier: Apache-2.0
"""Adaptive density control (Kerbl et al. 2023, section 5): what to clone, split and prune. Policy only: no device."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass
from typing import Any

import numpy as np
from numpy.typing import NDArray

from clsplat.arrays import Float32
from clsplat.config.training import DensityConfig, TrainConfig
from clsplat.errors import ClsplatError
from clsplat.training.density import HostCopy, ModelState, RowPlan, StatisticsNeeds, Strategy


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
        config, step, statistics = self.config, model.step, model.statistics
        logits = model.parameters["opacity_logits"].get()
        known: dict[str, Any] = {"opacity_logits": logits, "contributions": _contributions(statistics)}
        chosen: Plan | None = None
        densifies = is_due(config, step)
        if densifies:
            names = ("gradient_sums", "seen", "radii", "agreeing")
            known |= {name: statistics[name].get() for name in names if name in statistics}
            chosen = plan(config, step, model.extent, log_scales=model.parameters["log_scales"].get(), **known)
        elif is_pruning_due(config, step):
            chosen = plan_pruning(config, step, **known)
        values = {}
        if chosen is not None:
            if len(chosen.rows) == 0:
                raise ClsplatError(
                    f"step {step}: every Gaussian was pruned; lower --density.min-opacity"
                    + (" or --density.min-contribution" if config.min_contribution > 0 else "")
                )
            logits, values = logits[chosen.rows], _halves(config, chosen, model)
        if resets := is_reset_due(config, step, white=self.white):
            values["opacity_logits"] = np.arange(len(logits)), reset_opacities(config, logits)
        return RowPlan(
            rows=chosen.rows if chosen is not None else None,
            fresh=chosen.fresh if chosen is not None else None,
            values=values,
            restarted=("opacity_logits",) if resets else (),
            new_statistics=densifies,
            forget_contributions=resets,
        )


def _contributions(statistics: Mapping[str, HostCopy]) -> Contributions | None:
    if "whole_totals" not in statistics:
        return None
    largest = (statistics[f"{epoch}_largest"].get() for epoch in ("current", "whole"))
    return Contributions(statistics["whole_totals"].get(), np.maximum(*largest))


def _halves(config: DensityConfig, chosen: Plan, model: ModelState) -> dict[str, tuple[NDArray[Any], Float32]]:
    """Rows of the halves of what is split, and their means and log scales."""
    halves = np.flatnonzero(chosen.split)
    if len(halves) == 0:
        return {}
    names = ("means", "quaternions", "log_scales")
    origins = {name: model.parameters[name].get()[chosen.rows[halves]] for name in names}
    means, log_scales = split_halves(config, **origins, rng=model.rng)
    return {"means": (halves, means), "log_scales": (halves, log_scales)}


@dataclass(frozen=True, eq=False)
class Plan:
    """The Gaussians after density control.

    rows (m,) uint32: which Gaussian each comes from, kept ones first and in order; fresh (m,) bool: clones and halves
    of splits, whose moments start at zero; split (m,) bool: halves, to be moved and shrunk.
    """

    rows: NDArray[np.uint32]
    fresh: NDArray[np.bool_]
    split: NDArray[np.bool_]


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


@dataclass(frozen=True, eq=False)
class Contributions:
    """Contributions of each Gaussian to the pictures, in pixels; (n,), infinite where they are not known yet.

    totals: over the views of the last whole epoch; largest: of any view in that epoch and the one under way.
    """

    totals: Float32
    largest: Float32


def plan(
    config: DensityConfig,
    step: int,
    extent: float,
    *,
    gradient_sums: Float32,
    seen: Float32,
    radii: Float32,
    log_scales: Float32,
    opacity_logits: Float32,
    agreeing: Float32 | None = None,
    contributions: Contributions | None = None,
) -> Plan:
    """Clone the small and split the large among those with a large mean gradient; prune the transparent, the oversized
    and what hardly contributes.

    gradient_sums, seen, radii, opacity_logits (n,); log_scales (n, 3); extent: the scene's, in world units; agreeing
    (n,): views over the threshold, where the settings ask for it; contributions: likewise.
    """
    n = len(seen)
    useless = _useless(config, step, contributions, n)
    with np.errstate(invalid="ignore"):
        gradients = np.asarray(gradient_sums / np.maximum(seen, 1), np.float32)
    gradients[~np.isfinite(gradients)] = 0  # statistics that something has spoilt ask for nothing
    wanted = _wanted(config, step, gradients, agreeing, useless)
    sizes = np.exp(log_scales.max(axis=1))
    large = sizes > config.dense_fraction * extent
    to_clone, to_split = np.flatnonzero(wanted & ~large), np.flatnonzero(wanted & large)
    kept = np.flatnonzero(~(wanted & large))

    rows = np.concatenate([kept, to_clone, to_split, to_split])
    origin = np.repeat([0, 1, 2], [len(kept), len(to_clone), 2 * len(to_split)])
    sizes_after = np.where(origin == 2, sizes[rows] / config.split_factor, sizes[rows])
    prune = _transparent(config, opacity_logits)[rows] | useless[rows]
    if config.opacity_reset_every > 0 and step > config.opacity_reset_every:
        prune |= sizes_after > config.max_world_fraction * extent
        if config.max_screen_radius > 0:
            prune |= (radii[rows] > config.max_screen_radius) & (origin == 0)
    rows, origin = rows[~prune], origin[~prune]
    return Plan(rows.astype(np.uint32), origin > 0, origin == 2)


def plan_pruning(
    config: DensityConfig, step: int, *, opacity_logits: Float32, contributions: Contributions | None = None
) -> Plan:
    """Prune the transparent and what hardly contributes, and nothing else; arguments as of `plan`."""
    gone = _transparent(config, opacity_logits) | _useless(config, step, contributions, len(opacity_logits))
    rows = np.flatnonzero(~gone).astype(np.uint32)
    none = np.zeros(len(rows), bool)
    return Plan(rows, none, none)


def _transparent(config: DensityConfig, opacity_logits: Float32) -> NDArray[np.bool_]:
    transparent: NDArray[np.bool_] = opacity_logits < np.log(config.min_opacity / (1 - config.min_opacity))
    return transparent


def _useless(config: DensityConfig, step: int, contributions: Contributions | None, count: int) -> NDArray[np.bool_]:
    """Gaussians that no view needs, and at the steps of `prune_at` a fraction of those whose use is known."""
    useless = np.zeros(count, bool)
    if contributions is None:
        return useless
    if config.min_contribution > 0:
        useless |= contributions.largest < config.min_contribution
    if step in config.prune_at:
        known = np.flatnonzero(np.isfinite(contributions.totals))
        least = np.argsort(contributions.totals[known], kind="stable")[: int(config.prune_fraction * len(known))]
        useless[known[least]] = True
    return useless


def _wanted(
    config: DensityConfig,
    step: int,
    gradients: Float32,
    agreeing: Float32 | None,
    useless: NDArray[np.bool_],
) -> NDArray[np.bool_]:
    """Gaussians to clone or split, by mean gradients (n,)."""
    n = len(gradients)
    room = config.max_gaussians - n
    if config.growth == "budget":
        wanted = (gradients > 0) & ~useless
        room = budget(config, step, n) - n
    else:
        wanted = (gradients >= config.gradient_threshold) & ~useless
    if config.views_agree > 1 and agreeing is not None:
        wanted &= agreeing >= config.views_agree
    if wanted.sum() > room:
        strongest = np.argsort(-np.where(wanted, gradients, -1), kind="stable")[: max(room, 0)]
        allowed = np.zeros(n, bool)
        allowed[strongest] = True
        wanted &= allowed
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
