# SPDX-License-Identifier: Apache-2.0
"""Trainings repeat to the last byte: stopped, by capacity, in less and poisoned memory, on two devices; every setting.

The arrays of the last checkpoint are compared too. `test_command_buffers.py` has by capacity for every setting.
"""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import replace
from pathlib import Path

import pytest
from compare import assert_same_arrays
from pipeline import shaped
from quick import quick
from same_bytes import (
    SETTINGS,
    State,
    make_too_small,
    opened_again,
    outcome,
    scene_for,
    stopped,
    write_known_scene,
)
from tiny import run_steps

from clsplat.config.training import TrainConfig
from clsplat.device.context import Device
from clsplat.scenes.scene import Scene
from clsplat.training.step.speculative_steps import BY_CAPACITY_VARIABLE
from clsplat.training.trainer import Trainer

pytestmark = pytest.mark.filterwarnings("error::RuntimeWarning")

Outcomes = Callable[[str], State]

STOPS = {
    **dict.fromkeys(SETTINGS, (17,)),
    "contributions": (7, 8, 12, 19, 20, 24, 40, 42, 45),
    "MCMC": (7, 15, 16, 20, 40),
    "long axis": (7, 15, 16, 20, 40),
    "shortcuts": (1, 4, 15, 20, 33),
    "late": (1, 4, 15, 20, 33),
    "antialiased": (7, 23),
}
"""Steps to stop after: at the seams of epochs (8 views), of resets, of passes and of what is gathered."""
QUICK_STOPS = [
    *(("contributions", 20), ("MCMC", 16), ("long axis", 40), ("late", 33)),
    *((name, 17) for name in ("exposure", "points", "cameras")),
]


@pytest.fixture(scope="module")
def folder(tmp_path_factory: pytest.TempPathFactory) -> Path:
    return write_known_scene(tmp_path_factory.mktemp("tiny") / "scene")


@pytest.fixture(scope="module")
def undisturbed(folder: Path, default_device: Device, tmp_path_factory: pytest.TempPathFactory) -> Outcomes:
    """Outcomes of settings by name, each trained in one go once."""
    made: dict[str, State] = {}

    def of(name: str) -> State:
        if name not in made:
            config, target = SETTINGS[name], tmp_path_factory.mktemp("whole") / "run"
            made[name] = outcome(scene_for(folder, config), config, default_device, target)
        return made[name]

    return of


@pytest.fixture(scope="module")
def scalar() -> dict[str, State]:
    """Arrays after trainings on the default driver in one lane, by setting."""
    return {}


@pytest.mark.parametrize(
    ("name", "step"),
    [
        pytest.param(name, step, marks=() if (name, step) in QUICK_STOPS else pytest.mark.slow)
        for name, steps in STOPS.items()
        for step in steps
    ],
)
def test_stopping_and_going_on(
    name: str, step: int, folder: Path, default_device: Device, tmp_path: Path, undisturbed: Outcomes
) -> None:
    config = SETTINGS[name]
    got = stopped(step, scene_for(folder, config), config, default_device, tmp_path / "run")
    assert_same_arrays(got, undisturbed(name))


@pytest.mark.parametrize(
    "name", quick(["exposure", "ppisp", "grid", "points", "long axis", "MCMC", "late"], "exposure", "points", "MCMC")
)
def test_by_capacity(
    name: str, folder: Path, default_device: Device, undisturbed: Outcomes, monkeypatch: pytest.MonkeyPatch
) -> None:
    """A step that has stopped adds nothing, no noise either, and the one that is made again has its own."""
    monkeypatch.setenv(BY_CAPACITY_VARIABLE, "1")
    config = SETTINGS[name]
    trainer = Trainer(scene_for(folder, config), config, default_device)
    make_too_small(monkeypatch, trainer, (12, 31))
    run_steps(config.iterations, trainer)
    wanted = {key: array for key, array in undisturbed(name).items() if key != "model.ply"}
    assert_same_arrays(trainer.checkpoint()[0], wanted)
    assert trainer.pending.redone > 0


@pytest.mark.slow
@pytest.mark.parametrize(
    "names",
    [
        ("plain", "thinning", "poses", "lenses", "cameras", "antialiased"),
        pytest.param(tuple(SETTINGS), marks=pytest.mark.slow),
    ],
    ids=["some", "all"],
)
def test_each_setting_makes_another_model(names: tuple[str, ...], undisturbed: Outcomes) -> None:
    assert len({undisturbed(name)["model.ply"].tobytes() for name in names}) == len(names)


def grown(config: TrainConfig) -> TrainConfig:
    """The settings, with so many Gaussians that memory is a matter of them and not of the planes."""
    if config.density.growth == "paper":
        return replace(config, random_points=1500)
    return replace(config, random_points=400, density=replace(config.density, max_gaussians=2500))


def without_points(scene: Scene) -> Scene:
    return replace(scene, points=scene.points[:0], point_colors=scene.point_colors[:0])


POISONED = ("contributions", "cameras")
"""Settings of the quick run in poisoned memory. All of them have NaN there, some another word too."""
LITTLE = [
    *((name, 0.45) for name in ("poses", "lenses", "cameras", "long axis")),
    *((name, 0.6) for name in ("thinning", "penalty", "maps")),
    *(("MCMC", 0.6), ("MCMC", 0.5), ("contributions", 0.6), ("contributions", 0.3), ("absolute", 0.7)),
]
"""Settings, and the part of the memory that they take."""


@pytest.mark.parametrize(
    ("name", "part"), [pytest.param(*one, marks=() if one[0] == "long axis" else pytest.mark.slow) for one in LITTLE]
)
def test_in_less_memory(
    name: str, part: float, folder: Path, default_device: Device, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    """In pieces: rows by their place in the model, bands of tiles, or both; the memory is poisoned."""
    config = grown(SETTINGS[name])
    scene, free = without_points(scene_for(folder, config)), default_device.with_memory_limit(None)
    whole = outcome(scene, config, free, tmp_path / "free")
    limited = default_device.with_memory_limit(int(part * free.memory.peak))
    pieces = []
    monkeypatch.setenv("CLSPLAT_POISON", "1")
    got = outcome(scene, config, limited, tmp_path / "limited", on_plan=lambda plan: pieces.append(plan.pieces))
    assert_same_arrays(got, whole)
    assert limited.memory.peak <= int(part * free.memory.peak)
    assert any(streamed or bands > 1 for streamed, bands in pieces)
    assert any(streamed for streamed, _ in pieces) or part > 0.5


@pytest.mark.parametrize(
    ("name", "word"),
    [
        *(pytest.param(name, "1", marks=() if name in POISONED else pytest.mark.slow) for name in SETTINGS),
        *(pytest.param(name, "0x4f3a91c7", marks=pytest.mark.slow) for name in (*POISONED, "MCMC", "late", "all")),
    ],
)
def test_in_poisoned_memory(
    name: str, word: str, folder: Path, default_device: Device, tmp_path: Path, undisturbed: Outcomes,
    monkeypatch: pytest.MonkeyPatch,
) -> None:  # fmt: skip
    """NaN and garbage in every array that is handed out: nothing reads memory that nobody has written."""
    wanted, config = undisturbed(name), SETTINGS[name]
    monkeypatch.setenv("CLSPLAT_POISON", word)
    assert_same_arrays(outcome(scene_for(folder, config), config, default_device, tmp_path / "run"), wanted)


@pytest.mark.slow
def test_groups_in_poisoned_memory(
    folder: Path, default_device: Device, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    config, device, found = SETTINGS["absolute"], shaped(default_device, 1, 64), []
    for word in ("", "1", "0x4f3a91c7"):
        monkeypatch.setenv("CLSPLAT_POISON", word)
        found.append(outcome(scene_for(folder, config), config, device, tmp_path / f"run{word}"))
        assert_same_arrays(found[-1], found[0])


@pytest.mark.slow
@pytest.mark.parametrize(
    "name", quick(["thinning", "penalty", "points", "MCMC", "exposure", "ppisp", "grid"], "penalty")
)
def test_two_devices_have_the_bytes_of_one(name: str, folder: Path, default_device: Device) -> None:
    """With two views a step."""
    config, found = replace(SETTINGS[name], batch=2), []
    for further in ((), (opened_again(default_device),)):
        trainer = Trainer(scene_for(folder, config), config, default_device, further=further)
        run_steps(12, trainer)
        found.append(trainer.checkpoint()[0])
        trainer.close()
    assert_same_arrays(found[1], found[0])


@pytest.mark.slow
@pytest.mark.parametrize("name", quick(["contributions", "MCMC", "late", "all"], "contributions"))
def test_every_driver_trains_alike(
    name: str, folder: Path, device: Device, default_device: Device, scalar: dict[str, State]
) -> None:
    """In one shape of the kernels."""
    config = SETTINGS[name]

    def trained(on: Device) -> State:
        trainer = Trainer(scene_for(folder, config), config, shaped(on, 1, 1))
        run_steps(24, trainer)
        return trainer.checkpoint()[0]

    if name not in scalar:
        scalar[name] = trained(default_device)
    if device is not default_device:
        assert_same_arrays(trained(device), scalar[name])
