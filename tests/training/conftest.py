# SPDX-License-Identifier: Apache-2.0
"""The scene that most tests of training train on."""

from __future__ import annotations

import pytest
from tiny import write_scene

from clsplat.scenes.loading import load_scene
from clsplat.scenes.scene import Scene


@pytest.fixture(scope="module")
def scene(tmp_path_factory: pytest.TempPathFactory) -> Scene:
    """The tiny scene, read anew for each file of tests."""
    return load_scene(write_scene(tmp_path_factory.mktemp("tiny") / "scene"))
