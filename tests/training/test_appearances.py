# SPDX-License-Identifier: Apache-2.0
"""Appearances of photographs: trainings with them repeat to the last byte however they are done."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
import pytest
from compare import assert_same_bits
from tiny import CONFIG, run_steps

from clsplat.config.training import TrainConfig
from clsplat.device.context import Device, open_devices
from clsplat.errors import DeviceError
from clsplat.runs.checkpoints import Checkpoint
from clsplat.scenes.scene import Scene
from clsplat.training.trainer import Trainer

LEARNT = {"exposure": "appearance/logs", "ppisp": "appearance/lenses_logs", "grid": "appearance/first"}
"""An array of each kind's checkpoint that is 0 before anything is learnt."""


@pytest.fixture(params=LEARNT)
def config(request: pytest.FixtureRequest) -> TrainConfig:
    return replace(CONFIG, appearance=request.param)


def state(trainer: Trainer, steps: int = 24) -> dict[str, np.ndarray]:
    """All that a training has after so many steps."""
    run_steps(steps, trainer)
    arrays = trainer.checkpoint()[0]
    assert arrays[LEARNT[trainer.config.appearance]].any()
    trainer.close()
    return arrays


def assert_same_state(got: dict[str, np.ndarray], wanted: dict[str, np.ndarray]) -> None:
    assert got.keys() == wanted.keys()
    for name, array in wanted.items():
        assert_same_bits(got[name], array, name)


def test_a_resumed_training_has_the_same_bytes(default_device: Device, scene: Scene, config: TrainConfig) -> None:
    first, second = (Trainer(scene, config, default_device) for _ in range(2))
    run_steps(9, first)
    second.restore(Checkpoint(9, *first.checkpoint()))
    assert_same_state(state(second, 11), state(Trainer(scene, config, default_device), 20))


def test_by_capacity_the_bytes_are_the_same(
    default_device: Device, scene: Scene, config: TrainConfig, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setenv("CLSPLAT_BY_CAPACITY", "0")
    wanted = state(Trainer(scene, config, default_device))
    monkeypatch.setenv("CLSPLAT_BY_CAPACITY", "1")
    for stopped in (False, True):
        trainer = Trainer(scene, config, default_device)
        if stopped:  # each time when the room is too small: such a step is made again
            room = trainer.pending.room
            monkeypatch.setattr(trainer.pending, "room", lambda *a, room=room: min(room(*a), 1024))
        assert_same_state(state(trainer), wanted)


@pytest.mark.slow
@pytest.mark.parametrize("batch", [2, 3])
def test_the_number_of_devices_changes_no_byte(
    default_device: Device, scene: Scene, config: TrainConfig, batch: int
) -> None:
    config = replace(config, batch=batch)
    wanted = state(Trainer(scene, config, default_device), 10)
    try:
        devices = open_devices(",".join(f"{default_device.index}/{half}" for half in range(2)))
    except DeviceError as error:
        pytest.skip(str(error))
    assert_same_state(state(Trainer(scene, config, devices[0], further=devices[1:]), 10), wanted)
