# SPDX-License-Identifier: Apache-2.0
"""Requirements of tests beyond the extra `test`.

A test has the mark `needs("name")`, or a fixture or module calls `require("name")`. If a requirement is missing, the
test is skipped. The reason names the command that installs it, and conftest.py lists these reasons at the end.
"""

from __future__ import annotations

import os
import shutil
import sys
from collections.abc import Callable
from dataclasses import dataclass
from importlib.util import find_spec
from pathlib import Path

import pytest
from slurm_node import slurm_is_there

SCENES = Path(os.environ.get("CLSPLAT_SCENES", Path(__file__).parents[3] / "shared" / "scenes"))
"""Folder of the real scenes and models."""
NODE_CACHE = Path(__file__).parents[2] / ".pytest_cache" / "node" / "node_modules"
CHROMIUM = ("chromium", "chromium-browser", "google-chrome", "google-chrome-stable", "chrome")
PREFIX = "needs "
"""Beginning of a reason for skipping a test without a requirement."""


@dataclass(frozen=True)
class Need:
    """A package, a program or data. line: the command that installs it."""

    title: str
    line: str
    is_there: Callable[[], bool]


def of_extra(module: str, title: str, extra: str) -> Need:
    """A Python package that an extra installs into `.venv`, where tools/test runs."""
    return Need(title, f"python3 tools/environment.py {extra}", lambda: find_spec(module) is not None)


def chromium_path() -> str | None:
    """Path of the browser: CLSPLAT_CHROMIUM, or the first of CHROMIUM on the path; None if there is none."""
    named = os.environ.get("CLSPLAT_CHROMIUM")
    return next((found for name in ([named] if named else CHROMIUM) if (found := shutil.which(name))), None)


def openjd_path() -> str | None:
    """Path of the program `openjd`, in the folder of this Python or on the path."""
    return shutil.which("openjd", path=os.pathsep.join([str(Path(sys.executable).parent), os.environ.get("PATH", "")]))


def node_modules() -> Path | None:
    """Folder of the packages from npm: CLSPLAT_NODE_MODULES, or the folder into which node.py installs them."""
    given = os.environ.get("CLSPLAT_NODE_MODULES")
    folder = Path(given).resolve() if given else NODE_CACHE
    return folder if shutil.which("node") and folder.is_dir() else None


NEEDS = {
    "av": of_extra("av", "PyAV", "video"),
    "chromium": Need("Chromium", "apt-get install chromium, or set CLSPLAT_CHROMIUM", lambda: bool(chromium_path())),
    "distributed": of_extra("distributed", "distributed", "farm"),
    "ffmpeg": Need("FFmpeg", "apt-get install ffmpeg", lambda: shutil.which("ffmpeg") is not None),
    "git": Need("git", "apt-get install git", lambda: shutil.which("git") is not None),
    "gsplat": Need("gsplat", "pip install --no-deps gsplat==1.5.3", lambda: find_spec("gsplat") is not None),
    "hatchling": of_extra("hatchling", "hatchling", "test"),
    "importlinter": of_extra("importlinter", "import-linter", "dev"),
    "html5lib": of_extra("html5lib", "html5lib", "test"),
    "jax": of_extra("jax", "JAX", "jax"),
    "laspy": of_extra("laspy", "laspy", "las"),
    "matplotlib": of_extra("matplotlib", "Matplotlib", "plot"),
    "mike": of_extra("mike", "mike", "docs"),
    "mkdocs": of_extra("mkdocs", "MkDocs", "docs"),
    "node": Need(
        "readers from npm", "apt-get install nodejs npm && python3 tests/support/node.py", lambda: bool(node_modules())
    ),
    "oclgrind": Need("Oclgrind", "apt-get install oclgrind", lambda: shutil.which("oclgrind") is not None),
    "onnxruntime": of_extra("onnxruntime", "onnxruntime", "learned"),
    "openjd": Need("openjd-cli", "python3 tools/environment.py dev", lambda: bool(openjd_path())),
    "pillow_heif": of_extra("pillow_heif", "pillow-heif", "photos"),
    "playwright": of_extra("playwright", "Playwright", "test"),
    "pxr": of_extra("pxr", "OpenUSD", "usd"),
    "rattler_build": of_extra("rattler_build", "py-rattler-build", "release"),
    "rawpy": of_extra("rawpy", "rawpy", "photos"),
    "scenes": Need("real scenes", "set CLSPLAT_SCENES to their folder", SCENES.is_dir),
    "slurm": Need("Slurm", "apt-get install slurm-wlm munge", slurm_is_there),
    "tree_sitter_powershell": of_extra("tree_sitter_powershell", "tree-sitter-powershell", "release"),
    "torch": of_extra("torch", "PyTorch", "torch"),
    "viser": of_extra("viser", "viser", "view"),
}


def missing(name: str) -> str:
    """Reason for skipping a test with this requirement; empty if it is met."""
    need = NEEDS[name]
    return "" if need.is_there() else f"{PREFIX}{need.title}: {need.line}"


def require(name: str) -> None:
    """Skip the test, or the module that is being imported, if this requirement is missing."""
    if reason := missing(name):
        pytest.skip(reason, allow_module_level=True)
