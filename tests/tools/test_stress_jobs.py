# SPDX-License-Identifier: Apache-2.0
"""The stress tests of jobs, in small: the dispatcher's cost, and processes that are killed at random times."""

from __future__ import annotations

import json
from pathlib import Path

import pytest
import stress_job_kills
import stress_jobs
from calls import Capture
from systems import posix


def test_many_tasks(capsys: Capture) -> None:
    stress_jobs.main(["--tasks", "300"])  # its exit status depends on the time
    result = json.loads(capsys.readouterr().out)
    assert result["tasks"] == result["done"] == 300


@pytest.mark.slow
@posix
@pytest.mark.skipif(not Path("/proc/self/stat").exists(), reason="finds processes in /proc")
def test_kills(tmp_path: Path, capsys: Capture) -> None:
    assert stress_job_kills.main(["-o", str(tmp_path / "out"), "--kills", "4", "--seed", "1"]) == 0
    result = json.loads(capsys.readouterr().out)
    assert sum(result["kills"].values()) >= 3 and result["files"] == 5
    assert result["wrong"] == result["twice"] == []
