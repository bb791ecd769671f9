# SPDX-License-Identifier: Apache-2.0
"""NaN, infinity and garbage in every array of a training: nothing reads what nobody wrote, and nothing spreads."""

from __future__ import annotations

from collections.abc import Callable
from pathlib import Path
from typing import Any

import numpy as np
import pytest
from calls import refuses
from compare import assert_same_bits
from golden_frames import checksums
from tiny import short, trained_to, write_scene

from clsplat.config.training import TrainConfig
from clsplat.device.buffers import DeviceArray, Workspace, allocate
from clsplat.device.context import Device
from clsplat.gaussians import PARAMETER_GROUPS
from clsplat.layouts.columns import SPLAT
from clsplat.scenes.loading import load_scene
from clsplat.scenes.scene import Scene
from clsplat.stages.device_gaussians import allocate_gaussians
from clsplat.training.step import gradient_step as step_module
from clsplat.training.step.gradient_step import GradientStep
from clsplat.training.step.inputs import StepRows, ViewInputs
from clsplat.training.trainer import Trainer

pytestmark = pytest.mark.filterwarnings("error::RuntimeWarning")

WORDS = {"NaN": "1", "-inf": "0xff800000", "bytes of 255": "0xffffffff", "garbage": "0x4f3a91c7"}
BROKEN = (np.nan, np.inf, -np.inf)
GARBAGE = (3e38, -1e30, 1e-42)
ROW = 5
"""The Gaussian that is poisoned."""


@pytest.fixture(scope="module")
def many_points(tmp_path_factory: pytest.TempPathFactory) -> Scene:
    """The same pictures, and random points to start from."""
    return load_scene(write_scene(tmp_path_factory.mktemp("tiny") / "scene", points=False))


# Memory that nobody has written


@pytest.mark.parametrize("kind", [np.float32, np.uint8, np.uint32])
def test_memory_is_poisoned_when_asked_for(default_device: Device, monkeypatch: pytest.MonkeyPatch, kind: type) -> None:
    for word in WORDS.values():
        monkeypatch.setenv("CLSPLAT_POISON", word)
        pattern = np.full(7, 0x7FC00000 if word == "1" else int(word, 0), np.uint32).view(np.uint8)
        work = Workspace(default_device)
        for _ in range(2):  # again, as what the last user left has to be gone
            for array in (allocate(default_device, (7,), kind), work.array("some", (7,), kind)):
                whole = array.nbytes // 4 * 4
                assert_same_bits(array.get().view(np.uint8)[:whole], pattern[:whole])
                array.fill(0)
    monkeypatch.setenv("CLSPLAT_POISON", "much")
    refuses("CLSPLAT_POISON=much: expected 1, or a 32-bit number", Workspace, default_device)


@pytest.mark.parametrize("word", WORDS)
def test_frames_and_gradients_in_poisoned_memory(device: Device, monkeypatch: pytest.MonkeyPatch, word: str) -> None:
    monkeypatch.delenv("CLSPLAT_POISON", raising=False)
    wanted = checksums(device)
    monkeypatch.setenv("CLSPLAT_POISON", WORDS[word])
    assert checksums(device) == wanted


MANY = short(
    iterations=32,
    random_points=400,
    density={"gradient_threshold": 1e-4, "max_gaussians": 2500, "opacity_reset_every": 0},
)
"""Gaussians that become so many that memory is a matter of them and not of the planes."""


def little_memory(scene: Scene, device: Device) -> Device:
    """So much that MANY is streamed at its end."""
    free = device.with_memory_limit(None)
    trained_to(MANY.iterations, scene, MANY, free)
    return device.with_memory_limit(int(0.3 * free.memory.peak))


# What something else has spoilt


def quiet(**changes: object) -> TrainConfig:
    """Three SH bands from the start, all Gaussians as they are."""
    density = changes.pop("density", {"every": 0})
    return short(warmup=(), sh_degree=2, sh_degree_every=0, density=density, **changes)


def started(scene: Scene, device: Device, config: TrainConfig | None = None) -> Trainer:
    """After three steps, so that there are moments."""
    return trained_to(3, scene, config or quiet(), device)


@pytest.fixture(scope="module")
def plain(scene: Scene, default_device: Device) -> Trainer:
    """A training after one step in which nothing was poisoned; not to be changed."""
    trainer = started(scene, default_device)
    trainer.train_step()
    return trainer


def put(array: DeviceArray, value: float, row: int = ROW) -> None:
    """Into the last element of a row: of a quaternion's, the first has no gradient while the others are 0."""
    values = array.get()
    values.reshape(len(values), -1)[row, -1] = value
    array.set(values)


def rows_of(trainer: Trainer) -> dict[str, np.ndarray]:
    """Parameters of all Gaussians but the poisoned one."""
    return {group: np.delete(trainer.parameters[group].get(), ROW, axis=0) for group in PARAMETER_GROUPS}


def assert_well(trainer: Trainer) -> None:
    """Every number of the model is finite, and no trouble is left that a later step would meet."""
    arrays, _ = trainer.checkpoint()
    assert all(np.isfinite(values).all() for name, values in arrays.items() if not name.startswith("statistics"))
    trainer.monitor.incidents.clear()
    for _ in range(3):
        assert np.isfinite(trainer.train_step().read()).all()
    trainer.repair(look=True)
    assert trainer.monitor.incidents == []


def assert_others_alike(one: Trainer, other: Trainer) -> None:
    for group, values in rows_of(one).items():
        assert_same_bits(rows_of(other)[group], values, group)


@pytest.mark.slow
@pytest.mark.parametrize("sparse", [False, True])
@pytest.mark.parametrize("group", PARAMETER_GROUPS)
def test_broken_parameters_are_not_drawn_and_removed(
    scene: Scene, default_device: Device, group: str, sparse: bool
) -> None:
    config = quiet()
    config = short(warmup=(), sh_degree_every=0, density={"every": 0}, optimiser=type(config.optimiser)(sparse=sparse))
    for value in BROKEN:
        poisoned, hidden = started(scene, default_device, config), started(scene, default_device, config)
        put(poisoned.parameters[group], value)
        put(hidden.parameters["opacity_logits"], -100.0)
        loss, wanted = poisoned.train_step().read(), hidden.train_step().read()
        # What is opaque, a point or black is drawn: with higher bands it is a matter of the direction.
        drawn = {"opacity_logits": value > 0, "log_scales": value < 0, "sh_dc": value < 0, "sh_rest": True}
        if np.isnan(value) or not drawn.get(group, False):
            assert loss == wanted, value
            assert_others_alike(poisoned, hidden)
        assert np.isfinite(loss).all()
        poisoned.train_step()  # which notices
        poisoned.checkpoint()  # which finds what was hidden as well
        (incident,) = poisoned.monitor.incidents
        assert (incident.stage, incident.count) == ("parameters", 1), value
        assert poisoned.parameters.count == hidden.parameters.count - 1
        assert_well(poisoned)


def poison_gradients(trainer: Trainer, monkeypatch: pytest.MonkeyPatch, group: str, value: float) -> None:
    """In the next step alone, after the backward pass, with gradients in memory."""
    model = trainer.parameters
    gradients = allocate_gaussians(trainer.device, model.count, model.coefficients, zero=True)
    run, update = GradientStep.run, GradientStep.update

    def looked_at(self: GradientStep, *arguments: Any, **named: Any) -> object:
        monkeypatch.setattr(GradientStep, "run", run)
        return run(self, *arguments[:3], gradients, **named)

    def poisoned(self: GradientStep, rows: StepRows, inputs: ViewInputs) -> None:
        if self.device.only_tries:
            update(self, rows, inputs)
            return
        put(gradients[group], value)
        monkeypatch.setattr(GradientStep, "update", update)
        update(self, rows, inputs)
        assert not any(gradients[each].get().any() for each in PARAMETER_GROUPS)

    monkeypatch.setattr(GradientStep, "run", looked_at)
    monkeypatch.setattr(GradientStep, "update", poisoned)


@pytest.mark.parametrize("group", PARAMETER_GROUPS)
def test_a_broken_gradient_costs_its_gaussian_alone(
    scene: Scene, default_device: Device, plain: Trainer, monkeypatch: pytest.MonkeyPatch, group: str
) -> None:
    for value in (*BROKEN, 1e30):
        poisoned = started(scene, default_device)
        poison_gradients(poisoned, monkeypatch, group, value)
        before = poisoned.parameters[group].get().reshape(40, -1)[ROW, -1]
        poisoned.train_step()
        assert poisoned.parameters[group].get().reshape(40, -1)[ROW, -1] == before, "it was not moved"
        assert_others_alike(poisoned, plain)
        poisoned.repair(look=True)
        (incident,) = poisoned.monitor.incidents
        # A finite one of which the square is not is the optimiser's own trouble.
        assert (incident.stage, incident.count) == ("adam" if value == 1e30 else "project_grad", 1)
        assert poisoned.parameters.count == 39
        assert_others_alike(plain, plain)
        for each in PARAMETER_GROUPS:
            assert_same_bits(poisoned.parameters[each].get(), rows_of(plain)[each], each)
        assert_well(poisoned)


@pytest.mark.parametrize("group", PARAMETER_GROUPS)
@pytest.mark.parametrize("which", ["first", "second"])
def test_broken_moments_begin_again(
    scene: Scene, default_device: Device, plain: Trainer, which: str, group: str
) -> None:
    for value in (*BROKEN, -5.0):
        if which == "first" and value == -5.0:
            continue  # that is a moment as good as any
        poisoned = started(scene, default_device)
        put(poisoned.model.kinds()[which][group], value)
        before = poisoned.parameters[group].get().reshape(40, -1)[ROW, -1]
        poisoned.train_step()
        assert_others_alike(poisoned, plain)
        assert poisoned.parameters[group].get().reshape(40, -1)[ROW, -1] == before
        for moments in (poisoned.model.first, poisoned.model.second):
            assert moments[group].get().reshape(40, -1)[ROW, -1] == 0
        poisoned.repair(look=True)
        (incident,) = poisoned.monitor.incidents
        assert incident.stage == "adam"
        assert poisoned.parameters.count == 40
        assert_well(poisoned)


@pytest.mark.parametrize("group", PARAMETER_GROUPS)
@pytest.mark.parametrize("which", ["parameters", "first", "second"])
def test_garbage_spoils_nothing_else(
    scene: Scene, default_device: Device, plain: Trainer, which: str, group: str
) -> None:
    for value in GARBAGE:
        poisoned = started(scene, default_device)
        put(poisoned.model.kinds()[which][group], value)
        assert np.isfinite(poisoned.train_step().read()).all(), value
        if which != "parameters":  # garbage there is drawn, and has its place in the others' gradients
            assert_others_alike(poisoned, plain)
        for _ in range(3):
            assert np.isfinite(poisoned.train_step().read()).all(), value
        assert poisoned.parameters.count >= 39
        assert_well(poisoned)


STATISTICS = ("gradient_sums", "seen", "radii", "current_totals", "current_largest", "whole_totals")


@pytest.mark.parametrize("name", STATISTICS)
def test_spoilt_statistics_leave_a_sound_model(scene: Scene, default_device: Device, name: str) -> None:
    density = {"start": 2, "every": 4, "min_contribution": 0.05, "max_screen_radius": 30.0}
    for value in (*BROKEN, *GARBAGE):
        trainer = started(scene, default_device, quiet(density=density))
        put(trainer.statistics.named()[name], value)
        for _ in range(6):
            assert np.isfinite(trainer.train_step().read()).all(), value
        assert trainer.parameters.count > 30
        assert_well(trainer)


def after(monkeypatch: pytest.MonkeyPatch, name: str, spoil: Callable[[object], None]) -> None:
    """Let the stage that the trainer calls `name` do its work, once, and spoil what it gives."""
    real = getattr(step_module, name)

    def spoilt(*arguments: object, **options: object) -> object:
        result = real(*arguments, **options)
        spoil(result)
        monkeypatch.setattr(step_module, name, real)
        return result

    monkeypatch.setattr(step_module, name, spoilt)


@pytest.mark.parametrize("value", BROKEN)
@pytest.mark.parametrize("where", ["target", "loss"])
def test_a_broken_loss_is_no_fault_of_the_gaussians(
    scene: Scene, default_device: Device, plain: Trainer, monkeypatch: pytest.MonkeyPatch, where: str, value: float
) -> None:
    """A pixel of the photograph, or of the gradient together with the sums as such a pixel leaves them."""

    def spoil(result: object) -> None:
        if where == "target":
            array = result
            assert isinstance(array, DeviceArray)
            pixels = array.get()
            pixels[1, 20, 24] = value
            array.set(pixels)
            return
        for array in (result.gradient, result.sums):  # type: ignore[attr-defined]
            values = array.get()
            values.reshape(3, -1)[1, 20 * 48 + 24 if values.size > 5000 else 20] = value
            array.set(values)

    poisoned = started(scene, default_device)
    after(monkeypatch, where, spoil)
    result = poisoned.train_step()
    assert not np.isfinite(result.read()).all()
    moved = (poisoned.parameters["means"].get() != plain.parameters["means"].get()).any(axis=1).sum()
    assert moved > 0
    assert moved < 40 or where == "target", "without SSIM's windows most Gaussians are out of the pixel's reach"
    poisoned.repair(look=True)
    (incident,) = poisoned.monitor.incidents
    assert incident.stage == "loss"
    assert incident.step == 4
    assert poisoned.parameters.count == 40
    assert_well(poisoned)


@pytest.mark.parametrize("value", BROKEN)
def test_a_broken_slot_costs_its_gaussian_alone(
    scene: Scene, default_device: Device, plain: Trainer, monkeypatch: pytest.MonkeyPatch, value: float
) -> None:
    poisoned = started(scene, default_device)
    real = poisoned.rasterizer.pair_gradients

    def spoilt(frame: object, *arguments: object, **options: object) -> object:
        slots = real(frame, *arguments, **options)  # type: ignore[arg-type]
        values = slots.values.get()
        assert slots.first_slots is not None
        values[slots.first_slots.get()[ROW]] = value
        slots.values.set(values)
        return slots

    monkeypatch.setattr(poisoned.rasterizer, "pair_gradients", spoilt)
    poisoned.train_step()
    monkeypatch.undo()
    assert_others_alike(poisoned, plain)
    poisoned.train_step()
    poisoned.repair()
    (incident,) = poisoned.monitor.incidents
    assert (incident.stage, incident.count, incident.step) == ("project_grad", 1, 4)
    statistics = poisoned.statistics.named()
    assert all(np.isfinite(array.get()).all() for array in statistics.values())
    assert poisoned.parameters.count == 39


def test_a_colour_that_is_not_finite_is_the_only_one_lost(scene: Scene, default_device: Device) -> None:
    """One that is too large is not drawn either: in the loss it would be all there is."""
    for value in (1e20, 1e10, np.inf):
        poisoned, hidden = started(scene, default_device), started(scene, default_device)
        put(poisoned.parameters["sh_dc"], value)
        put(hidden.parameters["opacity_logits"], -100.0)
        assert poisoned.train_step().read() == hidden.train_step().read()
        counts = poisoned.rasterizer.work.array("tile_counts", (40,), np.uint32).get()
        assert counts[ROW] == 0
        splats = poisoned.rasterizer.work.array("splats", (40, len(SPLAT))).get()
        assert np.isfinite(splats[counts > 0][:, : SPLAT.index("UNUSED")]).all()
        assert_others_alike(poisoned, hidden)


@pytest.mark.slow
def test_rows_that_are_streamed_are_looked_after_too(many_points: Scene, default_device: Device) -> None:
    trainer = trained_to(MANY.iterations, many_points, MANY, little_memory(many_points, default_device))
    assert trainer.plan.streamed
    count = trainer.parameters.count
    values = trainer.parameters["sh_dc"].get()
    values[[ROW, 900]] = np.nan
    trainer.parameters["sh_dc"].set(values)
    trainer.train_step()
    trainer.train_step()
    trainer.repair()
    (incident,) = trainer.monitor.incidents
    assert (incident.stage, incident.count) == ("parameters", 2)
    assert trainer.parameters.count == count - 2
    assert_well(trainer)


def test_the_scene_has_what_these_tests_poison(scene: Scene, default_device: Device) -> None:
    trainer = started(scene, default_device)
    assert trainer.parameters.count == 40
    assert trainer.parameters.coefficients == 9
    counts = trainer.rasterizer.work.array("tile_counts", (40,), np.uint32).get()
    assert counts[ROW] > 0, "a Gaussian that nobody sees has no gradient to poison"
    assert Path(scene.views[0].path).exists()
