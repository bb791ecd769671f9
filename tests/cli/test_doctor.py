# SPDX-License-Identifier: Apache-2.0
"""clsplat doctor, and the report of a bug that clsplat selftest writes with its lines."""

from __future__ import annotations

import json
import re
from pathlib import Path
from typing import Any

import device_page
import pytest
from calls import Capture, printed, rejected

from clsplat.bench import stages
from clsplat.cli.selftest import times
from clsplat.demo import measured_view
from clsplat.device.context import Device
from clsplat.device.drivers import diagnostics
from clsplat.device.selection import list_devices
from clsplat.errors import CapacityError


@pytest.mark.smoke
def test_it_names_packages_and_devices(capsys: Capture) -> None:
    lines: list[dict[str, str]] = json.loads(printed(capsys, ["doctor", "--json"]).out)
    texts = [line["text"] for line in lines if line["part"] == "device"]
    assert len(texts) == len(list_devices())
    assert list_devices()[0].name in texts[0]
    assert any(line["text"].startswith("numpy ") for line in lines if line["part"] == "package")
    assert not [line for line in lines if line["state"] == "missing"]


def test_what_is_missing_has_advice_and_status_1(capsys: Capture, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(diagnostics, "listed_devices", lambda: ([], "a driver crashed (signal 6)"))
    monkeypatch.setattr(diagnostics, "gpus", lambda: ["NVIDIA"])
    monkeypatch.setattr(diagnostics, "families", lambda: ["debian"])
    text = printed(capsys, ["doctor"], status=1).out
    assert re.search(r"^missing +device +a driver crashed \(signal 6\)$", text, re.MULTILINE)
    assert "-> apt install nvidia-opencl-icd" in text
    assert text.splitlines()[-1].startswith("1 missing.")


def test_variables_are_shown(capsys: Capture, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setenv("CLSPLAT_DRIVER_TIMEOUT", "77")
    assert "CLSPLAT_DRIVER_TIMEOUT=77" in printed(capsys, ["doctor"]).out


@pytest.mark.slow
def test_the_report_of_a_bug(tmp_path: Path, capsys: Capture, default_device: Device) -> None:
    file = tmp_path / "report.json"
    assert f"Wrote {file}." in printed(capsys, ["selftest", "--device", default_device.index, "--report", file]).out
    report: dict[str, Any] = json.loads(file.read_text())
    (device,) = report["devices"]
    assert device["trusted"]
    assert device["limits"]["max_work_group_size"] >= 1
    assert device["refused"] == {}
    assert len(device["digests"]) == 3 * len(device["stages"])  # three scenes
    assert any(line["part"] == "package" for line in report["installation"])
    measured = device["times"]
    assert (measured["gaussians"], measured["width"], measured["height"]) == (20_000, 320, 240)
    assert measured["iteration_ms"] > 0 and measured["stages"]["project_grad"]["ms"] > 0
    rows, left_out = device_page.rows_of(report)
    assert ([row["device"] for row in rows], left_out) == ([device["name"]], [])
    assert "exists already" in rejected(capsys, ["selftest", "--report", file])


def test_times_that_cannot_be_measured(monkeypatch: pytest.MonkeyPatch) -> None:
    def fails(*_: object, **__: object) -> None:
        raise CapacityError("no memory left")

    monkeypatch.setattr(stages, "bench", fails)
    monkeypatch.setattr(measured_view, "measured_view", lambda: (None, None, None))
    assert times("0") == {"failed": "no memory left"}


def test_the_report_is_refused_before_the_test(tmp_path: Path, capsys: Capture) -> None:
    assert "no such folder" in rejected(capsys, ["selftest", "--report", tmp_path / "none" / "report.json"])
