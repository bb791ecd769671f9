# SPDX-License-Identifier: Apache-2.0
"""A training that has no device memory left: a checkpoint, one line that says what to do, and a resume."""

from __future__ import annotations

from pathlib import Path
from typing import Any

import numpy as np
import pyopencl as cl
import pytest
from calls import Capture, noted, train
from same_bytes import model_bytes
from tiny import short, write_scene

from clsplat.api import train as train_on
from clsplat.cli.main import main
from clsplat.device import buffers
from clsplat.device.buffers import allocate
from clsplat.device.context import Device
from clsplat.errors import CapacityError
from clsplat.runs.run import Run
from clsplat.scenes.loading import load_scene
from clsplat.stages.density import gather
from clsplat.stages.device_gaussians import CopiedRows
from clsplat.training import moved_rows, trained_model
from clsplat.training.step.monitor import StepMonitor

GROWING = short(random_points=400, report=False, density={"gradient_threshold": 1e-4, "opacity_reset_every": 35})
"""A training whose number of Gaussians nearly doubles at each densification, every 5 steps from step 15."""
LIMIT = "500KiB"
"""Enough for the 400 Gaussians at the start and for the 694 after the first densification, but not for the second."""
USED_UP = cl.MemoryError("clCreateBuffer failed: MEM_OBJECT_ALLOCATION_FAILURE")


@pytest.fixture(scope="module")
def folder(tmp_path_factory: pytest.TempPathFactory) -> Path:
    """The scene's folder, without points."""
    return write_scene(tmp_path_factory.mktemp("growing") / "scene", points=False)


@pytest.fixture(scope="module")
def whole(folder: Path, default_device: Device, tmp_path_factory: pytest.TempPathFactory) -> bytes:
    """model.ply of a training with enough memory."""
    return model_bytes(load_scene(folder), GROWING, default_device, tmp_path_factory.mktemp("whole"))


def saved_steps(run: Path) -> list[int]:
    return [step for step, _ in Run.open(run).checkpoints()]


def test_a_limit_that_is_passed_at_a_densification(
    folder: Path, whole: bytes, default_device: Device, tmp_path: Path, capsys: Capture
) -> None:
    run = tmp_path / "run"
    assert train(folder, run, GROWING, "--max-device-mem", LIMIT) == 1
    line = capsys.readouterr().err.splitlines()[-1]
    before, _, after = line.partition("; with --density.max-gaussians ")
    count, _, after = after.partition(" the model grows no further; ")
    assert "Gaussians at this size of image need at least about " in before
    assert "but 500 KiB are allowed: allow more (--max-device-mem), or use a smaller resolution" in before
    (step,) = saved_steps(run)
    command = f"clsplat train -o {run} --resume --max-device-mem {LIMIT}"
    assert after == f"a checkpoint of step {step} is written: {command} continues from it"
    assert GROWING.density.start < step < GROWING.iterations

    with_more = tmp_path / "more"
    (with_more / "checkpoints").mkdir(parents=True)
    for path in (*run.glob("*.*"), *run.glob("checkpoints/*")):
        (with_more / path.relative_to(run)).write_bytes(path.read_bytes())
    assert model_bytes(load_scene(folder), GROWING, default_device, with_more, resume=True) == whole

    assert main([*command.split()[1:], "--density.max-gaussians", count]) == 0
    assert Run.open(run).config.density.max_gaussians == int(count)
    assert (run / "model.ply").exists()


@pytest.mark.parametrize("large", [False, True], ids=["small", "large"])
@pytest.mark.parametrize("on_host", [False, True], ids=["gathered by the device", "gathered by the host"])
def test_a_buffer_that_the_driver_refuses_while_rows_move(
    on_host: bool,
    large: bool,
    folder: Path,
    whole: bytes,
    default_device: Device,
    tmp_path: Path,
    monkeypatch: pytest.MonkeyPatch,
) -> None:
    """Another program may have taken memory that the plan counted on. The third group of the new rows finds none.

    large: the model's new rows are put behind those that they come from, and its chunks are streamed from a store.
    """
    if large:
        for module in (trained_model, moved_rows):
            monkeypatch.setattr(module, "ORDERED_ROWS", 100)
        whole = model_bytes(load_scene(folder), GROWING, default_device, tmp_path / "whole")
    run, arrays = Run.create(tmp_path / "run", GROWING, scene=folder), 0

    def moves(*_: object, **__: object) -> None:
        nonlocal arrays
        arrays = 1

    def buffer(context: cl.Context, flags: int, nbytes: int) -> Any:
        nonlocal arrays
        arrays += arrays > 0
        if arrays == 4:
            raise USED_UP
        return made(context, flags, nbytes)

    def gathered(device: Device, rows: Any, source: Any, **how: Any) -> Any:
        if on_host:
            allocate(device, (1,), np.float32)
        return gather(device, rows, source, **how)

    def copied(*arguments: Any) -> None:
        for _ in range(3):
            allocate(device, (1,), np.float32)
        to_store(*arguments)

    made, to_store = buffers._Buffer, CopiedRows.to_store
    device = default_device.with_memory_limit(600 * 1024 if on_host else None)
    with monkeypatch.context() as patch:
        noted(patch, trained_model, "try_gather", moves)
        patch.setattr(buffers, "_Buffer", buffer)
        patch.setattr(trained_model, "gather", gathered)
        patch.setattr(CopiedRows, "to_store", copied)
        with pytest.raises(CapacityError) as raised:
            train_on(load_scene(folder), GROWING, device=device, run=run)
    (step,) = saved_steps(run.path)
    text = str(raised.value)
    assert text.startswith(f"{device.name} has no memory left for a buffer of ")
    assert ": set --max-device-mem below " in text
    assert f"; a checkpoint of step {step} is written: {run.resume_command} continues from it" in text
    assert model_bytes(load_scene(folder), GROWING, default_device, run.path, resume=True) == whole


def test_a_kernel_that_finds_no_memory(default_device: Device) -> None:
    """Many drivers reserve a buffer's memory at its first use. The driver is then not at fault."""
    kernel, array = default_device.kernels("scan").scan_sums, allocate(default_device, (8,), np.float32)

    class Refusing:
        variant, name = kernel.variant, kernel.name

        @staticmethod
        def cl_kernel(*_: object) -> None:
            raise USED_UP

    with pytest.raises(CapacityError, match=r"has no memory left for scan_sums of scan\.cl, with .* in use: set --max"):
        default_device.enqueue(Refusing(), (1,), (1,), (array.buffer,))  # type: ignore[arg-type]


def test_a_step_that_has_changed_rows_leaves_the_last_checkpoint(
    folder: Path, default_device: Device, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    config = short(random_points=400, report=False, checkpoint_every=4, density={"every": 0})
    run = Run.create(tmp_path / "run", config, scene=folder)

    def fail(step: StepMonitor, *_: object) -> None:
        if step.number == 6:
            raise CapacityError("no memory")

    noted(monkeypatch, StepMonitor, "after_rows", fail)
    with pytest.raises(CapacityError) as raised:
        train_on(load_scene(folder), config, device=default_device, run=run)
    assert str(raised.value) == f"no memory; {run.resume_command} continues from the last checkpoint"
    assert saved_steps(run.path) == [4]
