# SPDX-License-Identifier: Apache-2.0
"""Bytes of trainings whose poses, lenses or both are refined: interrupted, in less memory, and with poisoned arrays."""

from __future__ import annotations

from dataclasses import replace
from pathlib import Path

import pytest
from quick import quick
from same_bytes import check_in_less_memory, interrupted, model_bytes
from tiny import short, write_scene

from clsplat.config.training import TrainConfig
from clsplat.device.context import Device
from clsplat.scenes.loading import load_scene
from clsplat.scenes.scene import Scene

REFINED = {"poses": ("refine_poses",), "lenses": ("refine_lenses",), "both": ("refine_poses", "refine_lenses")}


@pytest.fixture(scope="module", params=quick(REFINED, "both"))
def config(request: pytest.FixtureRequest) -> TrainConfig:
    return short(iterations=40, **dict.fromkeys(REFINED[request.param], True))


@pytest.fixture(scope="module")
def whole(scene: Scene, config: TrainConfig, default_device: Device, tmp_path_factory: pytest.TempPathFactory) -> bytes:
    """model.ply of a training in one go."""
    return model_bytes(scene, config, default_device, tmp_path_factory.mktemp("whole"))


def test_an_interruption_gives_the_same_bytes(
    scene: Scene, config: TrainConfig, default_device: Device, tmp_path: Path, whole: bytes
) -> None:
    """At step 10, when every view but those that are held has moved."""
    assert interrupted(scene, config, default_device, tmp_path) == whole


@pytest.mark.slow
def test_in_less_memory_the_same_bytes(config: TrainConfig, default_device: Device, tmp_path: Path) -> None:
    scene = load_scene(write_scene(tmp_path / "scene", points=False))
    check_in_less_memory(scene, replace(config, random_points=1500), default_device, tmp_path)


def test_poison_changes_no_byte(
    scene: Scene,
    config: TrainConfig,
    default_device: Device,
    tmp_path: Path,
    whole: bytes,
    monkeypatch: pytest.MonkeyPatch,
) -> None:
    monkeypatch.setenv("CLSPLAT_POISON", "1")
    assert model_bytes(scene, config, default_device, tmp_path / "poisoned") == whole
