# SPDX-License-Identifier: Apache-2.0
"""A short form of `tools/stress/run in_view`, and wrong calls of it."""

from __future__ import annotations

import json

import pytest
import stress_in_view
from calls import Capture, printed

from clsplat.device.context import Device


@pytest.mark.slow
def test_in_view(capsys: Capture, default_device: Device) -> None:
    """More than 65,536 Gaussians, so that the large model has chunks, of which the views show some."""
    call = ["--gaussians", "4e5", "--width", "64", "--height", "3", "--views", "2", "--blocks", "1"]
    rows = json.loads(
        printed(capsys, [*call, "--device", default_device.index, "--json"], call=stress_in_view.main).out
    )
    (row,) = rows
    assert row["count"] == 400_000
    assert 0 < row["chunks"] < 200
    assert all(row[name] > 0 for name in ("wall_ms", "wall_ms_small", "processor_ms", "processor_ms_small"))


@pytest.mark.parametrize("wrong", [["--views", "1"], ["--blocks", "0"]])
def test_too_few(capsys: Capture, wrong: list[str]) -> None:
    assert stress_in_view.main(wrong) == 2
    assert f"{wrong[0]} {wrong[1]}: expected at least" in capsys.readouterr().err
