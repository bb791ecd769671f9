# SPDX-License-Identifier: Apache-2.0
"""The scene in blocks that the tests of this folder train."""

from __future__ import annotations

import shutil
from pathlib import Path

import pytest
from small_city import load, trains_on, write_city
from tiny import write_scene

from clsplat.blocks.block_training import finish, train_block
from clsplat.blocks.merging import merge
from clsplat.device.context import Device


@pytest.fixture(scope="session")
def small_scene(tmp_path_factory: pytest.TempPathFactory) -> Path:
    return write_scene(tmp_path_factory.mktemp("blocks") / "scene")


@pytest.fixture(scope="session")
def planned_city(tmp_path_factory: pytest.TempPathFactory, small_scene: Path, default_device: Device) -> Path:
    """A city with its coarse model and its plan. Tests copy it."""
    city = tmp_path_factory.mktemp("planned") / "city"
    write_city(city, small_scene, default_device)
    return city


@pytest.fixture(scope="session")
def done_city(tmp_path_factory: pytest.TempPathFactory, planned_city: Path, default_device: Device) -> Path:
    """That city, trained without an interruption. Tests copy it, or only read it."""
    city = tmp_path_factory.mktemp("done") / "city"
    shutil.copytree(planned_city, city)
    for name in ("0,0", "1,0"):
        assert train_block(city, name, load(), trains_on(default_device))
    assert merge(city)
    assert finish(city, None, load(), trains_on(default_device))
    return city


@pytest.fixture
def city(planned_city: Path, tmp_path: Path) -> Path:
    """A copy of the city with its plan alone."""
    return shutil.copytree(planned_city, tmp_path / "city")
