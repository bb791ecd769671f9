# SPDX-License-Identifier: Apache-2.0
"""Density control as sampling: who moves where, and that it repeats to the last byte however training is done."""

from __future__ import annotations

from dataclasses import replace
from itertools import pairwise
from math import comb
from pathlib import Path

import numpy as np
import pytest
from compare import assert_same_bits
from tiny import short, trained_to

from clsplat.api import train
from clsplat.arrays import Float32
from clsplat.config.training import DensityConfig, OptimiserConfig, TrainConfig
from clsplat.device.context import Device
from clsplat.errors import ClsplatError
from clsplat.gaussians import PARAMETER_GROUPS
from clsplat.optimisation.step_noise import exploration_of
from clsplat.runs.run import Run
from clsplat.scenes.scene import Scene
from clsplat.training.density import SPLIT_GROUPS, RowPlan
from clsplat.training.density.adaptive import long_halves
from clsplat.training.density.mcmc import MAX_GAUSSIANS_PER_PLACE, Mcmc, draw, last_growth, shared, strongest, wanted
from clsplat.training.trainer import Trainer

GROWN = 150
CONFIG = short(
    iterations=48, density={"growth": "mcmc", "max_gaussians": GROWN, "min_opacity": 0.03, "max_screen_radius": 30.0}
)
"""Gaussians move and are added after steps 15, 20, ... 35, and there is noise in all steps."""


# The policy


@pytest.mark.parametrize("opacity", [0.006, 0.1, 0.5, 0.99, 1 - 1e-7])
@pytest.mark.parametrize("number", [1, 2, 3, 10, MAX_GAUSSIANS_PER_PLACE])
def test_shares_of_opacity_and_scale(opacity: float, number: int) -> None:
    """The published double sum, and as much of the light that passes."""
    parts, by = shared(np.array([opacity]), np.array([number]), 1e-9)
    assert (1 - parts[0]) ** number == pytest.approx(1 - opacity, rel=1e-6)
    double = sum(
        comb(i - 1, k) * (-1) ** k * parts[0] ** (k + 1) / np.sqrt(k + 1)
        for i in range(1, number + 1)
        for k in range(i)
    )
    assert np.exp(by[0]) == pytest.approx(opacity / double, rel=1e-9)


def test_draws_follow_the_weights() -> None:
    weights = np.array([0.0, 1.0, 0.0, 3.0, 4.0, 0.0])
    found = np.bincount(draw(weights, 80_000, np.random.default_rng(2)), minlength=6) / 10_000
    assert not found[weights == 0].any()
    np.testing.assert_allclose(found, weights, atol=0.1)


def test_growth_reaches_the_cap_at_its_last_step() -> None:
    config = DensityConfig(growth="mcmc", max_gaussians=9000, start=500, stop=2501, every=100)
    count, counts = 1000, {}
    for step in range(600, 2501, 100):
        count = counts[step] = wanted(config, step, count)
    assert counts[2500] == 9000
    assert wanted(config, 600, 9500) == 9500
    parts = [b / a for a, b in pairwise(counts.values())]
    assert max(parts) == pytest.approx(min(parts), rel=2e-3), "by the same part each time, but for rounding"


def test_the_strongest_are_those_with_the_largest_scores() -> None:
    scores = np.array([0.5, -1.0, 2.0, 0.0, 2.0, 1.0], np.float32)
    assert strongest(scores, 3).tolist() == [2, 4, 5]
    assert strongest(scores, 1).tolist() == [2]
    assert strongest(scores, 9).tolist() == [0, 2, 4, 5], "nothing without a gradient"


def begun(scene: Scene, device: Device, config: TrainConfig) -> Trainer:
    """A training of 15 steps, in which five Gaussians died: four transparent, and one too large on the screen."""
    trainer = trained_to(15, scene, config, device)
    logits = trainer.parameters["opacity_logits"].get()
    logits[:4], logits[4:] = -6.0, np.maximum(logits[4:], -2.0)
    trainer.parameters["opacity_logits"].set(logits)
    radii = np.zeros(trainer.parameters.count, np.float32)
    radii[7] = 31.0
    trainer.statistics.radii.set(radii)
    return trainer


GONE = np.array([0, 1, 2, 3, 7])
"""Rows of these five."""


def planned(trainer: Trainer) -> tuple[RowPlan, dict[str, dict[str, Float32]], dict[str, dict[str, Float32]]]:
    """The plan, and all models' groups before and after it. What is not fresh keeps its moments, the rest has none."""

    def looked_at() -> dict[str, dict[str, Float32]]:
        return {
            kind: {group: model[group].get() for group in PARAMETER_GROUPS}
            for kind, model in trainer.model.kinds().items()
        }

    before = looked_at()
    plan = trainer.strategy.before_step(trainer._state())
    trainer._rearrange(plan)
    after = looked_at()
    for group in ("quaternions", "sh_dc", "sh_rest"):
        assert_same_bits(after["parameters"][group], before["parameters"][group][plan.rows], group)
    same = np.flatnonzero(~plan.fresh)
    for kind in ("first", "second"):
        for group in PARAMETER_GROUPS:
            assert not after[kind][group][plan.fresh].any()
            assert_same_bits(after[kind][group][same], before[kind][group][same], group)
    assert not trainer.statistics.radii.get().any()
    return plan, before, after


def test_halves_of_the_strongest_take_the_rows_of_the_dead_and_new_ones(scene: Scene, default_device: Device) -> None:
    trainer = begun(scene, default_device, CONFIG)
    count = trainer.parameters.count
    sums, seen = trainer.statistics.gradient_sums.get(), trainer.statistics.seen.get()
    plan, before, after = planned(trainer)
    assert plan.rows is not None
    assert plan.fresh is not None
    assert count < len(plan.rows) == trainer.parameters.count <= GROWN
    second = np.concatenate([GONE, np.arange(count, len(plan.rows))])
    split = plan.rows[second]
    stay = np.setdiff1d(np.arange(count), GONE)
    assert_same_bits(plan.rows[stay], stay.astype(np.uint32), "rows")
    assert len(np.unique(split)) == len(split), "each is halved once"
    scores = sums / np.maximum(seen, 1)
    assert sorted(scores[split]) == sorted(np.sort(scores[stay])[-len(split) :])
    assert_same_bits(np.flatnonzero(plan.fresh), np.sort(np.concatenate([split.astype(np.int64), second])), "fresh")
    of_split = {group: before["parameters"][group][split] for group in (*SPLIT_GROUPS, "opacity_logits")}
    sides = [long_halves(of_split, later) for later in (False, True)]
    halves = {group: np.concatenate([side[group] for side in sides]) for group in sides[0]}
    for group, values in halves.items():
        assert_same_bits(after["parameters"][group][np.concatenate([split, second])], values, group)
        whole = np.setdiff1d(stay, split)
        assert_same_bits(after["parameters"][group][whole], before["parameters"][group][whole], group)


@pytest.mark.parametrize("spread", [0.0, 0.5])
def test_without_gradients_the_dead_move_to_the_opaque(scene: Scene, default_device: Device, spread: float) -> None:
    config = replace(CONFIG, density=replace(CONFIG.density, spread=spread))
    trainer = begun(scene, default_device, config)
    trainer.statistics.gradient_sums.fill(0.0)
    plan, before, after = planned(trainer)
    assert plan.rows is not None
    assert plan.fresh is not None
    assert len(plan.rows) == trainer.parameters.count == len(before["parameters"]["means"]), "nothing to grow from"
    assert plan.fresh[GONE].all()
    assert not np.isin(plan.rows, GONE).any()
    offsets = after["parameters"]["means"] - before["parameters"]["means"][plan.rows]
    assert not np.delete(offsets, GONE, axis=0).any()
    away = np.linalg.norm(offsets[GONE], axis=1) / np.exp(after["parameters"]["log_scales"][GONE].max(axis=1))
    assert away.all() == (spread > 0)
    assert away.max() < 4.5 * spread + 1e-9
    opacity = 1 / (1 + np.exp(-after["parameters"]["opacity_logits"].astype(np.float64)))
    old = 1 / (1 + np.exp(-before["parameters"]["opacity_logits"].astype(np.float64)))
    checked = 0
    for parent in np.unique(plan.rows[GONE]):
        shares = opacity[plan.rows == parent]
        if shares.min() > 1.001 * config.density.min_opacity:  # no share is less
            # all that shares a place lets as much light pass as the one did
            assert np.prod(1 - shares) == pytest.approx(1 - old[parent], rel=1e-5)
            checked += 1
    assert checked > 1


def test_few_with_gradients_are_halved_and_the_rest_of_the_dead_move(scene: Scene, default_device: Device) -> None:
    trainer = begun(scene, default_device, CONFIG)
    sums = np.zeros(trainer.parameters.count, np.float32)
    sums[[2, 9, 11]] = 1.0
    trainer.statistics.gradient_sums.set(sums)
    plan, _, _ = planned(trainer)
    assert plan.rows is not None
    assert len(plan.rows) == len(sums)
    assert plan.rows[[0, 1]].tolist() == [9, 11], "not the dead one"
    assert not np.isin(plan.rows[GONE], GONE).any()


def test_gradients_are_gathered_as_long_as_it_grows() -> None:
    strategy, last = Mcmc(CONFIG), last_growth(CONFIG.density)
    assert strategy.is_due(last)
    assert wanted(CONFIG.density, last, 3) == GROWN
    assert not any(strategy.is_due(step) for step in range(last + 1, CONFIG.iterations))
    steps = (0, 1, last, CONFIG.density.stop, CONFIG.iterations)
    assert [strategy.needs(step).gradients for step in steps] == [True, True, True, False, False]


def test_nothing_alive_stops_it(scene: Scene, default_device: Device) -> None:
    trainer = Trainer(scene, CONFIG, default_device)
    trainer.parameters["opacity_logits"].fill(-9.0)
    with pytest.raises(ClsplatError, match=r"every Gaussian is dead: under --density\.min-opacity 0\.03"):
        trainer.strategy.before_step(trainer._state(15))


def test_no_noise_in_the_cooldown_and_none_in_other_units() -> None:
    config = replace(CONFIG, optimiser=OptimiserConfig(cooldown=8))
    amounts = {step: exploration_of(config, step, 2e-3, 100, 5.0).amount for step in (1, 40, 41, 48)}
    assert amounts == {1: 5e5 * 2e-3 / 25, 40: 5e5 * 2e-3 / 25, 41: 0.0, 48: 0.0}
    assert exploration_of(config, 1, 2e-3, 100, 5.0).key != exploration_of(config, 2, 2e-3, 100, 5.0).key
    larger = exploration_of(config, 1, 20e-3, 100, 50.0)
    assert larger.amount * 10**2 == pytest.approx(10 * amounts[1]), "ten times as far where all is ten times as large"
    assert larger.scale * 10 == pytest.approx(exploration_of(config, 1, 2e-3, 100, 5.0).scale)


# Training


def test_it_grows_learns_and_leaves_nothing_undrawn(scene: Scene, default_device: Device, tmp_path: Path) -> None:
    config = replace(CONFIG, iterations=120, density=replace(CONFIG.density, min_opacity=0.005, opacity_weight=3.0))
    counts: list[int] = []
    run = Run.create(tmp_path / "run", config)
    model = train(scene, config, device=default_device, run=run, on_step=lambda report: counts.append(report.gaussians))
    assert counts[-1] == GROWN
    assert len(model) <= GROWN
    assert (1 / (1 + np.exp(-model.opacity_logits.astype(np.float64))) > 1 / 255).all()
    trainer = Trainer(scene, config, default_device)
    trainer.parameters["opacity_logits"].set(np.linspace(-9, 3, trainer.parameters.count, dtype=np.float32))
    trainer.finish()
    kept = trainer.gaussians().opacity_logits
    assert 0 < len(kept) < len(scene.points)
    assert kept.min() > -5.54
