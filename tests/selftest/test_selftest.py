# SPDX-License-Identifier: Apache-2.0
"""clsplat selftest: every driver here passes, a driver with one operation wrong does not, one that dies is told."""

from __future__ import annotations

import json
import re
import sys
from collections.abc import Sequence
from copy import copy
from pathlib import Path
from typing import Any

import numpy as np
import pytest
from broken_kernels import BROKEN
from calls import Capture, printed, raising, refuses, warned
from drivers import KEPT
from pipeline import DEFAULT, shaped
from quick import quick

import clsplat.stages
from clsplat.cli.main import main
from clsplat.device.context import Device, all_devices
from clsplat.device.drivers import driver_records
from clsplat.device.drivers.shapes import shape_of
from clsplat.device.drivers.worker_process import CHILD_MESSAGE_PREFIX, DRIVER_TIMEOUT_VARIABLE, TRUST_DRIVER_VARIABLE
from clsplat.device.program import BREAK_KERNEL_VARIABLE
from clsplat.device.selection import list_devices
from clsplat.errors import DeviceError
from clsplat.selftest import driver_check
from clsplat.selftest import result as stage_groups
from clsplat.selftest.driver_check import DriverReport, examine
from clsplat.selftest.harness import error_of
from clsplat.selftest.result import (
    CHANNEL_STAGES,
    FORWARD_STAGES,
    SELFTEST_STAGES,
    STAGE_BOUNDS_ULP,
    TRAINING_STAGES,
    Result,
)
from clsplat.selftest.scenes import keys, scenes
from clsplat.selftest.worker import DEFAULT_DEFINES, run

UNIONS = {"TRAINING_STAGES", "SELFTEST_STAGES", "INDEX_STAGES"}
"""Groups of stages that share some with the others."""


def condemned(device: Device, monkeypatch: pytest.MonkeyPatch, change: str, last: str) -> list[Result]:
    """What the last stage comes to, and those that it stands on, on the device with this change.

    The kernels of other files are the device's own: loading them took two thirds of the time.
    """
    monkeypatch.setenv(BREAK_KERNEL_VARIABLE, change)
    changed, whole = change.partition(":")[0], device._kernels
    broken = copy(device)
    broken._kernels = {key: kernels for key, kernels in whole.items() if key[0] != changed}
    groups = [stages for name, stages in vars(stage_groups).items() if name.endswith("_STAGES") and name not in UNIONS]
    group = next(stages for stages in groups if last in stages)
    before = () if group is FORWARD_STAGES else FORWARD_STAGES
    results = list(run(broken, quick=True, stages=(*before, *group[: group.index(last) + 1])))
    whole.update({key: kernels for key, kernels in broken._kernels.items() if key[0] != changed})
    return results


@pytest.mark.parametrize(
    "words",
    quick(
        BROKEN,
        "blend: before * alpha",
    ),
)
def test_one_wrong_operation_is_found(words: str, monkeypatch: pytest.MonkeyPatch, default_device: Device) -> None:
    change, stage = BROKEN[words]
    results = condemned(default_device, monkeypatch, f"{words} => {change}", stage)
    first = next(result for result in results if not result.passed)
    assert first.stage == stage
    assert first.trouble or first.ulp > 3 * first.bound


def test_every_stage_has_an_operation_that_is_broken() -> None:
    assert {stage for _, stage in BROKEN.values()} == set(SELFTEST_STAGES) == set(STAGE_BOUNDS_ULP)


@pytest.mark.slow
def test_in_every_shape(shaped_device: Device) -> None:
    results = list(run(shaped_device, quick=True))
    assert [result.stage for result in results] == list(SELFTEST_STAGES)
    assert [result for result in results if not result.passed] == []
    # All drivers here round as IEEE 754 has it.
    assert [result.stage for result in results if result.same_bits is not True] == []
    assert not any(result.otherwise for result in results)


@pytest.mark.slow
def test_all_scenes_in_the_other_shapes_of_a_cpu(default_device: Device) -> None:
    """Shapes that no driver here has as its own. In the drivers' own, tools/ci/digests.py compares larger frames."""
    others = {8, 16} - {shape_of(device)[0].lanes for device in all_devices()}
    results = [result for lanes in sorted(others) for result in run(shaped(default_device, lanes, 1))]
    assert len(results) == len(others) * len(SELFTEST_STAGES)
    assert [result for result in results if not (result.passed and result.same_bits)] == []


@pytest.mark.slow
def test_a_shape_without_a_stored_digest_is_no_failure(default_device: Device) -> None:
    stages = (*FORWARD_STAGES, "blend_grad")
    results = {result.stage: result for result in run(shaped(default_device, 1, 8), quick=True, stages=stages)}
    assert results["blend_grad"].passed
    assert results["blend_grad"].same_bits is None
    assert results["blend"].same_bits is True


SLOPPY = {
    "arithmetic: x / y": "(x / y) * 1.00000012f",
    "arithmetic: sqrt(y)": "(sqrt(y) * 1.00000012f)",
    "project: sqrt(p.syy / p.det)": "(sqrt(p.syy / p.det) * 1.0000003f)",
    "project: ((offset) / (length))": "((offset) / (length) * 0.9999998f)",
    "features: q[0] / length": "q[0] / length * 1.0000002f",
    "channels: sums[field][cell] / by": "sums[field][cell] / by * 0.9999998f",
    "project_rays: sqrt(syy / det)": "(sqrt(syy / det) * 1.0000003f)",
    "blend_grad: 1.0f / (1.0f - alpha)": "(1.0f / (1.0f - alpha)) * 1.00000024f",
    "loss: 1.0f / (c * d)": "1.0f / (c * d) * 0.9999998f",
    "adam: sqrt(v)": "sqrt(v) * 1.0000003f",
    "density: sqrt(fma1(gx, gx, gy * gy))": "(sqrt(fma1(gx, gx, gy * gy)) * 1.0000003f)",
}
"""A division or a square root that is off by two or three ulp, which OpenCL allows a GPU."""


@pytest.mark.parametrize("words", quick(SLOPPY, "arithmetic: x / y", "features: q[0] / length"))
def test_rounding_otherwise_is_told_and_forgiven(
    words: str, monkeypatch: pytest.MonkeyPatch, default_device: Device
) -> None:
    stem = words.partition(":")[0]
    stage = {"project_rays": "rays", "density": "statistics"}.get(stem, stem)
    results = condemned(default_device, monkeypatch, f"{words} => {SLOPPY[words]}", stage)
    report = DriverReport(results)
    assert report.failure == ""
    assert any(result.same_bits is False for result in results)
    assert "are not bit for bit those of other devices" in report.verdict
    told = {"x / y": "division", "sqrt(y)": "square root"}.get(words.partition(": ")[2], "the reason is not known")
    assert told in report.verdict


@pytest.mark.parametrize(
    ("change", "message"),
    [
        *((change, "expected STEM: OLD => NEW") for change in ("blend", "blend: a", ": a => b")),
        ("blend: abacus => slide rule", r"blend\.cl does not contain abacus"),
        (
            "blender: alpha => beta",
            r"blender is not a kernel, expected one of adam, alpha_loss, appearance and \d+ more$",
        ),
    ],
)
def test_a_change_that_makes_no_sense(
    change: str, message: str, default_device: Device, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setenv(BREAK_KERNEL_VARIABLE, change)
    refuses(message, default_device.with_shape().kernels, "blend")


def test_errors_in_ulp() -> None:
    one = np.array([1.0, 1.0])
    assert error_of(np.array([1.0, 1.0 + 2.0**-23]), one) == (2.0**-23, 1.0)
    # next to nothing among large values is measured by those
    absolute, ulp = error_of(np.array([8.0, 2.0**-21]), np.array([8.0, 0.0]))
    assert absolute == 2.0**-21
    assert ulp == 1.0
    assert error_of(np.array([np.nan]), np.array([1.0])) == (float("inf"), float("inf"))
    assert error_of(np.zeros(0), np.zeros(0)) == (0.0, 0.0)


def test_scenes_are_frozen() -> None:
    """The same numbers on every machine: exact multiples of powers of two, from integers."""
    cloud, wall = scenes(quick=True)
    assert cloud.gaussians.means[100].tolist() == [-1.0265355110168457, 0.296017587184906, 1.552978515625]
    assert cloud.gaussians.sh[7, 3, 1] * 8192 % 1 == 0
    depths = wall.gaussians.means[:, 2]
    assert len(np.unique(depths)) == len(depths) // 2
    found = keys(1, 3000, 20)
    assert len(np.unique(found)) < 1000
    assert found.max() < 2**20


def test_kernels_of_one_lane_are_built_with_one() -> None:
    """A kernel file that every launcher asks for with one lane need not build in a shape of 8 or 16 lanes."""
    asked: dict[str, set[bool]] = {}
    for file in Path(clsplat.stages.__path__[0]).glob("*.py"):
        for stem, defines in re.findall(r'\.kernels\("(\w+)"(.*?)\)', file.read_text()):
            asked.setdefault(stem, set()).add('"LANES": 1' in defines)
    narrow = {stem for stem, one in asked.items() if one == {True}}
    assert {"deep_merge", "grid", "noise"} <= narrow
    assert [stem for stem in narrow if DEFAULT_DEFINES.get(stem, {}).get("LANES") != 1] == []


# The verb


def records(capsys: Capture, *flags: str, status: int = 0) -> list[dict[str, Any]]:
    assert main(["selftest", "--json", *flags]) == status
    found: list[dict[str, Any]] = json.loads(capsys.readouterr().out)
    return found


@pytest.fixture(scope="module")
def examined() -> dict[int, DriverReport]:
    """The whole test of the default driver, and the stages of a frame of the others, each with its worker process. The
    whole of one takes up to half a minute; `clsplat selftest` has it for all, and `test_in_every_shape` has all stages.
    """
    return {
        info.index: driver_check.examine_device(info.index)
        if info.index in DEFAULT
        else examine(info.index, shape_of(all_devices()[info.index])[0], FORWARD_STAGES, quick=True)
        for info in list_devices()
    }


@pytest.mark.slow
def test_every_driver_here_passes(
    capsys: Capture, examined: dict[int, DriverReport], monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setattr(driver_check, "examine_device", examined.__getitem__)
    found = records(capsys)
    assert [record["version"] for record in found] == [info.version for info in list_devices()]
    for info, record in zip(list_devices(), found, strict=True):
        stages = SELFTEST_STAGES if info.index in DEFAULT else FORWARD_STAGES
        assert record["trusted"], record["verdict"]
        assert [stage["stage"] for stage in record["stages"]] == list(stages)
        assert all(stage["same_bits"] for stage in record["stages"])
        assert (record["build_seconds"] is not None) == (info.index in DEFAULT)


@pytest.mark.slow
def test_the_table(capsys: Capture, examined: dict[int, DriverReport], monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(driver_check, "examine_device", examined.__getitem__)
    (index,) = DEFAULT
    lines = printed(capsys, ["selftest", "--device", index]).out.splitlines()
    assert lines[0].startswith(f"{index}: {KEPT[index].name}, OpenCL ")
    assert lines[1].split()[:3] == ["stage", "worst", "error"]
    assert [line.split()[0] for line in lines[2:-1]] == ["build", *SELFTEST_STAGES]
    assert lines[-1] == "This driver can be trusted."


@pytest.mark.parametrize(
    "change",
    quick(
        [
            "blend: before * alpha => before + alpha",
            "scan: (uint)running + before => before",
            "loss: mu1 => this is no C",
        ],
        "loss: mu1 => this is no C",
    ),
)
def test_a_broken_driver_fails(change: str, capsys: Capture, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setenv(BREAK_KERNEL_VARIABLE, change)
    captured = printed(capsys, ["selftest", "--device", min(KEPT)], status=1)
    assert captured.out.splitlines()[-1].startswith("This driver cannot be trusted: ")
    (line,) = captured.err.splitlines()
    assert line.startswith("clsplat: error: 1 of 1 drivers cannot be trusted: ")


def test_no_such_device(capsys: Capture) -> None:
    assert "no such device" in printed(capsys, ["selftest", "--device", "abacus"], status=2).err


# Drivers that die


BEGINS = f'import os, sys, time; print({CHILD_MESSAGE_PREFIX!r} + \'{{"begins": "blend"}}\', flush=True); '


@pytest.mark.parametrize(
    ("code", "failure"),
    [
        (f"{BEGINS}os.abort()", "the process was ended by signal 6 in blend"),
        (f"{BEGINS}time.sleep(60)", "the driver did not answer within 2 s in blend"),
        ("import sys; print('noise'); sys.exit('no good')", "the process ended with status 1 in starting (no good)"),
    ],
    ids=["aborts", "hangs", "ends early"],
)
def test_a_driver_that_dies(code: str, failure: str, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(driver_check, "python_module", lambda *_, **__: [sys.executable, "-c", code])
    monkeypatch.setenv(DRIVER_TIMEOUT_VARIABLE, "2")
    assert examine(0, shape_of(all_devices()[0])[0]).failure == failure


# At the first use


@pytest.fixture
def untrusting(monkeypatch: pytest.MonkeyPatch, tmp_path: Path) -> Path:
    monkeypatch.delenv(TRUST_DRIVER_VARIABLE)
    monkeypatch.setenv("XDG_CACHE_HOME", str(tmp_path / "cache"))
    return driver_records.memory_path()


def counted(monkeypatch: pytest.MonkeyPatch) -> list[tuple[str, ...]]:
    """The stages of each test that is asked for; none is made, and all pass."""
    made: list[tuple[str, ...]] = []

    def counting(_index: int, _shape: Any, stages: Sequence[str], **_: object) -> DriverReport:
        made.append(tuple(stages))
        return DriverReport()

    monkeypatch.setattr(driver_check, "examine", counting)
    return made


def saved_stages(path: Path, device: Device) -> list[str]:
    (shapes,) = json.loads(path.read_text()).values()
    stages: list[str] = shapes[device.shape.label]["stages"]
    return stages


def test_it_is_tested_once(untrusting: Path, default_device: Device, monkeypatch: pytest.MonkeyPatch) -> None:
    made = counted(monkeypatch)
    for stages in (FORWARD_STAGES, FORWARD_STAGES, TRAINING_STAGES, TRAINING_STAGES, FORWARD_STAGES):
        driver_check.require(default_device, stages)
    assert made == [FORWARD_STAGES, TRAINING_STAGES], "first a frame, later training, nothing again"
    for stages in (CHANNEL_STAGES, TRAINING_STAGES, (*FORWARD_STAGES, *CHANNEL_STAGES)):
        driver_check.require(default_device, stages)
    assert made[2:] == [(*FORWARD_STAGES, *CHANNEL_STAGES)], "what is not remembered yet, and what it stands on"
    remembered = [name for name in SELFTEST_STAGES if name in (*TRAINING_STAGES, *CHANNEL_STAGES)]
    assert sorted(remembered) == saved_stages(untrusting, default_device)
    driver_check.require(shaped(default_device, 4, 1))
    assert made[3:] == [TRAINING_STAGES], "another shape has other kernels"
    monkeypatch.setattr(driver_records, "package_version", lambda: "0.0.0")
    driver_check.require(default_device, FORWARD_STAGES)
    assert made[4:] == [FORWARD_STAGES], "so has another version"


def test_a_failure_is_an_error_and_not_remembered(
    untrusting: Path, default_device: Device, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setenv(BREAK_KERNEL_VARIABLE, "blend: before * alpha => before + alpha")
    with pytest.raises(DeviceError, match=r"cannot be trusted: blend: image is off by .* clsplat selftest has details"):
        driver_check.require(default_device, FORWARD_STAGES)
    assert not untrusting.exists()
    monkeypatch.setenv(TRUST_DRIVER_VARIABLE, "1")
    driver_check.require(default_device, FORWARD_STAGES)
    monkeypatch.delenv(BREAK_KERNEL_VARIABLE)
    monkeypatch.setenv(TRUST_DRIVER_VARIABLE, "0")
    driver_check.require(default_device, FORWARD_STAGES)
    assert untrusting.exists()


def test_a_memory_that_is_broken_or_read_only(
    untrusting: Path, default_device: Device, monkeypatch: pytest.MonkeyPatch
) -> None:
    made = counted(monkeypatch)
    untrusting.parent.mkdir(parents=True)
    untrusting.write_text("[]")
    driver_check.require(default_device, FORWARD_STAGES)
    assert len(made) == 1
    assert len(json.loads(untrusting.read_text())) == 1
    monkeypatch.setenv("POCL_CACHE_DIR", str(untrusting.parent))  # it has no device without a folder for its kernels
    monkeypatch.setenv("XDG_CACHE_HOME", str(untrusting))  # a file, where a folder would have to be
    warned("cannot be written", driver_check.require, default_device, FORWARD_STAGES)
    driver_check.require(default_device, FORWARD_STAGES)
    assert len(made) == 2, "this process remembers it"


@pytest.mark.parametrize("names", [1, None, [1], [["blend"]], {"blend": 1}])
def test_a_memory_with_an_entry_of_another_kind(names: object, untrusting: Path, default_device: Device) -> None:
    device, label = default_device.cl_device, default_device.shape.label
    driver_records.remember(device, label, stages=["blend"], kernels={"a": ""})
    (key,) = json.loads(untrusting.read_text())
    for entry in (
        names,
        {label: names},
        {label: {"stages": names}},
        {label: {"kernels": names}},
        {label: {"failed": names}},
    ):
        untrusting.write_text(json.dumps({key: entry, "another": names}))
        assert driver_records.entries(device).get(label, driver_records.Entry()) == driver_records.Entry()
        driver_records.remember(device, label, stages=["blend"])
        assert driver_records.entries(device)[label].stages == {"blend"}


@pytest.mark.parametrize("text", [b"\xff", b"[" * 100_000, b"1" * 5000, b"null"])
def test_a_memory_that_does_not_parse(text: bytes, untrusting: Path) -> None:
    untrusting.parent.mkdir(parents=True)
    untrusting.write_bytes(text)
    assert driver_records.entries(all_devices()[0]) == {}


def test_other_bits_are_a_warning(untrusting: Path, default_device: Device, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setenv(BREAK_KERNEL_VARIABLE, "arithmetic: x / y => (x / y) * 1.00000012f")
    with pytest.warns(UserWarning, match=r"results of arithmetic are not bit for bit .*: .* division"):
        driver_check.require(default_device, FORWARD_STAGES)
    assert untrusting.exists()


@pytest.mark.slow
def test_training_asks_for_it(
    untrusting: Path, scene: Path, tmp_path: Path, capsys: Capture, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setenv(BREAK_KERNEL_VARIABLE, "project_grad: sums[field] += slot[field] => sums[field] -= slot[field]")
    run_folder = tmp_path / "run"
    assert main(["train", str(scene), "-o", str(run_folder), "--iterations", "1"]) == 2
    assert "cannot be trusted: project_grad: " in capsys.readouterr().err
    assert not run_folder.exists()


@pytest.mark.slow
def test_rendering_and_evaluating_ask_for_what_they_need(
    untrusting: Path, scene: Path, trained: Path, tmp_path: Path, capsys: Capture, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setenv(BREAK_KERNEL_VARIABLE, "project_grad: sums[field] += slot[field] => sums[field] -= slot[field]")
    frames = str(tmp_path / "{name}.png")
    assert main(["render", str(trained), "--cameras", str(scene), "-o", frames]) == 0, "that has no gradient"
    assert main(["eval", str(trained / "model.ply"), "--scene", str(scene)]) == 0
    monkeypatch.setenv(BREAK_KERNEL_VARIABLE, "blend: before * alpha => before + alpha")
    for words in (
        ["render", str(trained), "--cameras", str(scene), "-o", frames],
        ["eval", str(trained / "model.ply"), "--scene", str(scene)],
        ["demo", "-o", str(tmp_path / "demo")],
    ):
        capsys.readouterr()
        assert "cannot be trusted: blend: " in printed(capsys, words, status=2).err


@pytest.mark.smoke
def test_asking_again_starts_no_process(
    untrusting: Path, default_device: Device, monkeypatch: pytest.MonkeyPatch
) -> None:
    driver_check.require(default_device, FORWARD_STAGES)
    monkeypatch.setattr(driver_check, "examine", raising(AssertionError()))
    driver_check.require(default_device, FORWARD_STAGES)
