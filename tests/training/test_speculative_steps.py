# SPDX-License-Identifier: Apache-2.0
"""Training by capacity: the bytes of training with exact counts, also where steps have more pairs than room."""

from __future__ import annotations

import numpy as np
import pyopencl as cl
import pytest
from calls import noted, refuses
from pipeline import shaped
from quick import quick
from same_bytes import assert_alike, stepped
from tiny import run_steps, short, trained_to

from clsplat.bench import stages as bench_stages
from clsplat.bench import workload as bench_subject
from clsplat.config.rasterizer import BenchSwitches, RasterizerConfig
from clsplat.device.command_buffer import CommandBuffer
from clsplat.device.context import Device
from clsplat.errors import DriverError
from clsplat.rendering import rasterizer
from clsplat.rendering.rasterizer import MAX_COUNTED_PASSES, ForwardPass
from clsplat.scenes.scene import Scene
from clsplat.stages.device_gaussians import upload_gaussians
from clsplat.training.density import ModelState, RowPlan
from clsplat.training.density.adaptive import Adaptive
from clsplat.training.step import speculative_steps
from clsplat.training.step.speculative_steps import BY_CAPACITY_VARIABLE, SpeculativeSteps, by_capacity
from clsplat.training.trainer import Trainer

CONFIG = short(density={"min_contribution": 0.01})
"""Densifies and prunes after steps 15, 20, 25, ...; resets opacities after 20; contributions make an epoch matter."""


TOO_SMALL = {
    "none": (),
    "within": (7,),
    "twice": (12, 13),
    "before density control": (15, 25),
    "last": (40,),
    "in groups": (16, 31),
}


@pytest.mark.slow
@pytest.mark.parametrize("steps", TOO_SMALL)
def test_trained_by_capacity_is_trained_with_exact_counts(
    device: Device, scene: Scene, monkeypatch: pytest.MonkeyPatch, steps: str
) -> None:
    device = shaped(device, 1, 64) if steps == "in groups" else device
    exact = stepped(scene, CONFIG, device, monkeypatch, capacity=False)
    other = stepped(scene, CONFIG, device, monkeypatch, capacity=True, too_small=TOO_SMALL[steps])
    assert exact[2].pending.redone == 0
    assert (other[2].pending.redone > 0) == (steps != "none")
    assert_alike(exact, other)


@pytest.mark.parametrize("kind", ["parameters", "first"])
def test_trouble_is_mended_and_told_as_with_exact_counts(
    default_device: Device, scene: Scene, monkeypatch: pytest.MonkeyPatch, kind: str
) -> None:
    def spoil(trainer: Trainer) -> None:
        if trainer.step == 16:
            trainer.settle()
            array = trainer.model.kinds()[kind]["means"]
            values = array.get()
            values[5, 0] = np.nan
            array.set(values)

    results = [stepped(scene, CONFIG, default_device, monkeypatch, capacity=on, before=spoil) for on in (False, True)]
    assert_alike(*results)
    assert len(results[1][2].monitor.incidents) == 1
    assert results[1][2].pending.redone == 2


@pytest.mark.parametrize("shape", quick([(1, 64), (8, 1)], (8, 1)))
def test_a_step_by_capacity_waits_for_no_number(
    device: Device, monkeypatch: pytest.MonkeyPatch, shape: tuple[int, int]
) -> None:
    monkeypatch.setenv(BY_CAPACITY_VARIABLE, "1")
    device = device.with_shape(lanes=shape[0], items=shape[1])
    trainer = bench_stages.trainer_of(bench_subject.synthetic(6000, 320, 200), device, RasterizerConfig())
    run_steps(3, trainer)
    for _ in range(4):
        calls = bench_stages.calls_of(device, trainer.train_step)
        assert (calls.blocking_reads, calls.blocking_writes, calls.reads) == (0, 0, 1)
        assert 0 < calls.launches <= (11 if device.shape.items > 1 else 40)
    assert len(device.under_way) < 10, "what the device has read is let go of"


@pytest.mark.slow
@pytest.mark.parametrize("items", [1, 64])
def test_a_step_in_groups_is_all_from_command_buffers(
    default_device: Device, scene: Scene, monkeypatch: pytest.MonkeyPatch, items: int
) -> None:
    """Whichever photograph it has."""
    monkeypatch.setenv(BY_CAPACITY_VARIABLE, "1")
    device = shaped(default_device, 1, items)
    trainer = Trainer(scene, short(iterations=200, sh_degree=0, density={"every": 0, "stop": 200}), device)
    run_steps(1 + MAX_COUNTED_PASSES * len(trainer.views), trainer)  # then the most pairs of a view are known
    launched: list[str] = []
    noted(monkeypatch, Device, "enqueue", lambda _, kernel, *arguments, **options: launched.append(kernel.name))
    for _ in range(2 * len(trainer.views)):
        launched.clear()
        calls = bench_stages.calls_of(device, trainer.train_step)
        assert (calls.launches <= 11) == (items > 1)
        assert (calls.blocking_reads, calls.blocking_writes) == (0, 0)
        assert not launched


@pytest.mark.slow
def test_long_lists_are_sorted_by_radix(default_device: Device, monkeypatch: pytest.MonkeyPatch) -> None:
    """From the step after the one that found a list too long, until the model grows; at once where the mean is."""
    monkeypatch.setenv(BY_CAPACITY_VARIABLE, "1")
    device = shaped(default_device, 1, 64)
    trainer = bench_stages.trainer_of(bench_subject.synthetic(200, 80, 60), device, RasterizerConfig())
    frames: list[ForwardPass] = []
    noted(monkeypatch, SpeculativeSteps, "seen", lambda _, frame: frames.append(frame))

    def appended() -> list[bool]:
        frames.clear()
        run_steps(5, trainer)
        return [frame.listed.pairs is None for frame in frames]

    assert appended() == [False, True, True, True, True]
    monkeypatch.setattr(speculative_steps, "MAX_LIST_PAIRS", 1)
    assert appended() == [True, False, False, False, False]
    monkeypatch.setattr(speculative_steps, "MAX_LIST_PAIRS", 10**6)
    trainer.pending.room(trainer.rasterizer, None, 0)
    assert appended()[1:] == [True] * 4
    monkeypatch.setattr(rasterizer, "MAX_MEAN_PAIRS", 0)
    trainer.rasterizer.work.clear()  # command buffers know the limit that they were recorded with
    assert appended() == [False] * 5


@pytest.mark.parametrize(("failing", "kept"), [(1, True), (2, False)], ids=["gradient", "change"])
def test_a_failed_replay_leaves_the_mark_until_the_model_changes(
    default_device: Device, monkeypatch: pytest.MonkeyPatch, failing: int, kept: bool
) -> None:
    monkeypatch.setenv(BY_CAPACITY_VARIABLE, "1")
    trainer = bench_stages.trainer_of(bench_subject.synthetic(200, 80, 60), default_device, RasterizerConfig())
    run_steps(12, trainer)
    real, calls = Device.replay, []

    def replay(device: Device, commands: CommandBuffer) -> None:
        calls.append(commands)
        if len(calls) == failing:
            raise DriverError("lost")
        real(device, commands)

    monkeypatch.setattr(Device, "replay", replay)
    with pytest.raises(DriverError, match="lost"):
        trainer.train_step()
    assert trainer.step_back() == kept


@pytest.mark.parametrize("capacity", [False, True])
def test_a_photograph_is_kept_until_its_launches_have_run(
    default_device: Device, monkeypatch: pytest.MonkeyPatch, capacity: bool
) -> None:
    """Its buffer may be the host's memory, and the next size of photographs takes its place."""
    monkeypatch.setenv(BY_CAPACITY_VARIABLE, str(int(capacity)))
    trainer = bench_stages.trainer_of(bench_subject.synthetic(200, 80, 60), default_device, RasterizerConfig())
    run_steps(12, trainer)
    trainer.train_step()
    kept = trainer.pending._steps[-1].kept if capacity else default_device.under_way
    assert any(isinstance(each, cl.Buffer) for each in kept)


class _Looks(Adaptive):
    """A strategy that looks at the model after each step."""

    def after_gradient(self, model: ModelState) -> RowPlan | None:
        return None if np.isfinite(model.parameters["means"].get()).all() else RowPlan()


def test_what_is_looked_at_or_tight_is_exact(
    default_device: Device, scene: Scene, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setenv(BY_CAPACITY_VARIABLE, "1")
    asked: list[int] = []
    noted(monkeypatch, SpeculativeSteps, "launch", lambda _, run, room, **options: asked.append(room))
    pairs = short(rasterizer=BenchSwitches(depth_sort="pairs"))
    trainers = [
        Trainer(scene, CONFIG, default_device, strategy=_Looks),
        Trainer(scene, CONFIG, default_device.with_memory_limit(50 << 20)),
        Trainer(scene, pairs, default_device),
    ]
    for trainer in trainers:
        run_steps(3, trainer)
    assert asked == [0] * 9
    trained_to(3, scene, CONFIG, default_device)
    assert asked[9] == 0 < asked[10], "the first step says how many pairs there are"


def test_the_default_is_the_kind_of_the_device(default_device: Device, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.delenv(BY_CAPACITY_VARIABLE, raising=False)
    assert by_capacity(default_device) == (default_device.kind != "cpu")
    monkeypatch.setenv(BY_CAPACITY_VARIABLE, "yes")
    refuses(f"{BY_CAPACITY_VARIABLE}=yes: expected 1, or 0", by_capacity, default_device)


def test_launches_come_from_tapes(device: Device, monkeypatch: pytest.MonkeyPatch) -> None:
    """Of all of a step, as long as the model stays."""
    monkeypatch.setenv(BY_CAPACITY_VARIABLE, "1")
    trainer = bench_stages.trainer_of(bench_subject.synthetic(200, 80, 60), device, RasterizerConfig())
    made: list[str] = []
    noted(monkeypatch, Device, "enqueue", lambda _, kernel, *given, **options: made.append(kernel.name))
    steps = []
    for _ in range(12):
        made.clear()
        trainer.train_step()
        steps.append(list(made))
    assert len(steps[2]) > 12
    assert steps[-3:] == [[]] * 3
    trainer.model.set(upload_gaussians(device, trainer.gaussians()))  # as density control does
    made.clear()
    trainer.train_step()
    assert len(made) > 12
