# SPDX-License-Identifier: Apache-2.0
"""A driver that aborts, hangs, or makes programs without kernels takes no process of ours down, whatever verb it is.

The driver is a stand-in, `stand_in/sitecustomize.py`, in the processes that try kernels before we do. Were a kernel
built here first, these tests would be the ones to end.
"""

from __future__ import annotations

import json
import os
import sys
from pathlib import Path

import pytest
from calls import Capture, printed, ran, refuses, train
from dying import ALWAYS, DRIVER, LATE, VERBS, Standing, call, error_of, forget
from tiny import CONFIG

from clsplat.cli.main import main
from clsplat.config.training import TrainConfig
from clsplat.device import sandbox, selection
from clsplat.device.context import Device
from clsplat.device.drivers import driver_records
from clsplat.device.drivers.shapes import shapes_in_turn
from clsplat.device.drivers.worker_process import DRIVER_TIMEOUT_VARIABLE, WorkerProcess
from clsplat.device.program import build, variant_of
from clsplat.errors import DriverError

ABORTS = [("abort", verb) for verb in VERBS]
OTHERS = {
    "hang": ("train", "tune", "selftest"),
    "empty": ("render", "bench", "selftest"),
    "launch": ("eval", "convert", "selftest"),
}
"""Verbs for the other ways to fail: those with a list of shapes or a table, and each of the rest with one of them."""
IN_EVERY_SHAPE = {("abort", "train"), ("empty", "render"), ("launch", "eval"), ("abort", "tune")}
"""Failures that are tried in every shape, each in a process of a second. The others are tried in one: shapes are chosen
before a verb begins its work, and tune has a list of them."""


@pytest.mark.slow
@pytest.mark.parametrize(("how", "verb"), [*ABORTS, *((how, verb) for how, verbs in OTHERS.items() for verb in verbs)])
def test_a_driver_that_fails_in_every_shape(
    how: str, verb: str, standing: Standing, scene: Path, trained: Path, tmp_path: Path, standing_device: Device,
    capsys: Capture, monkeypatch: pytest.MonkeyPatch,
) -> None:  # fmt: skip
    standing(how, 1)
    if how == "hang":
        monkeypatch.setenv(DRIVER_TIMEOUT_VARIABLE, "4")  # it does not come; what does come takes well under a second
    if (how, verb) not in IN_EVERY_SHAPE:
        device = standing_device.cl_device
        for shape in shapes_in_turn(device):
            if shape != standing_device.shape:
                driver_records.remember(device, shape.label, failed="it failed before")
    before = {path: path.read_bytes() for path in trained.rglob("*") if path.is_file()}
    new = tmp_path / "new"
    assert call(verb, scene, trained, new) == 1
    line = error_of(capsys)
    assert standing_device.name in line
    if verb not in ("tune", "selftest"):  # those have a table or a list of shapes
        assert "shape" in line
        assert ".cl" in line
    assert not new.exists()
    assert {path: path.read_bytes() for path in trained.rglob("*") if path.is_file()} == before


@pytest.mark.slow
@pytest.mark.parametrize(
    ("how", "verb"),
    [("launch", "eval"), ("hang", "bench")],
)
def test_another_shape_is_taken(
    how: str, verb: str, standing: Standing, scene: Path, trained: Path, tmp_path: Path, standing_device: Device,
    capsys: Capture, monkeypatch: pytest.MonkeyPatch,
) -> None:  # fmt: skip
    """After an abort too, in test_late_drivers.py."""
    monkeypatch.setenv(DRIVER_TIMEOUT_VARIABLE, "20" if how == "hang" else "120")
    # The third text names the number of lanes. The fourth, duplicate.cl, is the same in all shapes with lanes, which
    # therefore fail one after the other; where the driver hangs, each takes the time limit.
    number = 3 if how == "hang" else 4
    standing(how, number, number)
    label = standing_device.shape.label
    assert call(verb, scene, trained, tmp_path / "new") == 0
    (warning,) = [line for line in capsys.readouterr().err.splitlines() if "warning" in line]
    assert f"kernels in the shape {label} failed: " in warning
    assert ".cl" in warning
    assert "is used instead" in warning
    # the next process begins with it
    failed = driver_records.entries(standing_device.cl_device)[label].failed
    assert failed in warning
    found = json.loads(printed(capsys, ["devices", "--json"]).out)
    assert found[DRIVER]["shape"] != f"{label.replace('x', ' lanes x ')} items"


@pytest.mark.slow
def test_a_program_without_kernels_is_built_anew(
    standing: Standing, scene: Path, trained: Path, tmp_path: Path, capsys: Capture
) -> None:
    numbers = standing("empty", 3, 3)
    assert "warning" not in ran(capsys, call, "eval", scene, trained, tmp_path / "new").err
    assert len(numbers.read_text().splitlines()) > 5


@pytest.mark.slow
@pytest.mark.parametrize(
    "number", [1, pytest.param(4, marks=pytest.mark.slow), pytest.param(9, marks=pytest.mark.slow)]
)
def test_a_process_that_ended_once_is_no_failure(
    number: int, standing: Standing, standing_device: Device, scene: Path, trained: Path, tmp_path: Path,
    capsys: Capture,
) -> None:  # fmt: skip
    """A driver aborts where its linker is killed, by a Ctrl-C or for want of memory."""
    standing("once", number, number)
    assert "warning" not in ran(capsys, call, "eval", scene, trained, tmp_path / "new").err
    assert not any(entry.failed for entry in driver_records.entries(standing_device.cl_device).values())


def test_what_failed_is_not_waited_for_twice(standing: Standing, monkeypatch: pytest.MonkeyPatch) -> None:
    standing("abort", 1)
    device = selection.open_device()
    refuses("signal 6", device.kernels, "scan", error=DriverError)
    monkeypatch.setattr(sandbox._Process, "ask", lambda *_: pytest.fail("it was tried again"))
    refuses("signal 6", device.kernels, "scan", error=DriverError)


@pytest.mark.slow
def test_modules_of_the_folder_that_we_are_in_are_not_taken(
    standing: Standing, scene: Path, trained: Path, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    """A scene that was downloaded may have a file of any name."""
    for name in ("secrets", "numpy", "queue", "clsplat"):
        (tmp_path / f"{name}.py").write_text("raise SystemExit('taken from here')\n", encoding="utf-8")
    monkeypatch.chdir(tmp_path)
    standing("abort", ALWAYS)
    assert call("eval", scene, trained, tmp_path / "new") == 0


def test_a_child_ends_with_its_parent_and_is_heard_whatever_else_is_said(tmp_path: Path) -> None:
    code = "import sys, time; from clsplat.device.drivers.worker_process import *; end_with_parent(); "
    code += "sys.stdout.write('half a line'); tell(said=1); time.sleep(600)"
    child = WorkerProcess([sys.executable, "-c", code])
    assert child.receive(60) == {"said": 1}
    assert child._process.stdin is not None
    child._process.stdin.close()  # as the system does for a parent that is killed
    assert child._process.wait(timeout=60) == 1
    child.close()


@pytest.mark.skipif(os.name == "nt", reason="a process that is killed has no status of its own there")
def test_what_the_system_kills_is_not_the_drivers_fault(
    standing: Standing, standing_device: Device, scene: Path, trained: Path, tmp_path: Path, capsys: Capture
) -> None:
    standing("kill", 1)
    assert call("eval", scene, trained, tmp_path / "new") == 1
    assert "its driver could not be tested: the process was ended by signal 9 in probe.cl" in error_of(capsys)
    assert not any(entry.failed for entry in driver_records.entries(standing_device.cl_device).values())


@pytest.mark.slow
@pytest.mark.parametrize(
    "how", [pytest.param("kill", marks=pytest.mark.skipif(os.name == "nt", reason="it has no signals")), "memory"]
)
def test_a_trial_that_there_is_no_memory_for_is_left_out(
    how: str, standing: Standing, standing_device: Device, monkeypatch: pytest.MonkeyPatch
) -> None:
    """That is no sign of a bad driver; nor is it tried at every launch, or told of more than once."""
    standing(how, 1)
    with pytest.warns(UserWarning, match="not enough memory to try every kernel") as told:
        selection.open_device().kernels("scan")
    assert sum("not enough memory" in str(each.message) for each in told) == 1
    assert not any(
        entry.failed or entry.kernels for entry in driver_records.entries(standing_device.cl_device).values()
    )
    monkeypatch.setattr(sandbox._Process, "ask", lambda *_: pytest.fail("it was tried again"))
    selection.open_device()._built("scan", selection.open_device()._fma[0])


@pytest.mark.slow
def test_what_failed_in_every_shape_is_tried_anew(
    standing: Standing, standing_device: Device, scene: Path, trained: Path, tmp_path: Path, capsys: Capture
) -> None:
    """Its reason may be gone, and nobody shall have to find out where it is remembered."""
    standing("abort", ALWAYS)
    device = standing_device.cl_device
    for shape in shapes_in_turn(device):
        driver_records.remember(device, shape.label, failed="it did once")
    assert "warning" not in ran(capsys, call, "eval", scene, trained, tmp_path / "new").err
    assert driver_records.entries(device)[standing_device.shape.label].failed == ""


@pytest.mark.slow
def test_what_has_worked_is_not_tried_again(
    standing: Standing, scene: Path, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    config = TrainConfig(iterations=3, report=False)
    standing("abort", ALWAYS)
    assert train(scene, tmp_path / "first", config) == 0
    forget()
    monkeypatch.setattr(sandbox._Process, "ask", lambda *_: pytest.fail("a kernel that is known was tried"))
    assert train(scene, tmp_path / "second", config) == 0
    first, second = ((tmp_path / name / "model.ply").read_bytes() for name in ("first", "second"))
    assert first == second


@pytest.mark.parametrize("text", ["soon", "0", "-1", "nan", "1e9"])
def test_a_time_that_makes_no_sense(
    text: str, standing: Standing, capsys: Capture, monkeypatch: pytest.MonkeyPatch
) -> None:
    standing("abort", ALWAYS)
    monkeypatch.setenv(DRIVER_TIMEOUT_VARIABLE, text)
    assert main(VERBS["bench"].split()) == 2
    assert f"{DRIVER_TIMEOUT_VARIABLE}={text}: expected seconds" in error_of(capsys)


def test_a_text_that_no_cache_has(standing_device: Device) -> None:
    """The salt is seen by the compiler, not only by us: PoCL looks for what the preprocessor leaves of a text."""
    values = {"LANES": standing_device.shape.lanes, "ITEMS": standing_device.shape.items}
    variant = variant_of("scan", values, "-cl-std=CL1.2")
    salted = variant.anew("abc")
    assert "anew_abc" in salted.source.splitlines()[-1]
    assert not salted.source.splitlines()[-1].lstrip().startswith("//")
    assert variant.anew("") is variant
    program, salt = build(standing_device.context, standing_device.cl_device, salted)
    assert program.num_kernels == 2
    assert salt == ""


def test_the_quick_scene_has_late_kernels() -> None:
    assert LATE.checkpoint_every < CONFIG.density.start < LATE.iterations
