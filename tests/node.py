# SPDX-License-Identifier: Apache-2.0
"""Independent readers and writers of model files, from npm; tests that need one skip where it is not to be had."""

from __future__ import annotations

import functools
import json
import os
import shutil
import subprocess
import tempfile
from pathlib import Path
from typing import Any

import pytest

PACKAGES = ("@playcanvas/splat-transform@2.7.1", "gltf-validator@2.0.0-dev.3.10")
"""splat-transform 3 asks for Node.js 22."""
CACHE = Path(__file__).parents[1] / ".pytest_cache" / "node"

VALIDATE = """
const fs = require("fs"), path = require("path"), file = process.argv[1];
require("gltf-validator").validateBytes(new Uint8Array(fs.readFileSync(file)), {
  maxIssues: 0,
  externalResourceFunction: name => fs.promises.readFile(path.join(path.dirname(file), name)),
}).then(report => console.log(JSON.stringify(report.issues.messages)));
"""


@functools.cache
def _folder() -> Path | str:
    """Where node_modules is, or why there is none. CLSPLAT_NODE names a folder that has it."""
    if given := os.environ.get("CLSPLAT_NODE"):
        return Path(given)
    if (CACHE / "node_modules").is_dir():
        return CACHE
    if not (shutil.which("node") and shutil.which("npm")):
        return "Node.js and npm are not there"
    CACHE.parent.mkdir(exist_ok=True)
    folder = Path(tempfile.mkdtemp(dir=CACHE.parent))
    command = ["npm", "install", "--no-audit", "--no-fund", "--ignore-scripts", "--prefix", str(folder), *PACKAGES]
    try:
        done = subprocess.run(command, capture_output=True, text=True, timeout=180, check=False)
    except subprocess.TimeoutExpired:
        return "npm does not answer"
    if done.returncode:
        return f"npm cannot install {' '.join(PACKAGES)}: {done.stderr.strip()[-200:]}"
    try:
        folder.rename(CACHE)
    except OSError:  # another process was first
        shutil.rmtree(folder)
    return CACHE


def _node(*arguments: str) -> str:
    folder = _folder()
    if isinstance(folder, str):
        pytest.skip(folder)
    environment = os.environ | {"NODE_PATH": str(folder / "node_modules")}
    done = subprocess.run(
        ["node", *arguments], capture_output=True, text=True, check=False, env=environment, timeout=120
    )
    assert done.returncode == 0, done.stderr
    return done.stdout


def splat_transform(source: Path, target: Path, *options: str) -> None:
    """Convert a file by the tool of PlayCanvas's."""
    folder = _folder()
    if isinstance(folder, str):
        pytest.skip(folder)
    tool = folder / "node_modules/@playcanvas/splat-transform/bin/cli.mjs"
    _node(str(tool), "-q", "-w", "-g", "cpu", *options, str(source), str(target))


def validate_gltf(path: Path) -> list[dict[str, Any]]:
    """What Khronos's validator finds."""
    found: list[dict[str, Any]] = json.loads(_node("-e", VALIDATE, str(path)))
    return found
