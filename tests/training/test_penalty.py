# SPDX-License-Identifier: Apache-2.0
"""Penalties on opacity and size without MCMC: what they do to a model, and the same bytes again."""

from __future__ import annotations

from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest
from calls import refuses
from compare import assert_same_bits
from same_bytes import model_bytes
from tiny import short, trained_to

from clsplat.config.training import DensityConfig, TrainConfig
from clsplat.device.context import Device
from clsplat.gaussians import Gaussians
from clsplat.optimisation.step_noise import NO_EXPLORATION, Exploration, exploration_of
from clsplat.scenes.scene import Scene
from clsplat.training.density import StatisticsNeeds, Strategy
from clsplat.training.density.choice import strategy_of

CONFIG = replace(short(iterations=40), penalty=0.5)
"""With a penalty so large that a short training shows it."""


def test_weights_are_shares_of_the_means() -> None:
    """The same in any unit of length, and whatever the number of Gaussians; none without the setting."""
    wanted = Exploration(opacity=0.5 / 100, scale=0.5 / (3 * 100 * 4.0))
    assert exploration_of(CONFIG, 7, 1e-3, 100, 4.0) == wanted
    assert not wanted.amount and wanted.weights, "no noise"
    assert exploration_of(replace(CONFIG, penalty=0.0), 7, 1e-3, 100, 4.0) == NO_EXPLORATION
    assert NO_EXPLORATION.weights == ()


def test_the_model_is_fainter_and_its_gaussians_smaller(scene: Scene, default_device: Device, tmp_path: Path) -> None:
    still = replace(CONFIG, density=DensityConfig(every=0))  # the same Gaussians in both
    means = []
    for penalty in (0.0, 0.5):
        model_bytes(scene, replace(still, penalty=penalty), default_device, tmp_path / str(penalty))
        model = Gaussians.load(tmp_path / str(penalty) / "model.ply")
        opacities = 1 / (1 + np.exp(-model.opacity_logits.astype(np.float64)))
        means.append((len(model), opacities.mean(), np.exp(model.log_scales.astype(np.float64)).mean()))
    (count, opacity, scale), (same, fainter, smaller) = means
    assert same == count
    assert fainter < 0.98 * opacity
    assert smaller < 0.98 * scale


class Still(Strategy):
    """A user's own strategy, which leaves the model's rows alone."""

    def __init__(self, config: TrainConfig) -> None:
        del config

    def needs(self, step: int = 0) -> StatisticsNeeds:
        del step
        return StatisticsNeeds()

    def is_due(self, step: int) -> bool:
        del step
        return False


def test_a_strategy_of_your_own_keeps_the_penalty(scene: Scene, default_device: Device) -> None:
    """The bits of the paper's strategy without densification, which has the penalty too."""
    still = replace(CONFIG, density=DensityConfig(every=0))
    models = []
    for penalty, strategy in ((0.5, strategy_of), (0.5, Still), (0.0, Still)):
        trainer = trained_to(12, scene, replace(still, penalty=penalty), default_device, strategy=strategy)
        models.append(trainer.gaussians().arrays())
    wanted, own, without = models
    for name, values in wanted.items():
        assert_same_bits(own[name], values, name)
    for name in ("opacity_logits", "log_scales"):
        assert (own[name] < without[name]).mean() > 0.5, name


@pytest.mark.parametrize(
    ("config", "message"),
    [
        (TrainConfig(penalty=-0.1), "--penalty -0.1: expected a finite number, at least 0"),
        (TrainConfig(penalty=0.01, density=DensityConfig(growth="mcmc", max_gaussians=100)),
         "--penalty 0.01: --density.growth mcmc has weights of its own"),
    ],
)  # fmt: skip
def test_penalties_that_make_no_sense(config: TrainConfig, message: str) -> None:
    refuses(message, config.check)
