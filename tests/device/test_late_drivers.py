# SPDX-License-Identifier: Apache-2.0
"""A driver that fails when the work has long begun: nothing of it is lost or half written."""

from __future__ import annotations

import shutil
from collections.abc import Mapping
from dataclasses import replace
from functools import partial
from pathlib import Path

import numpy as np
import pyopencl as cl
import pytest
from calls import Capture, noted, train
from compare import assert_same_arrays
from dying import ALWAYS, DRIVER, LATE, Standing, call, error_of, forget, number_of

from clsplat.api import train as train_on
from clsplat.cli.main import main
from clsplat.config.training import TrainConfig
from clsplat.device import buffers, launch
from clsplat.device.context import Device
from clsplat.device.drivers import driver_records
from clsplat.device.drivers.worker_process import DRIVER_TIMEOUT_VARIABLE, TrialInterrupted
from clsplat.errors import DriverError
from clsplat.gaussians import Gaussians
from clsplat.runs.run import Run
from clsplat.scenes.loading import load_scene
from clsplat.selftest import driver_check
from clsplat.training.step import monitor
from clsplat.training.supervision.view_loader import ViewLoader

WITHOUT = replace(LATE, checkpoint_every=0, optimiser=replace(LATE.optimiser, sparse=True), report=False)
"""Adam has a kernel for each number of floats in a row: that of SH is built in step 12, behind the others."""


def failing_at(monkeypatch: pytest.MonkeyPatch, name: str, error: BaseException) -> None:
    """What needs the text or the kernel of this name ends so, as where its trial does."""

    def kernels(_self, _stem, defines: Mapping[str, object] = {}, _registers: int = 0):
        if name in [f"{key}={value}" for key, value in defines.items()]:
            raise error

    def enqueue(_device, kernel, *_given):
        if name == kernel.name:
            raise error

    noted(monkeypatch, Device, "kernels", kernels)
    noted(monkeypatch, launch, "_enqueue", enqueue)


@pytest.fixture(scope="module")
def whole(scene: Path, default_device: Device) -> Gaussians:
    """The model of a training in which nothing failed."""
    return train_on(load_scene(scene), WITHOUT, device=default_device)


@pytest.mark.slow
@pytest.mark.parametrize(
    ("name", "step"),
    [
        ("gather_rows", 15),  # the first densification, at the beginning of step 16
        ("NO_SH_REST=True", 12),
        ("density_statistics", 0),
        ("interrupted NO_SH_REST=True", 12),
    ],
)
def test_nothing_is_lost(
    name: str, step: int, scene: Path, tmp_path: Path, default_device: Device, monkeypatch: pytest.MonkeyPatch,
    whole: Gaussians,
) -> None:  # fmt: skip
    loaded = load_scene(scene)
    error = TrialInterrupted() if "interrupted" in name else DriverError("it failed")
    run = Run.create(tmp_path / "run", WITHOUT, scene=scene)
    with monkeypatch.context() as patch:
        failing_at(patch, name.rsplit(maxsplit=1)[-1], error)
        with pytest.raises(type(error)) as raised:
            train_on(loaded, WITHOUT, device=default_device, run=run)
    assert [number for number, _ in run.checkpoints()] == ([step] if step else [])
    if step and isinstance(error, DriverError):
        assert str(raised.value).startswith(f"it failed; a checkpoint of step {step} is written: clsplat train -o ")
    resumed = train_on(loaded, WITHOUT, device=default_device, run=Run.open(run.path), resume=True)
    assert_same_arrays(resumed.arrays(), whole.arrays())


@pytest.mark.slow
@pytest.mark.parametrize("lost", [False, True])
def test_a_read_that_fails(
    lost: bool, scene: Path, tmp_path: Path, default_device: Device, monkeypatch: pytest.MonkeyPatch, whole: Gaussians
) -> None:
    """The failure of a kernel, or a device that is lost, often shows where the host reads."""
    run = Run.create(tmp_path / "run", replace(WITHOUT, checkpoint_every=5), scene=scene)
    copy, reads = cl.enqueue_copy, 0

    def copied(queue: cl.CommandQueue, into: object, *given: object, **how: object) -> cl.Event:
        nonlocal reads
        reads += isinstance(into, np.ndarray) and len(run.checkpoints()) == 2
        if isinstance(into, np.ndarray) and (reads == 3 or (lost and reads > 3)):  # a step reads once
            raise cl.RuntimeError("clEnqueueReadBuffer failed: OUT_OF_RESOURCES")
        return copy(queue, into, *given, **how)

    with monkeypatch.context() as patch, pytest.raises(DriverError) as raised:
        patch.setattr(buffers.cl, "enqueue_copy", copied)
        train_on(load_scene(scene), run.config, device=default_device, run=run)
    text = str(raised.value)
    assert "reading its memory failed (clEnqueueReadBuffer failed: OUT_OF_RESOURCES)" in text
    assert text.endswith(f"{run.resume_command} continues from {'the last checkpoint' if lost else 'it'}")
    assert ("; no checkpoint could be written (" in text) == lost
    resumed = train_on(load_scene(scene), run.config, device=default_device, run=Run.open(run.path), resume=True)
    assert_same_arrays(resumed.arrays(), whole.arrays())


@pytest.mark.slow
def test_an_epoch_that_has_just_begun(
    scene: Path, tmp_path: Path, default_device: Device, monkeypatch: pytest.MonkeyPatch
) -> None:
    """Contributions are of epochs: those of the last are put by where the next begins, in the middle of a step."""
    density = replace(WITHOUT.density, min_contribution=0.5)
    config, loaded = replace(WITHOUT, density=density), load_scene(scene)
    whole = train_on(loaded, config, device=default_device)
    run = Run.create(tmp_path / "run", config, scene=scene)
    first = 1 + len(loaded.train_views)

    load = ViewLoader.inputs

    def fails(loader, view, position, *arguments, **options):
        if position.step == first:
            raise DriverError("it failed")
        return load(loader, view, position, *arguments, **options)

    with monkeypatch.context() as patch:
        patch.setattr(ViewLoader, "inputs", fails)
        with pytest.raises(DriverError):
            train_on(loaded, config, device=default_device, run=run)
    assert [number for number, _ in run.checkpoints()] == [first - 1]
    resumed = train_on(loaded, config, device=default_device, run=Run.open(run.path), resume=True)
    assert len(resumed) == len(whole)
    assert np.array_equal(whole.means, resumed.means)


def test_what_is_half_changed_is_not_kept(
    scene: Path, tmp_path: Path, default_device: Device, monkeypatch: pytest.MonkeyPatch
) -> None:
    """A launch that fails although its trial did not, behind the first that changes rows."""
    run = Run.create(tmp_path / "run", WITHOUT, scene=scene)

    def fail(step, _rows):
        if step.number == 5 and step.changes.__self__.mark is None:
            raise DriverError("it failed")

    noted(monkeypatch, monitor.StepMonitor, "_add_rows", fail)
    with pytest.raises(DriverError) as raised:
        train_on(load_scene(scene), WITHOUT, device=default_device, run=run)
    assert str(raised.value) == "it failed"
    assert not run.checkpoints()


@pytest.mark.slow
@pytest.mark.parametrize(
    ("how", "name", "step", "config"),
    [("launch", "gather_rows", 15, WITHOUT), ("abort", "NO_SH_REST", 12, LATE)],
    ids=["a launch in a sparse step", "a build of a dense step"],
)
def test_the_checkpoint_of_a_late_failure(
    how: str, name: str, step: int, config: TrainConfig, standing: Standing, scene: Path, tmp_path: Path,
    standing_device: Device, capsys: Capture, monkeypatch: pytest.MonkeyPatch,
) -> None:  # fmt: skip
    """A resume takes another shape; once the failure is mended or forgotten, it ends with the same bytes."""
    numbers, run = standing(how, ALWAYS), tmp_path / "run"
    assert train(scene, tmp_path / "whole", config) == 0
    latest = number_of(name, numbers)
    driver_records.memory_path().unlink()
    standing(how, latest, latest)
    assert train(scene, run, config) == 1
    line = error_of(capsys)
    assert f"kernels in the shape {standing_device.shape.label}: " in line
    assert ".cl" in line
    assert f"; a checkpoint of step {step} is written: " in line
    names = [path.name for path in (run / "checkpoints").iterdir()]
    assert max(names) == f"step-{step:07}.npz"
    assert len(names) == 1 or config.checkpoint_every
    assert not (run / "model.ply").exists()
    assert not list(run.rglob("*.clsplat-tmp"))
    for copy in ("mended", "forgotten"):
        shutil.copytree(run, tmp_path / copy)
    monkeypatch.delenv("CLSPLAT_STAND_IN")

    def resume(name: str) -> bytes:
        forget()
        assert main(["train", "-o", str(tmp_path / name), "--resume"]) == 0
        return (tmp_path / name / "model.ply").read_bytes()

    resume("run")
    assert "is used instead" in capsys.readouterr().err
    assert (run / "eval.json").exists()
    with monkeypatch.context() as patch:  # one scene of the three tells as much here
        patch.setattr(driver_check, "examine", partial(driver_check.examine, quick=True))
        assert main(["selftest", "--device", str(DRIVER)]) == 0
    assert driver_records.entry(standing_device.cl_device, standing_device.shape.label).failed == ""
    whole = (tmp_path / "whole" / "model.ply").read_bytes()
    assert resume("mended") == whole
    driver_records.memory_path().unlink()
    assert resume("forgotten") == whole


@pytest.mark.slow
@pytest.mark.parametrize(("verb", "how"), [("render", "hang"), ("eval", "empty"), ("convert", "launch")])
def test_a_late_failure_of_other_verbs(
    verb: str, how: str, standing: Standing, scene: Path, trained: Path, tmp_path: Path, standing_device: Device,
    capsys: Capture, monkeypatch: pytest.MonkeyPatch,
) -> None:  # fmt: skip
    """The last kernel that they come to; what they would write is whole or not there."""
    numbers = standing("launch" if how == "launch" else "abort", ALWAYS)
    assert call(verb, scene, trained, tmp_path / "whole") == 0
    latest = len(numbers.read_text().splitlines())
    driver_records.memory_path().unlink()
    before = {path: path.read_bytes() for path in trained.rglob("*") if path.is_file()}
    standing(how, latest, latest)
    monkeypatch.setenv(DRIVER_TIMEOUT_VARIABLE, "8" if how == "hang" else "120")
    capsys.readouterr()
    status = call(verb, scene, trained, tmp_path / "new")
    if status == 0:  # the short self-test came by it, and took another shape; or it was built anew
        assert how == "empty" or "is used instead" in capsys.readouterr().err
    else:
        assert status == 1
        line = error_of(capsys)
        assert f"kernels in the shape {standing_device.shape.label}: " in line
        assert ".cl" in line
        assert not (tmp_path / "new.ply").exists()
        assert not list(tmp_path.rglob("*.clsplat-tmp"))
        assert {path: path.read_bytes() for path in trained.rglob("*") if path.is_file()} == before
