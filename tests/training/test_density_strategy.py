# SPDX-License-Identifier: Apache-2.0
"""The seam of density control: a second strategy, which the trainer has never heard of, decides about every row."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import replace
from typing import Any

import numpy as np
from compare import assert_same_bits
from numpy.typing import NDArray
from test_trainer import host
from tiny import run_steps, trained_to

from clsplat.config.training import TrainConfig
from clsplat.device.context import Device
from clsplat.gaussians import PARAMETER_GROUPS
from clsplat.runs.checkpoints import Checkpoint
from clsplat.scenes.scene import Scene
from clsplat.training.density import ModelState, RowPlan, StatisticsNeeds, Strategy
from clsplat.training.trainer import Trainer

CONFIG = TrainConfig(iterations=9, warmup=(), sh_degree=1, sh_degree_every=100)
DUE = 4


class Juggler(Strategy):
    """Once: drop row 0, copy row 1 as a fresh row at the end, move that and reset what rotations have learnt. After
    every step: note how far it was, and from step 6 on darken row 2."""

    def __init__(self, config: TrainConfig) -> None:
        assert config is CONFIG
        self.ages = np.zeros(0, np.float32)
        self.seen: list[float] = []

    def needs(self, step: int = 0) -> StatisticsNeeds:
        del step
        return StatisticsNeeds(gradients=True)

    def is_due(self, step: int) -> bool:
        return step == DUE

    def before_step(self, model: ModelState) -> RowPlan:
        self.seen.append(float(model.statistics["seen"].get().sum()))
        count = len(model.parameters["means"].get())
        rows = np.append(np.arange(1, count), 1).astype(np.uint32)
        place = model.rng.random((1, 3), dtype=np.float32)
        return RowPlan(
            rows=rows,
            fresh=np.arange(count) == count - 1,
            values={"means": (np.array([count - 1]), place)},
            restarted=("quaternions",),
            new_statistics=True,
        )

    def after_gradient(self, model: ModelState) -> RowPlan | None:
        self.ages = (self.ages if len(self.ages) else np.zeros(len(model.parameters["means"].get()), np.float32)) + 1
        if model.step < 6:
            return None
        dark = model.parameters["opacity_logits"].get()[[2]] - 1
        return RowPlan(values={"opacity_logits": (np.array([2]), dark)})

    def rearranged(self, rows: NDArray[np.uint32], fresh: NDArray[np.bool_]) -> None:
        self.ages = np.where(fresh, 0, self.ages[rows]).astype(np.float32)

    def arrays(self) -> dict[str, NDArray[Any]]:
        return {"ages": self.ages}

    def load(self, arrays: Mapping[str, NDArray[Any]]) -> None:
        self.ages = arrays["ages"]


def trained(scene: Scene, device: Device, steps: int) -> tuple[Trainer, Juggler]:
    trainer = trained_to(steps, scene, CONFIG, device, strategy=Juggler)
    assert isinstance(trainer.strategy, Juggler)
    return trainer, trainer.strategy


def test_rows_follow_the_plan_of_any_strategy(scene: Scene, default_device: Device) -> None:
    trainer, juggler = trained(scene, default_device, DUE)
    before = {kind: host(model) for kind, model in trainer.model.kinds().items()}
    place = np.random.default_rng()
    place.bit_generator.state = trainer.position.rng.bit_generator.state
    trainer._control_density()
    assert juggler.seen[0] > 0, "it has seen the statistics"
    assert not trainer.statistics.seen.get().any(), "which start again"
    for kind, groups in before.items():
        after = host(trainer.model.kinds()[kind])
        for group, values in groups.items():
            wanted = np.concatenate([values[1:], values[1:2]])
            if kind == "parameters" and group == "means":
                wanted[-1] = place.random(3, dtype=np.float32)
            elif kind != "parameters":
                wanted[slice(None) if group == "quaternions" else -1] = 0
            assert_same_bits(after[group], wanted, f"{kind} {group}")
    count = len(before["parameters"]["means"])
    assert juggler.ages.tolist() == [DUE] * (count - 1) + [0]


def test_a_plan_after_the_gradient_changes_values_alone(scene: Scene, default_device: Device) -> None:
    plain, _ = trained(scene, default_device, 5)
    before, moments = host(plain.parameters), host(plain.model.first)
    plain._rearrange(plain.strategy.after_gradient(replace(plain._state(), step=6)))
    after = host(plain.parameters)
    before["opacity_logits"][2] -= 1
    for group in PARAMETER_GROUPS:
        assert_same_bits(after[group], before[group], group)
        assert_same_bits(plain.model.first[group].get(), moments[group], group)


def test_its_state_is_in_the_checkpoint(scene: Scene, default_device: Device) -> None:
    whole, juggler = trained(scene, default_device, 8)
    first, _ = trained(scene, default_device, 6)
    arrays, state = first.checkpoint()
    assert "strategy/ages" in arrays
    again = Trainer(scene, CONFIG, default_device, strategy=Juggler)
    again.restore(Checkpoint(6, arrays, state))
    run_steps(2, again)
    assert isinstance(again.strategy, Juggler)
    assert_same_bits(again.strategy.ages, juggler.ages)
    for group in PARAMETER_GROUPS:
        assert_same_bits(again.parameters[group].get(), whole.parameters[group].get(), group)


def test_the_strategy_of_a_run_has_no_arrays_of_its_own(scene: Scene, default_device: Device) -> None:
    """The names in a checkpoint are those of every version."""
    trainer = Trainer(scene, CONFIG, default_device)
    arrays, _ = trainer.checkpoint()
    kinds = {name.split("/")[0] for name in arrays}
    assert kinds == {"statistics", "parameters", "first", "second"}
