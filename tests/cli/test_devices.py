# SPDX-License-Identifier: Apache-2.0
"""clsplat devices: all of them, or the one that a selector means."""

from __future__ import annotations

import json
import re
from pathlib import Path

import pytest
from calls import Capture, error_line, only, printed, rejected

from clsplat.bench.workload import synthetic
from clsplat.cli.main import main
from clsplat.device.selection import list_devices, open_device


def listed(capsys: Capture, *flags: str) -> list[dict[str, object]]:
    devices: list[dict[str, object]] = json.loads(printed(capsys, ["devices", "--json", *flags]).out)
    return devices


def test_each_by_its_index_and_by_its_version(capsys: Capture) -> None:
    everything = listed(capsys)
    assert len(everything) == len(list_devices())
    for device in everything:
        assert listed(capsys, "--device", str(device["index"])) == [device]
        assert only(listed(capsys, "--device", str(device["version"])))["version"] == device["version"]


@pytest.mark.smoke
def test_it_is_the_one_that_the_other_verbs_take(capsys: Capture) -> None:
    kind = list_devices()[-1].kind
    (found,) = listed(capsys, "--device", kind)
    device = open_device(kind)
    assert (found["name"], found["version"]) == (device.name, device.driver)


def test_the_table_has_one_line(capsys: Capture) -> None:
    header, line = printed(capsys, ["devices", "--device", "0"]).out.splitlines()
    assert header.split()[:2] == ["name", "kind"]
    assert line.startswith("0 ")


def test_the_environment_does_not_shorten_the_list(monkeypatch: pytest.MonkeyPatch, capsys: Capture) -> None:
    monkeypatch.setenv("CLSPLAT_DEVICE", "0")
    assert len(listed(capsys)) == len(list_devices())


@pytest.mark.smoke
def test_an_unknown_one(capsys: Capture) -> None:
    said = rejected(capsys, ["devices", "--device", "abacus"])
    assert said.startswith("clsplat: error: --device abacus: no such device, expected ")


@pytest.mark.parametrize(
    ("variable", "value", "expected"),
    [
        ("CLSPLAT_DEVICE", "abacus", "no such device, expected cpu, gpu, "),
        ("CLSPLAT_DEVICE", " ", "no such device, expected cpu, gpu, "),
        ("CLSPLAT_DRIVER_TIMEOUT", "soon", "expected seconds, such as 300"),
        ("CLSPLAT_SHAPE", "8", "expected LANESxITEMS"),
        ("CLSPLAT_TRUST_DRIVER", "no", "expected 1, or 0"),
        ("CLSPLAT_DEBUG", "false", "expected 1, or 0"),
    ],
)
def test_a_variable_that_makes_no_sense(
    variable: str, value: str, expected: str, model: Path, monkeypatch: pytest.MonkeyPatch, capsys: Capture
) -> None:
    monkeypatch.setenv(variable, value)
    assert main(["bench", str(model), "--repeat", "1"]) == 2
    assert re.match(rf"clsplat: error: {variable}={value}: {expected}", error_line(capsys))


@pytest.fixture
def model(tmp_path: Path) -> Path:
    """A model of a few Gaussians."""
    synthetic(10, 32, 32).gaussians.save(tmp_path / "model.ply")
    return tmp_path / "model.ply"
