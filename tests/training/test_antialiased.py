# SPDX-License-Identifier: Apache-2.0
"""Training with --antialiased: scales that the pictures show. test_by_rays.py has the files that say so."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
import pytest
from calls import noted
from tiny import CONFIG, run_steps

from clsplat.device.context import Device
from clsplat.reference.sampling import sampling_limits
from clsplat.scenes.scene import Scene
from clsplat.training.step import mip_filter
from clsplat.training.step.mip_filter import MipFilter
from clsplat.training.trainer import Trainer

SMOOTH = replace(CONFIG, antialiased=True)


def test_no_scale_is_less_than_the_pictures_show(scene: Scene, default_device: Device) -> None:
    trainer = Trainer(scene, replace(SMOOTH, density=replace(SMOOTH.density, every=0)), default_device)
    start = trainer.gaussians().means.astype(np.float64)
    run_steps(30, trainer)
    model = trainer.gaussians()
    cameras = [trainer.local(view.camera) for view in trainer.views]
    limits = sampling_limits(start, cameras)  # they were worked out once, before the first step
    assert np.isfinite(limits).any()
    assert (model.log_scales >= limits[:, None] - 1e-4).all()
    assert model.antialiased


@pytest.mark.parametrize("views", [1, 2, 3, 8])
def test_the_cameras_are_looked_at_every_hundred_steps(
    views: int, scene: Scene, default_device: Device, monkeypatch: pytest.MonkeyPatch
) -> None:
    looked: list[int] = []
    monkeypatch.setattr(mip_filter, "SAMPLING_LIMIT_INTERVAL_STEPS", 12)
    noted(monkeypatch, MipFilter, "before_step", lambda *_: looked.append(trainer.step))
    config = replace(SMOOTH, density=replace(SMOOTH.density, every=0), batch=views, iterations=48)
    trainer = Trainer(scene, config, default_device)
    while trainer.step < 48:
        trainer.train_step()
    assert [(step - 1) // 12 for step in looked] == [0, 1, 2, 3]
