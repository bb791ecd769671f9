# SPDX-License-Identifier: Apache-2.0
"""Models of trainings, to the byte: in one go, on several devices, and under a limit of memory."""

from __future__ import annotations

from dataclasses import replace
from pathlib import Path
from typing import Any

import pytest
from compare import assert_same_bits

from clsplat.api import train
from clsplat.config.training import TrainConfig
from clsplat.device.context import Device
from clsplat.runs.run import Run
from clsplat.scenes.scene import Scene
from clsplat.training.trainer import Trainer


def model_bytes(scene: Scene, config: TrainConfig, device: Device, folder: Path, **options: Any) -> bytes:
    """model.ply of a training."""
    run = Run.create(folder, config)
    train(scene, config, device=device, run=run, **options)
    return run.model_path.read_bytes()


@pytest.fixture(scope="module")
def undisturbed(request: pytest.FixtureRequest, default_device: Device, tmp_path_factory: Any) -> bytes:
    """model.ply of the module's CONFIG on its `scene`, trained in one go."""
    scene = request.getfixturevalue("scene")
    return model_bytes(scene, request.module.CONFIG, default_device, tmp_path_factory.mktemp("undisturbed"))


def opened_again(device: Device) -> Device:
    """The same device with a context, a queue and kernels of its own, as a thread of its own needs them."""
    return Device(device.cl_device, device.shape)


def check_on_two_devices(scene: Scene, config: TrainConfig, device: Device, steps: int) -> None:
    """Two views a step on two devices, and on one, to the same bytes."""
    config, models = replace(config, batch=2), []
    for further in ((), (opened_again(device),)):
        trainer = Trainer(scene, config, device, further=further)
        for _ in range(steps):
            trainer.train_step()
        models.append(trainer.gaussians().arrays())
        trainer.close()
    for name, values in models[0].items():
        assert_same_bits(models[1][name], values, name)


def check_in_less_memory(
    scene: Scene, config: TrainConfig, device: Device, folder: Path, *, part: float = 0.45
) -> None:
    """A training with a part of the memory that it takes comes in pieces, and to the same bytes."""
    free = device.with_memory_limit(None)
    whole = model_bytes(scene, config, free, folder / "free")
    limited = device.with_memory_limit(int(part * free.memory.peak))
    run, pieces = Run.create(folder / "limited", config), []
    train(scene, config, device=limited, run=run, on_plan=lambda plan: pieces.append(plan.pieces))
    assert run.model_path.read_bytes() == whole
    assert any(streamed or bands > 1 for streamed, bands in pieces)


def stopped_at(step: int, scene: Scene, config: TrainConfig, device: Device, folder: Path) -> bytes:
    """model.ply of a training that ended at a step and went on."""
    model_bytes(scene, replace(config, iterations=step), device, folder)
    return gone_on(scene, config, device, Run.create(folder, config, resume=True))


def interrupted(scene: Scene, config: TrainConfig, device: Device, folder: Path) -> bytes:
    """model.ply of a training that Ctrl-C ended at its first step and that went on."""
    run = Run.create(folder, config)

    def stop(report: object) -> None:
        raise KeyboardInterrupt

    with pytest.raises(KeyboardInterrupt):
        train(scene, config, device=device, run=run, on_step=stop)
    return gone_on(scene, config, device, run)


def gone_on(scene: Scene, config: TrainConfig, device: Device, run: Run) -> bytes:
    """model.ply of a run that goes on where it stopped."""
    train(scene, config, device=device, run=run, resume=True)
    return run.model_path.read_bytes()
