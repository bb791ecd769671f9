# SPDX-License-Identifier: Apache-2.0
"""Training with launches from command buffers gives the bytes of training without, whatever changes from step to
step."""

from __future__ import annotations

from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest
from calls import refuses
from pipeline import shaped
from quick import quick
from same_bytes import PLAIN, SETTINGS, Stepped, assert_alike, scene_for, stepped, write_known_scene

from clsplat.config.training import TrainConfig
from clsplat.device.buffers import Workspace, upload
from clsplat.device.command_buffer import CHECK_TAPES, CommandBuffer
from clsplat.device.command_buffer import TAPES_VARIABLE as TAPES
from clsplat.device.context import Device
from clsplat.scenes.loading import load_scene
from clsplat.scenes.scene import Scene
from clsplat.stages import project
from clsplat.stages.scan import scan
from clsplat.training.trainer import Trainer

WITHOUT = {"poses", "lenses", "cameras", "rays, refined", "points"}
TOO_SMALL = (7, 12, 13, 25)
"""Steps that are made again."""


@pytest.fixture(scope="module")
def folder(tmp_path_factory: pytest.TempPathFactory) -> Path:
    return write_known_scene(tmp_path_factory.mktemp("tiny") / "scene")


def trained(
    device: Device, scene: Scene, config: TrainConfig, patch: pytest.MonkeyPatch, use: str, *, capacity: bool = True
) -> Stepped:
    patch.setenv(TAPES, use)
    return stepped(scene, config, device, patch, too_small=TOO_SMALL, capacity=capacity)


@pytest.mark.parametrize("setting", quick([name for name in SETTINGS if name not in WITHOUT], "plain"))
def test_every_setting_has_its_bytes(
    default_device: Device, folder: Path, monkeypatch: pytest.MonkeyPatch, setting: str
) -> None:
    """Without command buffers, with them, and with each launch compared with the recorded one."""
    check_uses(default_device, ("0", "1", CHECK_TAPES), folder, monkeypatch, setting)


@pytest.mark.slow
@pytest.mark.parametrize("setting", ["plain", "contributions", "late", "all"])
def test_in_groups_too(default_device: Device, folder: Path, monkeypatch: pytest.MonkeyPatch, setting: str) -> None:
    check_uses(shaped(default_device, 1, 64), ("1",), folder, monkeypatch, setting)


def check_uses(
    device: Device, uses: tuple[str, ...], folder: Path, monkeypatch: pytest.MonkeyPatch, setting: str
) -> None:
    """A training with each value of TAPES has the bytes of one without command buffers and with exact counts."""
    config, replayed, checked = SETTINGS[setting], [], []
    scene = scene_for(folder, config)
    for name, calls in (("set", replayed), ("check", checked)):
        real = getattr(CommandBuffer, name)
        monkeypatch.setattr(CommandBuffer, name, lambda *given, real=real, calls=calls: (calls.append(1), real(*given)))
    exact = trained(device, scene, config, monkeypatch, "0", capacity=False)
    for use in uses:
        replayed.clear(), checked.clear()
        other = trained(device, scene, config, monkeypatch, use)
        assert_alike(other, exact)
        assert (other[2].pending.redone > 0) == (config.batch == 1)
        assert (len(replayed) > 8) == (use == "1" and config.batch == 1)
        assert (len(checked) > 8) == (use == CHECK_TAPES and config.batch == 1)


@pytest.mark.parametrize("batch", [1, 2])
def test_a_step_with_exact_counts_makes_no_command_buffer(
    default_device: Device, folder: Path, monkeypatch: pytest.MonkeyPatch, batch: int
) -> None:
    """Arrays are new each time: a command buffer would never be used, and takes the host a millisecond to make."""
    made: list[int] = []
    monkeypatch.setattr(CommandBuffer, "add_launch", lambda *_: made.append(1))
    config = replace(PLAIN, batch=batch, iterations=6)
    trained(default_device, load_scene(folder), config, monkeypatch, "1", capacity=False)
    assert not made


def test_a_number_that_is_not_declared_is_found(
    default_device: Device, folder: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setattr(project, "LaunchParameter", float)
    monkeypatch.setattr(project, "step_numbers", real := project.step_numbers)
    monkeypatch.setattr("clsplat.training.step.gradient_step.step_numbers", lambda *given: real(*given)[:0])
    with pytest.raises(AssertionError, match="project_step: a replay would pass wrong values"):
        trained(default_device, load_scene(folder), PLAIN, monkeypatch, CHECK_TAPES)


def test_a_number_that_is_not_given_is_found(
    default_device: Device, folder: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    real = project.step_numbers
    monkeypatch.setattr("clsplat.training.step.gradient_step.step_numbers", lambda *given: (*real(*given)[:-1], 0.5))
    with pytest.raises(AssertionError, match="numbers: the replay was given"):
        trained(default_device, load_scene(folder), PLAIN, monkeypatch, CHECK_TAPES)


def test_another_word_than_those_is_refused(
    default_device: Device, folder: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setenv(TAPES, "yes")
    refuses(f"{TAPES}=yes: expected 1, 0 or check", Trainer, load_scene(folder), PLAIN, default_device)


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
