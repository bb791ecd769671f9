# SPDX-License-Identifier: Apache-2.0
"""Steps of several views: their gradients and rates, and that devices which share them change no byte."""

from __future__ import annotations

import time
from collections.abc import Callable
from dataclasses import replace
from functools import cache
from pathlib import Path
from threading import Event
from typing import Any

import numpy as np
import pytest
from calls import noted, refuses
from compare import assert_close, assert_same_arrays
from tiny import CONFIG, short

from clsplat.api import train
from clsplat.config.training import OptimiserConfig, TrainConfig
from clsplat.device.context import Device
from clsplat.device.selection import open_devices
from clsplat.errors import DeviceError, DriverError, InputError
from clsplat.gaussians import PARAMETER_GROUPS
from clsplat.reference.adam import adam as reference
from clsplat.reference.adam import add_views
from clsplat.runs.run import Run
from clsplat.scenes.scene import Scene
from clsplat.stages.adam import AdamStep
from clsplat.stages.device_gaussians import allocate_gaussians
from clsplat.training.batches import batch
from clsplat.training.batches.batch import Batch, shares
from clsplat.training.batches.replica import Replica, ViewOutcome
from clsplat.training.learning_rates import scaled, scaled_rates
from clsplat.training.step.gradient_step import GradientStep, StepProbe, slot_fields
from clsplat.training.step.inputs import StepRows
from clsplat.training.trainer import Trainer

TWO = short(batch=2, iterations=40)


@cache
def halves(index: int) -> list[Device]:
    """Both halves of a device; the test is left out where it has none."""
    try:
        return open_devices(f"{index}/0,{index}/1")
    except DeviceError as error:
        pytest.skip(str(error))


def slow(method: Callable[..., Any], seconds: float) -> Callable[..., Any]:
    """The method, which takes longer."""

    def call(*arguments: Any, **named: Any) -> Any:
        time.sleep(seconds)
        return method(*arguments, **named)

    return call


@pytest.mark.slow
@pytest.mark.parametrize("late", ["neither", "first", "second"])
def test_halves_of_a_device_train_to_the_bytes_of_the_whole(
    scene: Scene, device: Device, late: str, monkeypatch: pytest.MonkeyPatch
) -> None:
    devices = halves(device.index)
    wanted = train(scene, TWO, device=device)
    if late == "first":
        monkeypatch.setattr(Batch, "_view", slow(Batch._view, 0.01))
    if late == "second":
        monkeypatch.setattr(Replica, "view", slow(Replica.view, 0.01))
    assert_same_arrays(train(scene, TWO, device=devices).arrays(), wanted.arrays())


@pytest.mark.slow
@pytest.mark.parametrize(
    "config",
    [
        short(batch=4, iterations=22, background="random"),  # the last step has two views
        short(batch=2, iterations=22, optimiser=replace(CONFIG.optimiser, sparse=True)),
        short(batch=2, iterations=22, optimiser=replace(CONFIG.optimiser, sh_rest_every=4), sh_degree_every=4),
        short(batch=2, iterations=22, density={"min_contribution": 0.01, "prune_every": 7, "absolute_gradients": True}),
    ],
    ids=["four", "sparse", "sh_rest", "contributions"],
)
def test_the_number_of_devices_changes_no_byte(scene: Scene, default_device: Device, config: TrainConfig) -> None:
    wanted = train(scene, config, device=default_device)
    assert_same_arrays(train(scene, config, device=halves(default_device.index)).arrays(), wanted.arrays())


@pytest.mark.slow
def test_little_memory_changes_no_byte(scene: Scene, default_device: Device) -> None:
    """With parameters streamed on both devices."""
    config = short(batch=2, iterations=24, random_points=2000)
    scene = replace(scene, points=scene.points[:0], point_colors=scene.point_colors[:0])
    plans = []
    wanted = train(scene, config, device=default_device)
    got = train(
        scene,
        config,
        device=halves(default_device.index),
        max_device_mem="1500KiB",
        on_plan=lambda plan: plans.append(plan.streamed),
    )
    assert any(plans)
    assert_same_arrays(got.arrays(), wanted.arrays())


def test_without_being_told_a_batch_has_a_view_for_each_device(scene: Scene, default_device: Device) -> None:
    devices = halves(default_device.index)
    wanted = train(scene, short(iterations=12, batch=2))
    assert_same_arrays(train(scene, short(iterations=12), device=devices).arrays(), wanted.arrays())
    refuses(r"--batch 3: expected a multiple of 2, the number of devices", train, scene, short(batch=3), device=devices)
    refuses("expected open devices", train, scene, short(), device=[])


def test_a_run_goes_on_with_its_batch_on_any_devices(scene: Scene, default_device: Device, tmp_path: Path) -> None:
    wanted = train(scene, TWO, device=default_device)
    devices = halves(default_device.index)
    run = Run.create(tmp_path / "run", short(iterations=40))
    config = replace(run.config, checkpoint_every=7)

    def stop(trainer: Trainer, _: Callable[[], bool]) -> None:
        if trainer.step == 18:
            raise RuntimeError("stop here")

    refuses("stop here", train, scene, config, device=devices, run=run, between=stop, error=RuntimeError)
    assert [step for step, _ in run.checkpoints()] == [8, 14], "the first steps that have come to 7 and 14"
    assert run.config.batch == 2
    again = Run.create(run.path, Run.open(run.path).config, resume=True)
    assert_same_arrays(train(scene, None, device=default_device, run=again, resume=True).arrays(), wanted.arrays())
    one = Run.create(tmp_path / "one", short(iterations=2))
    train(scene, None, device=default_device, run=one)
    with pytest.raises(InputError, match="--batch 1: expected a multiple of 2"):
        train(scene, replace(one.config, iterations=4), device=devices, run=one, resume=True)


def test_steps_are_counted_in_views(scene: Scene, default_device: Device, tmp_path: Path) -> None:
    """Work that comes by steps comes with the first step that has come so far, once."""
    config = short(batch=3, iterations=40, eval_at=(20,), report=False)
    run = Run.create(tmp_path / "run", config)
    due: list[int] = []
    counted: list[int] = []

    def note(trainer: Trainer, _: Callable[[], bool]) -> None:
        if trainer.step == 0:
            before_step = trainer.strategy.before_step

            def noted(model: Any) -> Any:
                due.append(model.step)
                return before_step(model)

            trainer.strategy.before_step = noted  # type: ignore[method-assign]
        counted.append(trainer.step)

    train(scene, config, device=default_device, run=run, between=note)
    assert counted == list(range(0, 40, 3))
    assert due == [15, 20, 25, 30, 35]
    records = run.read_metrics()
    assert [record["step"] for record in records] == [12, 21, 30, 40]
    assert [record["step"] for record in records if "eval" in record] == [21]


def test_the_rates_of_a_batch() -> None:
    """Moments lose as much from view to view as without a batch, and are corrected for as much; rates grow by the root
    (Zhao et al. 2024)."""
    config, batch, rates = OptimiserConfig(sh_rest_every=16), 4, {"means": 1.0}
    steps = scaled(config, batch)
    assert (steps.beta1, steps.beta2) == (config.beta1**4, config.beta2**4)
    assert steps.sh_rest_every == 4
    assert scaled(config, 1) == config
    for views in (4, 400):
        got, wanted = (AdamStep(*step, rates).corrected("means") for step in ((steps, views // batch), (config, views)))
        np.testing.assert_allclose(got, wanted, rtol=1e-12)  # rounding of powers
    assert scaled_rates({"means": 3.0}, 4) == {"means": 6.0}
    assert scaled(OptimiserConfig(), 4).sh_rest_every == 1


def test_views_are_shared_evenly_and_in_order() -> None:
    assert [list(share) for share in shares(4, 2)] == [[0, 1], [2, 3]]
    assert [list(share) for share in shares(3, 2)] == [[0, 1], [2]]
    assert [list(share) for share in shares(1, 3)] == [[0], [], []]


class _Gradients(StepProbe):
    """The gradients of a view, as they are before Adam."""

    def before_rows(self, rows: StepRows) -> None:
        assert rows.gradients is not None
        self.seen = rows.projected.tile_counts.get() > 0
        self.values = {group: rows.gradients[group].get().astype(np.float64) for group in PARAMETER_GROUPS}


def test_a_step_is_that_of_the_sum_of_its_views_gradients(scene: Scene, default_device: Device) -> None:
    """Against the float64 twins, by gradients that a step of each view alone has."""
    batched, plain = (Trainer(scene, short(batch=batch), default_device) for batch in (2, 1))
    before = {group: plain.parameters[group].get().astype(np.float64) for group in PARAMETER_GROUPS}
    views = []
    for _ in range(2):
        alone = Trainer(scene, short(), default_device)
        alone.position.go_back(plain.position.mark())
        inputs, probe = alone._view_inputs(0), _Gradients()
        plain.position.go_back(alone.position.mark())
        room = allocate_gaussians(default_device, alone.parameters.count, 1, zero=True)
        step = GradientStep(
            default_device, alone.rasterizer, alone.config, 1, alone.rates(), slot_fields(alone.strategy.needs(1))
        )
        model = alone.model.with_moments
        step.run(model, inputs, probe, room)
        views.append(probe)
    batched.train_step()
    assert batched.step == 2
    optimiser = scaled(batched.config.optimiser, 2)
    for group, rate in scaled_rates(batched.rates(), 2).items():
        total = add_views([view.values[group] for view in views], [view.seen for view in views])
        zeros = np.zeros_like(total)
        constants = (optimiser.beta1, optimiser.beta2, optimiser.epsilon)
        wanted, first, _ = reference(before[group], total, zeros, zeros, 1, rate, *constants)
        # one addition and one step in float32, of which beta2's rounding is the most (see test_adam.py)
        assert_close(batched.parameters[group].get(), wanted, relative=1e-6, absolute=1e-4 * rate)
        assert_close(
            batched.model.first[group].get(), first, relative=1e-5, absolute=1e-5 * np.abs(first).max(initial=0)
        )


def test_trouble_on_a_further_device_ends_the_training(
    scene: Scene, default_device: Device, monkeypatch: pytest.MonkeyPatch
) -> None:
    devices, begun, ended = halves(default_device.index), Event(), Event()

    def fail(*_: Any, **__: Any) -> ViewOutcome:
        begun.set()
        time.sleep(0.05)
        ended.set()
        raise DriverError("the second device has failed")

    monkeypatch.setattr(Replica, "view", fail)
    refuses("the second device has failed", train, scene, TWO, device=devices, error=DriverError)

    def interrupted(*_: Any) -> None:
        begun.wait()
        raise KeyboardInterrupt

    monkeypatch.setattr(Batch, "_view", interrupted)
    begun.clear()
    ended.clear()
    with pytest.raises(KeyboardInterrupt):
        train(scene, TWO, device=devices)
    assert ended.is_set(), "the other device's view was waited for"


@pytest.mark.slow
def test_the_noise_of_a_batch_is_tried_before_anything_changes(
    scene: Scene, default_device: Device, monkeypatch: pytest.MonkeyPatch
) -> None:
    made: list[tuple[bool, float]] = []
    noted(monkeypatch, batch, "noise", lambda device, by, *_: made.append((device.only_tries, by.amount)))
    density = {"growth": "mcmc", "max_gaussians": 150}
    train(scene, short(batch=2, iterations=2, density=density), device=default_device)
    (amount,) = {each for _, each in made}
    assert amount > 0
    assert [tried for tried, _ in made] == [True, False]


def test_a_device_that_is_there_twice_is_refused(scene: Scene, default_device: Device) -> None:
    """Two threads would set arguments of the same kernels; a limit makes no other device of it."""
    for twin in (default_device, default_device.with_memory_limit(2**30)):
        with pytest.raises(InputError, match="two of them share a queue and kernels; open each device on its own"):
            train(scene, TWO, device=[default_device, twin])


def test_a_view_without_a_finite_loss_is_named(scene: Scene, default_device: Device) -> None:
    """Never a NaN in the model, and the view that had it is told, on either device."""
    for devices in ([default_device], halves(default_device.index)):
        trainer = Trainer(scene, short(batch=2, warmup=()), devices[0], further=devices[1:])
        trainer.train_step()
        order = [*trainer.position.queue]
        bad = order[-2]  # the second view of the next step
        photograph = trainer.photographs.load(bad, 1.0).astype(np.float32)
        photograph[3, 4] = np.nan
        trainer.photographs.host.replace(bad, 1.0, photograph)
        if devices[1:]:
            assert trainer.batch is not None
            trainer.batch.replicas[0].photographs._on_device.clear()
        trainer.photographs._on_device.clear()
        trainer.train_step()
        trainer.repair(look=True)
        (incident,) = trainer.monitor.incidents
        assert (incident.stage, incident.view) == ("loss", bad)
        assert all(np.isfinite(trainer.parameters[group].get()).all() for group in PARAMETER_GROUPS)
        trainer.close()
