# SPDX-License-Identifier: Apache-2.0
"""The page of devices: what is kept of a report, what is left out, and that the page shows the rows that are kept."""

from __future__ import annotations

import json
from pathlib import Path
from typing import Any

import device_page
import pytest
from calls import Capture
from gpu_page import fill_in

STAGES = {"project": 0.5, "duplicate": 0.25, "ranges": 0.25, "blend": 2.0}


def device(**changes: Any) -> dict[str, Any]:
    """A device of a report."""
    stages = [{"stage": "sort", "same_bits": None}, {"stage": "blend", "same_bits": True}]
    times = {
        "shape": {"lanes": 1, "items": 64, "by_gaussian": False, "subgroups": False},
        "load_average": 0.24,
        "timer": "events",
        "frame_ms": 3.0,
        "iteration_ms": 8.0,
        "stages": {name: {"ms": ms} for name, ms in STAGES.items()},
    }
    return {
        "name": "A GPU",
        "version": "OpenCL 3.0 CUDA 13  ",
        "kind": "gpu",
        "compute_units": 132,
        "trusted": True,
        "verdict": "can be trusted",
        "digests": {"scene/blend": "0123abcd"},
        "stages": stages,
        "times": times,
        **changes,
    }


def report(*devices: dict[str, Any]) -> dict[str, Any]:
    installation = [{"part": "python", "text": "/home/me"}, {"part": "system", "text": "Linux 6.1.2-some, x86_64"}]
    return {"clsplat": "0.1.0", "date": "2026-12-01", "installation": installation, "devices": list(devices)}


@pytest.fixture
def folder(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> Path:
    """A folder with a page and no rows."""
    page = "# Devices\n<!-- devices -->\n<!-- end -->\n<!-- times -->\n<!-- end -->\n"
    for name, text in {"PAGE": page, "ROWS": "[]"}.items():
        path = tmp_path / name
        path.write_text(text)
        monkeypatch.setattr(device_page, name, path)
    return tmp_path


def add(folder: Path, content: object) -> int:
    path = folder / "report.json"
    path.write_text(json.dumps(content))
    return device_page.main([str(path)])


def test_a_report_becomes_a_row_without_paths(folder: Path) -> None:
    assert add(folder, report(device())) == 0
    (row,) = json.loads((folder / "ROWS").read_text())
    assert (row["shape"], row["bits"], row["load"], row["stages_ms"]) == ("1x64", "same", 0.2, STAGES)
    assert "/home/me" not in (folder / "ROWS").read_text()
    page = (folder / "PAGE").read_text()
    assert "| A GPU | gpu | 132 | OpenCL 3.0 CUDA 13 | Linux 6.1, x86_64 | 2026-12-01 | 1x64 | same |" in page
    assert "| A GPU, OpenCL 3.0 CUDA 13 | 125 | 8.00 | 3.00 | 0.500 | 0.500 | 2.000 |" in page


def test_a_new_report_replaces_the_old_one(folder: Path) -> None:
    slow = {**device()["times"], "iteration_ms": 80.0, "timer": "wall"}
    stages = [{"stage": "blend", "same_bits": False}]
    add(folder, report(device(), device(name="A CPU", kind="cpu", times={**slow, "iteration_ms": 4.0})))
    add(folder, report(device(times=slow, stages=stages)))
    gpu, cpu = json.loads((folder / "ROWS").read_text())
    assert (gpu["step_ms"], gpu["bits"], cpu["device"]) == (80.0, "other in blend", "A CPU")
    assert "| A GPU, OpenCL 3.0 CUDA 13 (wall times) |" in (folder / "PAGE").read_text()


def test_what_is_left_out_is_told(folder: Path, capsys: Capture) -> None:
    failed = device(trusted=False, verdict="cannot be trusted: blend is off", times=None)
    assert add(folder, report(failed, device(times={"failed": "no memory"}), device(times=None))) == 0
    assert capsys.readouterr().err.splitlines() == [
        "left out: A GPU, OpenCL 3.0 CUDA 13: cannot be trusted: blend is off",
        "left out: A GPU, OpenCL 3.0 CUDA 13: no memory",
        "left out: A GPU, OpenCL 3.0 CUDA 13: no times",
    ]
    assert json.loads((folder / "ROWS").read_text()) == []


@pytest.mark.parametrize("content", [[], {"devices": []}, {**report(), "devices": [{}]}])
def test_another_file_is_refused(content: object, folder: Path, capsys: Capture) -> None:
    assert add(folder, content) == 2
    assert "is no report, expected the file of clsplat selftest --report" in capsys.readouterr().err
    assert (folder / "ROWS").read_text() == "[]"


def test_the_page_is_that_of_its_rows() -> None:
    rows, page = json.loads(device_page.ROWS.read_text()), device_page.PAGE.read_text()
    assert rows == device_page.merged(rows, [])
    assert fill_in(page, device_page.tables(rows)) == page
