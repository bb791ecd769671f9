# SPDX-License-Identifier: Apache-2.0
"""A short form of `tools/stress/run limits`, and that it tells of other bytes and of trainings that fail."""

from __future__ import annotations

from collections.abc import Callable
from pathlib import Path
from types import SimpleNamespace

import pytest
import stress_limits
from calls import Capture
from needs import require
from stress_limits import Case, Result, Trainings

from clsplat.device.context import Device
from clsplat.errors import ClsplatError

SMALL = ["--gaussians", "7e4", "--steps", "12", "--views", "2", "--kills", "1"]
"""More than 65,536 Gaussians, so that the model has chunks."""


def rows(out: str) -> dict[str, list[str]]:
    """The cells of the table, by the name of the row."""
    cells = [[cell.strip() for cell in line.split("|")[1:-1]] for line in out.splitlines()[2:]]
    return {name: rest for name, *rest in cells}


@pytest.mark.slow
def test_a_few_limits(capsys: Capture, default_device: Device) -> None:
    """`tools/stress/run limits` is the long form."""
    require("viser")
    words = "killed at,watched at"
    device = str(default_device.index)
    assert stress_limits.main([*SMALL, "--devices", device, "--only", words]) == 0
    found = rows(capsys.readouterr().out)
    assert list(found) == ["no limit", "killed at a quarter", "watched at a quarter"]
    assert len({cells[3] for cells in found.values()}) == 1
    assert all(cells[-1].startswith("same") for name, cells in found.items() if name != "no limit")
    assert found["killed at a quarter"][-1].startswith("same, 1 kills")


@pytest.mark.slow
def test_the_least_is_what_a_refused_training_is_told(tmp_path: Path, default_device: Device) -> None:
    options = SimpleNamespace(gaussians=70_000, steps=20, views=1)
    on = ("--device", str(default_device.index))
    flag, limit = Trainings(tmp_path, options).least(Case("least", "", on, least=True))
    assert flag == "--max-host-mem"
    # photographs of 0.2 MB and the decoding of one, statistics of 12 bytes a Gaussian, and room for a chunk of 0.7 MB
    assert 2 < int(limit.removesuffix("MiB")) < 20


def told(monkeypatch: pytest.MonkeyPatch, capsys: Capture, trained: Callable[[Case], Result]) -> tuple[int, str]:
    """Exit status, and the last cell of the row of half the device's memory, of trainings that are made up."""
    monkeypatch.setattr(Trainings, "trained", lambda _, case, _limit: trained(case))
    few = ["--gaussians", "2000", "--views", "1", "--devices", "0", "--only", "half the device"]
    status = stress_limits.main(few)
    return status, rows(capsys.readouterr().out)["half the device's memory"][-1]


def test_other_bytes_are_told(monkeypatch: pytest.MonkeyPatch, capsys: Capture) -> None:
    assert told(monkeypatch, capsys, lambda _: Result({"a"}, "")) == (0, "same")
    assert told(monkeypatch, capsys, lambda case: Result({case.name}, "")) == (1, "DIFFERENT")


def test_a_training_that_fails_is_told(monkeypatch: pytest.MonkeyPatch, capsys: Capture) -> None:
    def fail(case: Case) -> Result:
        raise ClsplatError(f"no room for {case.name}")

    status, words = told(monkeypatch, capsys, fail)
    assert status == 1
    assert words == "FAILED, no room for half the device's memory"


def test_a_row_that_is_not_there(capsys: Capture) -> None:
    assert stress_limits.main(["--devices", "0", "--only", "nobody"]) != 0
    assert "--only nobody: no such row, expected a part of no limit, " in capsys.readouterr().err
