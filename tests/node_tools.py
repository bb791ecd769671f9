# SPDX-License-Identifier: Apache-2.0
"""Readers and writers of other people, from npm: where they are, and how they are called."""

from __future__ import annotations

import os
import shutil
import subprocess
from pathlib import Path

import pytest

SPLAT_TRANSFORM = "@playcanvas/splat-transform@3.7.0"


def node_package(name: str) -> Path:
    """The folder of an installed package; skips the test where CLSPLAT_NODE_MODULES has none."""
    modules = Path(os.environ.get("CLSPLAT_NODE_MODULES", "node_modules"))
    if shutil.which("node") is None:
        pytest.skip("there is no node to run readers from npm with")
    if not (modules / name).is_dir():
        pytest.skip(f"CLSPLAT_NODE_MODULES has no {name}: npm install --ignore-scripts {SPLAT_TRANSFORM}")
    return modules / name


def splat_transform(source: Path, target: Path) -> None:
    """Convert a model file."""
    command = node_package("@playcanvas/splat-transform") / "bin" / "cli.mjs"
    words = ["node", str(command), "-w", str(source), str(target)]
    done = subprocess.run(words, capture_output=True, text=True, timeout=120, check=False)
    assert done.returncode == 0, done.stdout + done.stderr
    assert target.exists(), done.stdout + done.stderr
