# SPDX-License-Identifier: Apache-2.0
"""A driver that aborts, hangs, or makes programs without kernels takes no process of ours down, whatever verb it is.

The driver is a stand-in, `stand_in/sitecustomize.py`, in the processes that try kernels before we do. Were a kernel
built here first, these tests would be the ones to end.
"""

from __future__ import annotations

import json
import os
import sys
from collections.abc import Callable
from dataclasses import replace
from pathlib import Path

import pytest
from calls import Capture, train
from drivers import KEPT
from tiny import CONFIG, short

from clsplat.cli import main
from clsplat.config import OptimiserConfig, TrainConfig
from clsplat.device import context, known, rehearsal
from clsplat.device.child import REGARDLESS, TIMEOUT, Child
from clsplat.device.context import Device
from clsplat.device.program import build, variant_of
from clsplat.device.shapes import shapes_in_turn
from clsplat.errors import DriverError

ALWAYS = 10**6
"""More texts than are ever built."""
Standing = Callable[..., Path]


@pytest.fixture
def standing(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> Standing:
    """A driver that is not known yet. Called with HOW, FIRST and LAST it begins to misbehave."""
    monkeypatch.setenv("XDG_CACHE_HOME", str(tmp_path / "cache"))
    monkeypatch.delenv(REGARDLESS)
    monkeypatch.delenv("CLSPLAT_SHAPE", raising=False)
    monkeypatch.setenv("PYTHONPATH", str(Path(__file__).with_name("stand_in")))
    numbers = tmp_path / "numbers"

    def misbehave(how: str, first: int, last: int = ALWAYS) -> Path:
        monkeypatch.setenv("CLSPLAT_STAND_IN", f"{how} {first} {last} {numbers}")
        _forget()
        return numbers

    yield misbehave
    _forget()


def _forget() -> None:
    """Begin as a new process: no kernels are built, and none are tried by one that has the driver of before."""
    for process in rehearsal._processes.values():
        process.close()
    context._open.cache_clear()


VERBS = {
    "train": "train {scene} -o {new} --iterations 3",
    "eval": "eval {run}",
    "render": "render {run} --cameras {scene} -o {new}/####.exr --channels rgb,alpha,depth",
    "view": "view {run} --port 0",
    "bench": "bench --gaussians 300 --size 64x48 --repeat 1",
    "tune": "tune",
    "selftest": "selftest --device {device}",
    "convert": "convert {run} {new}.ply --prune-contribution 0.01 --cameras {scene}",
    "demo": "demo -o {new}",
}


def call(verb: str, scene: Path, run: Path, new: Path) -> int:
    given = {"scene": scene, "run": run, "new": new, "device": min(KEPT)}
    return main([word.format(**given) for word in VERBS[verb].split()])


def error_of(capsys: Capture) -> str:
    """The one line of error."""
    said = capsys.readouterr().err
    assert "Traceback" not in said
    (line,) = [line for line in said.splitlines() if line.startswith("clsplat: error: ")]
    assert said.splitlines()[-1] == line
    return line


SLOW = [pytest.param(how, verb, marks=pytest.mark.slow) for how in ("hang", "empty", "launch") for verb in VERBS]
QUICK = [("abort", verb) for verb in VERBS]


@pytest.mark.parametrize(("how", "verb"), [*QUICK, *SLOW])
def test_a_driver_that_fails_in_every_shape(
    how: str, verb: str, standing: Standing, scene: Path, trained: Path, tmp_path: Path, default_device: Device,
    capsys: Capture, monkeypatch: pytest.MonkeyPatch,
) -> None:  # fmt: skip
    standing(how, 1)
    if how == "hang":
        monkeypatch.setenv(TIMEOUT, "4")  # it does not come; what does come takes well under a second
        device = default_device.cl_device
        others = [shape.label for shape in shapes_in_turn(device) if shape != default_device.shape]
        for label in others:  # one shape is enough to wait for
            known.remember(device, label, failed="it hung before")
    before = {path: path.read_bytes() for path in trained.rglob("*") if path.is_file()}
    new = tmp_path / "new"
    assert call(verb, scene, trained, new) == 1
    line = error_of(capsys)
    assert default_device.name in line
    if verb not in ("tune", "selftest"):  # those have a table or a list of shapes
        assert "shape" in line
        assert ".cl" in line
    assert not new.exists()
    assert {path: path.read_bytes() for path in trained.rglob("*") if path.is_file()} == before


@pytest.mark.parametrize(
    ("how", "verb"),
    [("launch", "eval"), *(pytest.param(how, "bench", marks=pytest.mark.slow) for how in ("abort", "hang"))],
)
def test_another_shape_is_taken(
    how: str, verb: str, standing: Standing, scene: Path, trained: Path, tmp_path: Path, default_device: Device,
    capsys: Capture, monkeypatch: pytest.MonkeyPatch,
) -> None:  # fmt: skip
    monkeypatch.setenv(TIMEOUT, "20" if how == "hang" else "120")
    standing(how, 4, 4)
    label = default_device.shape.label
    assert call(verb, scene, trained, tmp_path / "new") == 0
    (warning,) = [line for line in capsys.readouterr().err.splitlines() if "warning" in line]
    assert f"kernels in the shape {label} failed: " in warning
    assert ".cl" in warning
    assert "is taken" in warning
    # the next process begins with it
    failed = known.entries(default_device.cl_device)[label].failed
    assert failed in warning
    assert main(["devices", "--json"]) == 0
    found = json.loads(capsys.readouterr().out)
    assert found[min(KEPT)]["shape"] != f"{label.replace('x', ' lanes x ')} items"


def test_a_program_without_kernels_is_built_anew(
    standing: Standing, scene: Path, trained: Path, tmp_path: Path, capsys: Capture
) -> None:
    numbers = standing("empty", 3, 3)
    assert call("eval", scene, trained, tmp_path / "new") == 0
    assert "warning" not in capsys.readouterr().err
    assert len(numbers.read_text().splitlines()) > 5


def test_what_failed_is_not_waited_for_twice(standing: Standing, monkeypatch: pytest.MonkeyPatch) -> None:
    standing("abort", 1)
    device = context.open_device()
    with pytest.raises(DriverError, match="signal 6"):
        device.kernels("scan")
    monkeypatch.setattr(rehearsal._Process, "ask", lambda *_: pytest.fail("it was tried again"))
    with pytest.raises(DriverError, match="signal 6"):
        device.kernels("scan")


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
    code = "import sys, time; from clsplat.device.child import *; end_with_parent(); sys.stdout.write('half a line'); "
    code += "tell(said=1); time.sleep(600)"
    child = Child([sys.executable, "-c", code])
    assert child.receive(60) == {"said": 1}
    assert child._process.stdin is not None
    child._process.stdin.close()  # as the system does for a parent that is killed
    assert child._process.wait(timeout=60) == 1
    child.close()


@pytest.mark.skipif(os.name == "nt", reason="a process that is killed has no status of its own there")
def test_what_the_system_kills_is_not_the_drivers_fault(
    standing: Standing, default_device: Device, scene: Path, trained: Path, tmp_path: Path, capsys: Capture
) -> None:
    standing("kill", 1)
    assert call("eval", scene, trained, tmp_path / "new") == 1
    assert "its test could not be made: the process was ended by signal 9 in probe.cl" in error_of(capsys)
    device = context.open_device()
    with pytest.raises(DriverError, match=r"probe\.cl the process that tried it was ended by signal 9"):
        device.kernels("scan")
    assert not any(entry.failed for entry in known.entries(default_device.cl_device).values())


def test_what_failed_in_every_shape_is_tried_anew(
    standing: Standing, default_device: Device, scene: Path, trained: Path, tmp_path: Path, capsys: Capture
) -> None:
    """Its reason may be gone, and nobody shall have to find out where it is remembered."""
    standing("abort", ALWAYS)
    device = default_device.cl_device
    for shape in shapes_in_turn(device):
        known.remember(device, shape.label, failed="it did once")
    assert call("eval", scene, trained, tmp_path / "new") == 0
    assert "warning" not in capsys.readouterr().err
    assert known.entries(device)[default_device.shape.label].failed == ""


LATE = replace(
    short(iterations=16, checkpoint_every=5), optimiser=OptimiserConfig(means_rate_steps=400, sh_rest_every=3)
)
"""Kernels of it are built and launched for the first time after ten steps and more: rows move, SH is left out."""


def number_of(name: str, numbers: Path) -> int:
    """Of the first text or kernel of this name."""
    return next(number for number, line in enumerate(numbers.read_text().splitlines(), 1) if name in line)


@pytest.mark.parametrize(
    ("how", "name"), [("launch", "gather_rows"), pytest.param("abort", "NO_SH_REST", marks=pytest.mark.slow)]
)
def test_training_goes_on_after_a_late_failure(
    how: str, name: str, standing: Standing, scene: Path, tmp_path: Path, default_device: Device, capsys: Capture,
    monkeypatch: pytest.MonkeyPatch,
) -> None:  # fmt: skip
    numbers = standing(how, ALWAYS)
    assert train(scene, tmp_path / "whole", LATE) == 0
    latest = number_of(name, numbers)
    known.memory_path().unlink()
    run = tmp_path / "run"
    standing(how, latest, latest)
    assert train(scene, run, LATE) == 1
    line = error_of(capsys)
    assert f"kernels in the shape {default_device.shape.label}: " in line
    assert ".cl" in line
    assert list((run / "checkpoints").iterdir())
    assert not (run / "model.ply").exists()
    assert not list(run.rglob("*.clsplat-tmp"))
    monkeypatch.delenv("CLSPLAT_STAND_IN")
    _forget()
    assert main(["train", "-o", str(run), "--resume"]) == 0
    assert "is taken" in capsys.readouterr().err
    assert (run / "model.ply").exists()
    assert (run / "eval.json").exists()


@pytest.mark.slow
def test_what_was_mended_gives_the_same_bytes(
    standing: Standing, scene: Path, tmp_path: Path, default_device: Device, monkeypatch: pytest.MonkeyPatch
) -> None:
    numbers = standing("launch", ALWAYS)
    assert train(scene, tmp_path / "whole", LATE) == 0
    latest = number_of("gather_rows", numbers)
    known.memory_path().unlink()
    standing("launch", latest, latest)
    assert train(scene, tmp_path / "run", LATE) == 1
    monkeypatch.delenv("CLSPLAT_STAND_IN")
    _forget()
    assert main(["selftest", "--device", str(min(KEPT))]) == 0
    assert known.entries(default_device.cl_device)[default_device.shape.label].failed == ""
    assert main(["train", "-o", str(tmp_path / "run"), "--resume"]) == 0
    models = [(tmp_path / name / "model.ply").read_bytes() for name in ("whole", "run")]
    assert models[0] == models[1]


def test_what_has_worked_is_not_tried_again(
    standing: Standing, scene: Path, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    config = TrainConfig(iterations=3, report=False)
    standing("abort", ALWAYS)
    assert train(scene, tmp_path / "first", config) == 0
    _forget()
    monkeypatch.setattr(rehearsal._Process, "ask", lambda *_: pytest.fail("a kernel that is known was tried"))
    assert train(scene, tmp_path / "second", config) == 0
    first, second = ((tmp_path / name / "model.ply").read_bytes() for name in ("first", "second"))
    assert first == second


@pytest.mark.parametrize("text", ["soon", "0", "-1", "nan", "1e9"])
def test_a_time_that_makes_no_sense(
    text: str, standing: Standing, capsys: Capture, monkeypatch: pytest.MonkeyPatch
) -> None:
    standing("abort", ALWAYS)
    monkeypatch.setenv(TIMEOUT, text)
    assert main(VERBS["bench"].split()) == 2
    assert f"{TIMEOUT}={text}: expected seconds" in error_of(capsys)


def test_a_text_that_no_cache_has(default_device: Device) -> None:
    """The salt is seen by the compiler, not only by us: PoCL looks for what the preprocessor leaves of a text."""
    values = {"LANES": default_device.shape.lanes, "ITEMS": default_device.shape.items}
    variant = variant_of("scan", values, "-cl-std=CL1.2")
    salted = variant.anew("abc")
    assert "anew_abc" in salted.source.splitlines()[-1]
    assert not salted.source.splitlines()[-1].lstrip().startswith("//")
    assert variant.anew("") is variant
    program, salt = build(default_device.context, default_device.cl_device, salted)
    assert program.num_kernels == 3
    assert salt == ""


def test_the_quick_scene_has_late_kernels() -> None:
    assert LATE.checkpoint_every < CONFIG.density.start < LATE.iterations
