# SPDX-License-Identifier: Apache-2.0
"""The one function of a view's gradient: a trainer's step is it, and a probe sees each stage before Adam."""

from __future__ import annotations

import numpy as np
import pytest
from compare import assert_same_bits

from clsplat.config.training import TrainConfig
from clsplat.device.context import Device
from clsplat.gaussians import PARAMETER_GROUPS
from clsplat.rendering.rasterizer import ForwardPass, Rasterizer
from clsplat.scenes.scene import Scene
from clsplat.stages.device_gaussians import allocate_gaussians
from clsplat.stages.loss import Loss
from clsplat.stages.project import Slots
from clsplat.training.step.gradient_step import GradientStep, StepProbe, slot_fields
from clsplat.training.step.inputs import StepRows, ViewInputs
from clsplat.training.trainer import Trainer

CONFIG = TrainConfig(iterations=9, warmup=(), sh_degree=1)


class Witness(StepProbe):
    """Notes the order of the stages, and the model as Adam finds it."""

    def __init__(self) -> None:
        self.stages: list[str] = []

    def forward(self, frame: ForwardPass) -> None:
        del frame
        self.stages.append("forward")

    def loss(self, result: Loss) -> None:
        del result
        self.stages.append("loss")

    def pair_gradients(self, slots: Slots) -> None:
        del slots
        self.stages.append("pair_gradients")

    def before_rows(self, rows: StepRows) -> None:
        self.stages.append("before_rows")
        if rows.gradients is not None:
            self.gradients = {group: rows.gradients[group].get() for group in PARAMETER_GROUPS}
        self.means, self.first = rows.parameters["means"].get(), rows.model[1]["means"].get()

    def after_rows(self, rows: StepRows) -> None:
        self.stages.append("after_rows")
        self.screen = rows.screen.gradients.get()


@pytest.mark.parametrize("looks", [False, True])
def test_a_trainer_s_step_is_a_gradient_step(scene: Scene, default_device: Device, looks: bool) -> None:
    """With the gradients in memory, to be looked at, and without."""
    trainer, by_hand = (Trainer(scene, CONFIG, default_device) for _ in range(2))
    before = by_hand.parameters["means"].get()
    view = int(np.random.default_rng(CONFIG.seed).permutation(len(trainer.views))[-1])
    trainer.train_step()
    by_hand.position.step = 1
    step = GradientStep(
        default_device, Rasterizer(default_device), CONFIG, 1, by_hand.rates(), slot_fields(by_hand.strategy.needs(1))
    )
    model = by_hand.model.with_moments
    size = (by_hand.parameters.count, by_hand.parameters.coefficients)
    gradients = allocate_gaussians(default_device, *size, zero=True) if looks else None
    photograph, witness = by_hand.photographs.load(view, 1.0), Witness()
    background = np.zeros(3, np.float32)
    camera = by_hand.local(by_hand.views[view].camera)
    result = step.run(model, ViewInputs(view, photograph, camera, background), witness, gradients)
    assert witness.stages == ["forward", "loss", "pair_gradients", "before_rows", "after_rows"]
    assert_same_bits(witness.means, before, "Adam comes after the probe")
    assert not witness.first.any()
    assert witness.screen.any()
    assert np.isfinite(result.read()).all()
    for kind in ("parameters", "first", "second"):
        for group in PARAMETER_GROUPS:
            got, wanted = getattr(by_hand.model, kind)[group].get(), getattr(trainer.model, kind)[group].get()
            assert_same_bits(got, wanted, f"{kind} {group}")
    if gradients is not None:
        assert witness.gradients["means"].any()
        assert all(not gradients[group].get().any() for group in PARAMETER_GROUPS), "Adam leaves them zero"
