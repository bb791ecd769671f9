# SPDX-License-Identifier: Apache-2.0
"""A short form of `tools/stress/run sizes`, and that it tells of other bytes and wrong calls."""

from __future__ import annotations

import json
from pathlib import Path
from typing import Any

import pytest
import stress_sizes
from calls import Capture, printed
from stress_sizes import BEFORE, IN_A_FILE, IN_MEMORY

from clsplat.device.context import Device

ROOT = Path(__file__).resolve().parents[2]
SMALL = ["--gaussians", "7e4", "--degree", "0", "--steps", "3"]
"""More than 65,536 Gaussians, so that the model has chunks."""


@pytest.mark.slow
@pytest.mark.needs("matplotlib")
def test_sizes(tmp_path: Path, capsys: Capture, default_device: Device) -> None:
    """The version before is this one."""
    plot = tmp_path / "sizes.svg"
    call = [*SMALL, "--device", default_device.index, "--before", ROOT, "--json", "--plot", plot]
    (row,) = json.loads(printed(capsys, call, call=stress_sizes.main).out)
    assert row["gaussians"] == 70_000
    assert all(row[way]["median_ms"] > 0 for way in (IN_MEMORY, IN_A_FILE, BEFORE))
    assert row[IN_A_FILE]["peak"] > 0
    assert "million Gaussians" in plot.read_text()


def test_other_bytes_are_told(monkeypatch: pytest.MonkeyPatch, capsys: Capture) -> None:
    def answer(command: list[str], _version: object) -> Any:
        return {"median_ms": 1.0, "processor_ms": 2.0, "digest": str("--max-host-mem" in command)}

    monkeypatch.setattr(stress_sizes, "answer", answer)
    assert stress_sizes.main(SMALL) == 1
    assert "70,000 Gaussians: the digests differ" in capsys.readouterr().err


def test_a_version_that_is_not_there(tmp_path: Path, capsys: Capture) -> None:
    assert stress_sizes.main([*SMALL, "--before", str(tmp_path)]) == 2
    assert f"--before {tmp_path}: has no folder clsplat" in capsys.readouterr().err
