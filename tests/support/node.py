# SPDX-License-Identifier: Apache-2.0
"""Other programs' readers and writers of model files, from npm. Tests that need one are skipped if it is missing.

CLSPLAT_NODE_MODULES names a folder of installed packages. Without it, the packages in .pytest_cache are used. Run as a
script, this file installs them there, and prints their folder or the reason of a failure.
"""

from __future__ import annotations

import json
import os
import shutil
import subprocess
import sys
import tempfile
from pathlib import Path
from typing import Any

import pytest
from needs import NODE_CACHE, node_modules, require

PACKAGES = ("@playcanvas/splat-transform@2.7.1", "gltf-validator@2.0.0-dev.3.10")
"""Packages with their versions. Version 3 of splat-transform would require Node.js 22."""

VALIDATE = """
const fs = require("fs"), path = require("path"), file = process.argv[1];
require("gltf-validator").validateBytes(new Uint8Array(fs.readFileSync(file)), {
  maxIssues: 0,
  externalResourceFunction: name => fs.promises.readFile(path.join(path.dirname(file), name)),
}).then(report => console.log(JSON.stringify(report.issues.messages)));
"""


def install() -> Path | str:
    """Install the packages if necessary. Returns their folder, or the reason of a failure as text."""
    if shutil.which("node") is None:
        return "there is no node to run readers from npm with"
    if found := node_modules():
        return found
    if shutil.which("npm") is None:
        return "there is no npm; install it, or set CLSPLAT_NODE_MODULES"
    cache = NODE_CACHE.parent
    cache.parent.mkdir(exist_ok=True)
    folder = Path(tempfile.mkdtemp(dir=cache.parent))
    command = ["npm", "install", "--no-audit", "--no-fund", "--ignore-scripts", "--prefix", str(folder), *PACKAGES]
    try:
        done = subprocess.run(command, capture_output=True, text=True, timeout=180, check=False)
    except subprocess.TimeoutExpired:
        shutil.rmtree(folder)
        return "npm does not answer"
    if done.returncode:
        shutil.rmtree(folder)
        return f"npm cannot install {' '.join(PACKAGES)}: {done.stderr.strip()[-200:]}"
    try:
        folder.rename(cache)
    except OSError:  # another process has installed them meanwhile
        shutil.rmtree(folder)
    return NODE_CACHE


def _node(package: str, *arguments: str) -> str:
    """Output of node with these arguments. Skips the test if the package is missing."""
    require("node")
    folder = node_modules()
    assert folder is not None
    if not (folder / package).is_dir():
        pytest.skip(f"CLSPLAT_NODE_MODULES has no {package}: npm install --ignore-scripts {' '.join(PACKAGES)}")
    done = subprocess.run(
        ["node", *arguments],
        capture_output=True,
        text=True,
        check=False,
        env=os.environ | {"NODE_PATH": str(folder)},
        cwd=folder,
        timeout=120,
    )
    assert done.returncode == 0, done.stdout + done.stderr
    return done.stdout


def splat_transform(source: Path, target: Path, *options: str) -> None:
    """Convert a file with PlayCanvas' splat-transform."""
    package = "@playcanvas/splat-transform"
    said = _node(package, f"{package}/bin/cli.mjs", "-q", "-w", "-g", "cpu", *options, str(source), str(target))
    assert target.exists(), said


SPZ = """
import { readdirSync, readFileSync } from 'node:fs';
const [folder, path] = process.argv.slice(1);
const name = readdirSync(folder).find((each) => /^spz-.*[.]js$/.test(each)
    && readFileSync(`${folder}/${each}`, 'utf8').includes('export {'));
const { default: createModule } = await import(`${folder}/${name}`);
const spz = await createModule();
const cloud = await spz.loadSpzFromBuffer(new Uint8Array(readFileSync(path)), { to: spz.CoordinateSystem.RDF });
console.log(JSON.stringify({ antialiased: cloud.antialiased, count: cloud.numPoints }));
"""
"""Program that prints the antialiased flag and the number of Gaussians of an SPZ file, read by splat-transform's
module."""


def spz_flag(path: Path) -> tuple[bool, int]:
    """Antialiased flag and number of Gaussians of an SPZ file, as splat-transform's reader finds them."""
    package, folder = "@playcanvas/splat-transform", node_modules()
    distribution = f"{folder}/{package}/dist"
    said = _node(package, "--input-type=module", "-e", SPZ, distribution, str(path))
    found = json.loads(said.splitlines()[-1])  # the module may print more lines before
    return found["antialiased"], found["count"]


def validate_gltf(path: Path) -> list[dict[str, Any]]:
    """Messages of Khronos's glTF validator about a file."""
    found: list[dict[str, Any]] = json.loads(_node("gltf-validator", "-e", VALIDATE, str(path)))
    return found


if __name__ == "__main__":
    where = install()
    sys.exit(where if isinstance(where, str) else print(where))
