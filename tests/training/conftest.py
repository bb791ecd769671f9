# SPDX-License-Identifier: Apache-2.0
"""The scene that most tests of training train on."""

from __future__ import annotations

from pathlib import Path

import pytest
from scratch_runs import go, starts_wide, whole  # noqa: F401  # fixtures
from tiny import write_scene

from clsplat.scenes.loading import load_scene
from clsplat.scenes.scene import Scene


@pytest.fixture(scope="module")
def folder(tmp_path_factory: pytest.TempPathFactory) -> Path:
    """The tiny scene, written anew for each file of tests."""
    return write_scene(tmp_path_factory.mktemp("tiny") / "scene")


@pytest.fixture(scope="module")
def scene(folder: Path) -> Scene:
    """That scene, read."""
    return load_scene(folder)
