# SPDX-License-Identifier: Apache-2.0
"""Training with launches from command buffers gives the bytes of training without, whatever changes from step to
step."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import replace
from pathlib import Path
from typing import Any

import numpy as np
import pytest
from compare import assert_same_bits
from depths import add_maps
from numpy.typing import NDArray
from tiny import short, write_scene

from clsplat.config.training import TrainConfig
from clsplat.device.buffers import Workspace, upload
from clsplat.device.command_buffer import CHECK_TAPES, CommandBuffer
from clsplat.device.command_buffer import TAPES_VARIABLE as TAPES
from clsplat.device.context import Device
from clsplat.errors import InputError
from clsplat.images.reading import read_image
from clsplat.images.writing import write_image
from clsplat.scenes.depth_sources import with_depths
from clsplat.scenes.loading import load_scene
from clsplat.scenes.scene import Scene
from clsplat.stages import project
from clsplat.stages.scan import scan
from clsplat.training.step.speculative_steps import BY_CAPACITY_VARIABLE
from clsplat.training.trainer import Trainer

PLAIN = short(iterations=60, density={"min_contribution": 0.01})
MCMC = {"growth": "mcmc", "max_gaussians": 150, "min_opacity": 0.03, "max_screen_radius": 30.0}
CONFIGS = {
    "plain": PLAIN,
    "background": short(iterations=60, background="random"),
    "thinning": replace(PLAIN, thinning=0.5),
    "exposure": replace(PLAIN, appearance="exposure"),
    "ppisp": replace(PLAIN, appearance="ppisp"),
    "grid": replace(PLAIN, appearance="grid"),
    "MCMC": short(iterations=60, density=MCMC),
    "long axis": short(density={"growth": "budget", "max_gaussians": 120, "long_axis": True}),
    "antialiased": replace(PLAIN, antialiased=True),
    "ignored": replace(PLAIN, masks="ignore"),
    "transparent": replace(PLAIN, masks="transparent"),
    "sparse": replace(PLAIN, optimiser=replace(PLAIN.optimiser, sparse=True)),
    "all": replace(
        short(iterations=60, density=MCMC), thinning=0.3, appearance="exposure", antialiased=True, masks="ignore"
    ),
    "depth": replace(PLAIN, depth="maps", thinning=0.2, penalty=0.01),
    "batch": replace(PLAIN, batch=2, thinning=0.3),
}
"""Each with density control, rising SH degrees and sizes of photographs."""
TOO_SMALL = (7, 12, 13, 25)
"""Steps whose room is for 8 pairs, so that they are made again."""


@pytest.fixture(scope="module")
def folder(tmp_path_factory: pytest.TempPathFactory) -> Path:
    """The tiny scene with a mask of each picture, of as many pixels as no other's, and its depths."""
    scene = write_scene(tmp_path_factory.mktemp("tiny") / "scene")
    (scene / "masks").mkdir()
    for index, path in enumerate(sorted((scene / "images").iterdir())):
        mask = np.ones_like(read_image(path)[:, :, :3])
        mask[5:23, 2 * index : 3 * index + 9] = 0
        write_image(scene / "masks" / f"{path.name}.png", mask)
    add_maps(scene)
    return scene


Result = tuple[Mapping[str, NDArray[Any]], list[tuple[float, float]], int]


def trained(scene: Scene, config: TrainConfig, device: Device, monkeypatch: pytest.MonkeyPatch, **how: str) -> Result:
    """The arrays of a checkpoint after a training, its losses, and how many steps were made again."""
    for name, value in ((BY_CAPACITY_VARIABLE, how.get("capacity", "1")), (TAPES, how["command_buffers"])):
        monkeypatch.setenv(name, value)
    trainer, losses = Trainer(scene, config, device), []
    real = trainer.pending.room
    monkeypatch.setattr(
        trainer.pending, "room", lambda *size: (room := real(*size)) and (8 if trainer.step in TOO_SMALL else room)
    )
    while trainer.step < config.iterations:
        losses.append(trainer.train_step(reads_loss=trainer.step % 10 == 9))
        if trainer.step % 10 == 0:
            losses[-1] = losses[-1].read()
        else:
            losses.pop()
    return trainer.checkpoint()[0], losses, trainer.pending.redone


def assert_alike(one: Result, other: Result) -> None:
    assert one[0].keys() == other[0].keys()
    for name, values in one[0].items():
        assert_same_bits(values, other[0][name], name)
    assert one[1] == other[1]


FAST = ("plain",)


@pytest.mark.parametrize(
    "setting", [name if name in FAST else pytest.param(name, marks=pytest.mark.slow) for name in CONFIGS]
)
def test_every_setting_has_its_bytes(
    default_device: Device, folder: Path, monkeypatch: pytest.MonkeyPatch, setting: str
) -> None:
    """Without command buffers, with them, and with each launch compared with the recorded one; in a group's shape
    too."""
    config, replayed, checked = CONFIGS[setting], [], []
    scene = with_depths(load_scene(folder, masks=config.mask_use), config.depth_use)
    group = default_device.with_shape(lanes=1, items=64)
    for name, calls in (("set", replayed), ("check", checked)):
        real = getattr(CommandBuffer, name)
        monkeypatch.setattr(CommandBuffer, name, lambda *given, real=real, calls=calls: (calls.append(1), real(*given)))
    for device, uses in ((default_device, ("0", "1", CHECK_TAPES)), (group, ("1",))):
        exact = trained(scene, config, device, monkeypatch, capacity="0", command_buffers="0")
        for use in uses:
            replayed.clear(), checked.clear()
            other = trained(scene, config, device, monkeypatch, command_buffers=use)
            assert_alike(exact, other)
            assert (other[2] > 0) == (config.batch == 1)
            assert (len(replayed) > 20) == (use == "1" and config.batch == 1)
            assert (len(checked) > 20) == (use == CHECK_TAPES and config.batch == 1)


@pytest.mark.parametrize("batch", [1, 2])
def test_a_step_with_exact_counts_makes_no_command_buffer(
    default_device: Device, folder: Path, monkeypatch: pytest.MonkeyPatch, batch: int
) -> None:
    """Arrays are new each time: a command buffer would never be used, and takes the host a millisecond to make."""
    made: list[int] = []
    monkeypatch.setattr(CommandBuffer, "add_launch", lambda *_: made.append(1))
    config = replace(PLAIN, batch=batch, iterations=6)
    trained(load_scene(folder), config, default_device, monkeypatch, capacity="0", command_buffers="1")
    assert not made


def test_a_number_that_is_not_declared_is_found(
    default_device: Device, folder: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setattr(project, "LaunchParameter", float)
    monkeypatch.setattr(project, "step_numbers", real := project.step_numbers)
    monkeypatch.setattr("clsplat.training.step.gradient_step.step_numbers", lambda *given: real(*given)[:0])
    with pytest.raises(AssertionError, match="project_step in a command buffer has other arguments than now"):
        trained(load_scene(folder), PLAIN, default_device, monkeypatch, command_buffers=CHECK_TAPES)


def test_a_number_that_is_not_given_is_found(
    default_device: Device, folder: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    real = project.step_numbers
    monkeypatch.setattr("clsplat.training.step.gradient_step.step_numbers", lambda *given: (*real(*given)[:-1], 0.5))
    with pytest.raises(AssertionError, match="numbers given to a command buffer are"):
        trained(load_scene(folder), PLAIN, default_device, monkeypatch, command_buffers=CHECK_TAPES)


def test_another_word_than_those_is_refused(
    default_device: Device, folder: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setenv(TAPES, "yes")
    with pytest.raises(InputError, match=f"{TAPES}=yes: expected 1, 0 or check"):
        Trainer(load_scene(folder), PLAIN, default_device)


def test_kernel_objects_are_used_by_other_command_buffers(default_device: Device) -> None:
    """Making one takes longer than many launches."""
    work, owned = Workspace(default_device), []
    numbers = upload(default_device, np.arange(100, dtype=np.uint32))
    out, total = work.array("out", (100,), np.uint32), work.array("total", (1,), np.uint32)
    for _ in range(3):
        _, commands = default_device.record(lambda: scan(default_device, work, numbers, out, total))
        assert commands is not None
        owned.append({own.int_ptr for _, own in commands._owned})
        total.fill(0)
        default_device.replay(commands)
        assert total.get()[0] == 4950
        del commands
    assert owned[0] == owned[1] == owned[2] != set()
