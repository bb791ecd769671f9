# SPDX-License-Identifier: Apache-2.0
"""Standard streams that are closed, full, or read by nobody: no traceback, and the status of the work."""

from __future__ import annotations

import os
import subprocess
import sys
from pathlib import Path

import pytest
from calls import ended
from models import random_gaussians
from quick import quick
from systems import posix

pytestmark = posix


def shell(line: str, folder: Path) -> subprocess.CompletedProcess[str]:
    """A line of sh, where `clsplat` is this one."""
    path = os.pathsep.join([str(Path(__file__).parents[2]), os.environ.get("PYTHONPATH", "")])
    script = f'clsplat() {{ "{sys.executable}" -m clsplat "$@"; }}; {line}'
    environment = {**os.environ, "PYTHONPATH": path}
    return ended("sh", "-c", script, timeout=120, cwd=folder, env=environment)


@pytest.fixture
def folder(tmp_path: Path) -> Path:
    random_gaussians(300, 1).save(tmp_path / "model.ply")
    return tmp_path


CASES = {
    "--version": 0,
    "train --help": 0,
    "devices": 0,
    "info model.ply": 0,
    "info none.ply": 2,
    "convert model.ply new.ply": 0,
    "convert model.ply model.ply": 2,
    "compare none none": 2,
    "report none": 2,
    "sfm none -o out": 2,
    "train none -o out": 2,
    "eval none.ply": 2,
    "render none.ply --cameras none -o a.png": 2,
    "view none.ply": 2,
    "nonsense": 2,
}
"""Calls, and their status."""


@pytest.mark.slow
@pytest.mark.parametrize("line", quick(CASES, "convert model.ply new.ply", "nonsense"))
def test_closed_streams(line: str, folder: Path) -> None:
    status = CASES[line]
    closed = shell(f"clsplat {line} >&-", folder)
    assert closed.returncode == status
    assert closed.stderr.count("\n") == (1 if status else 0), closed.stderr
    (folder / "new.ply").unlink(missing_ok=True)
    closed = shell(f"clsplat {line} 2>&-", folder)
    assert closed.returncode == status
    assert bool(closed.stdout) == (status == 0)
    assert "clsplat: " not in closed.stdout
    (folder / "new.ply").unlink(missing_ok=True)
    closed = shell(f"clsplat {line} <&- >&- 2>&-", folder)
    assert closed.returncode == status


@pytest.mark.slow
def test_nothing_is_printed_into_a_file_that_takes_the_place_of_a_stream(folder: Path) -> None:
    assert shell("clsplat convert model.ply new.ply <&- >&- 2>&-", folder).returncode == 0
    assert (folder / "new.ply").read_bytes() == (folder / "model.ply").read_bytes()


@pytest.mark.skipif(not Path("/dev/full").exists(), reason="no /dev/full on this system")
@pytest.mark.parametrize("verb", quick(["info model.ply", "train --help"], "info model.ply"))
def test_standard_output_on_a_full_disk(verb: str, folder: Path) -> None:
    done = shell(f"clsplat {verb} >/dev/full", folder)
    assert done.returncode == 1
    assert done.stderr.startswith("clsplat: error: ")
    assert done.stderr.endswith("the disk is full\n")
    assert done.stderr.count("\n") == 1


@pytest.mark.slow
@pytest.mark.skipif(not Path("/dev/full").exists(), reason="no /dev/full on this system")
def test_standard_error_on_a_full_disk(folder: Path) -> None:
    assert shell("clsplat info none.ply 2>/dev/full", folder).returncode == 2
