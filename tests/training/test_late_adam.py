# SPDX-License-Identifier: Apache-2.0
"""Late Adam in a training: hidden Gaussians take their missed steps before anyone needs them."""

from __future__ import annotations

from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest
from same_bytes import model_bytes
from test_shortcuts import with_one_behind
from tiny import cameras, run_steps, short

from clsplat.config.training import OptimiserConfig, TrainConfig
from clsplat.device.context import Device
from clsplat.errors import InputError
from clsplat.optimisation.missed_steps import MOST_MISSED
from clsplat.scenes.scene import Scene
from clsplat.training.trainer import Trainer

LATE = OptimiserConfig(late=True)


def hidden_after(scene: Scene, device: Device, steps: int, optimiser: OptimiserConfig) -> Trainer:
    """A training in which no view shows the last Gaussian, which has moments all the same."""
    config = short(iterations=1000, warmup=(), density={"every": 0}, optimiser=optimiser)
    trainer = Trainer(scene, config, device, with_one_behind(scene))
    for moments, value in ((trainer.model.first, 0.5), (trainer.model.second, 0.25)):
        array = moments["means"].get()
        array[-1] = value
        moments["means"].set(array)
    run_steps(steps, trainer)
    return trainer


@pytest.mark.parametrize("steps", [3, pytest.param(MOST_MISSED + 2, marks=pytest.mark.slow)])
def test_the_hidden_are_where_dense_adam_has_them(scene: Scene, default_device: Device, steps: int) -> None:
    dense = hidden_after(scene, default_device, steps, OptimiserConfig()).gaussians().means[-1]
    trainer = hidden_after(scene, default_device, steps, LATE)
    rested = trainer.parameters["means"].get()[-1]
    late = trainer.gaussians().means[-1]
    start = with_one_behind(scene).means[-1]
    assert np.all(np.abs(dense - start) > 1e-4)
    # Some roundings of a coordinate of 500: 3e-5 each in z, where each dense step rounds too.
    np.testing.assert_allclose(late, dense, atol=steps * 3.1e-5)
    np.testing.assert_allclose(late[:2], dense[:2], rtol=1e-4, atol=1e-7)  # x and y start at 0
    assert np.array_equal(rested, start) == (steps < MOST_MISSED), "it rests, at most for MOST_MISSED steps"


def test_a_look_changes_no_bit(scene: Scene, default_device: Device) -> None:
    trainer = hidden_after(scene, default_device, 3, LATE)
    before = {f"{kind} {g}": a.get() for kind, model in trainer.model.kinds().items() for g, a in model.arrays.items()}
    trainer.draw(cameras()[1])
    trainer.gaussians()
    after = {f"{kind} {g}": a.get() for kind, model in trainer.model.kinds().items() for g, a in model.arrays.items()}
    for name, array in before.items():
        np.testing.assert_array_equal(after[name], array)


def test_evaluation_on_the_way_changes_nothing(scene: Scene, default_device: Device, tmp_path: Path) -> None:
    config = replace(short(), optimiser=replace(short().optimiser, late=True))
    looked = replace(config, eval_at=(3, 15, 16), checkpoint_every=6)
    undisturbed = model_bytes(scene, config, default_device, tmp_path / "undisturbed")
    assert model_bytes(scene, looked, default_device, tmp_path / "looked") == undisturbed


@pytest.mark.parametrize(
    ("config", "message"),
    [
        (TrainConfig(optimiser=OptimiserConfig(late=True, sparse=True)), "excludes --optimiser.sparse"),
        (TrainConfig(optimiser=OptimiserConfig(late=True, beta2=0.5)), "beta1^2 < beta2"),
        (TrainConfig(optimiser=LATE, batch=2), "not supported with --batch 2"),
    ],
)
def test_what_excludes_it(config: TrainConfig, message: str) -> None:
    with pytest.raises(InputError) as error:
        config.check()
    assert message in str(error.value)
