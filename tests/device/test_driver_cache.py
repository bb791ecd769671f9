# SPDX-License-Identifier: Apache-2.0
"""A driver's cache, where the home can take nothing."""

from __future__ import annotations

import os
import subprocess
import sys
from pathlib import Path

import pytest

from clsplat.device.drivers.quirks import make_cache_folder


def test_a_home_below_a_file_gets_a_folder_elsewhere(tmp_path: Path) -> None:
    (tmp_path / "file").touch()
    environment = {"HOME": str(tmp_path / "file" / "home")}
    folder = make_cache_folder(environment)
    assert folder is not None
    assert folder.is_dir()
    assert environment["POCL_CACHE_DIR"] == str(folder)


def test_nothing_is_done_where_the_cache_can_be_made(tmp_path: Path) -> None:
    for environment in (
        {"HOME": str(tmp_path / "not" / "there" / "yet")},
        {"HOME": "/dev/null/home", "XDG_CACHE_HOME": str(tmp_path)},
        {"HOME": "/dev/null/home", "POCL_CACHE_DIR": "/given"},
        {},
    ):
        before = dict(environment)
        assert make_cache_folder(environment) is None
        assert environment == before


def test_no_place_at_all_leaves_it_to_the_driver(monkeypatch: pytest.MonkeyPatch) -> None:
    def full(**_: object) -> str:
        raise FileNotFoundError("no usable temporary directory")

    monkeypatch.setattr("tempfile.mkdtemp", full)
    environment = {"HOME": "/dev/null/home"}
    assert make_cache_folder(environment) is None
    assert "POCL_CACHE_DIR" not in environment


@pytest.mark.skipif(os.name == "nt", reason="homes are kept otherwise on Windows")
def test_devices_are_found_and_nothing_is_left(tmp_path: Path) -> None:
    environment = {**os.environ, "HOME": "/dev/null/home", "TMPDIR": str(tmp_path)}
    for name in ("POCL_CACHE_DIR", "XDG_CACHE_HOME"):
        environment.pop(name, None)
    code = "from clsplat.device.context import list_devices; print(len(list_devices()))"
    usual, without = (
        subprocess.run([sys.executable, "-c", code], env=env, capture_output=True, text=True, check=True).stdout
        for env in (dict(os.environ), environment)
    )
    assert int(without) == int(usual) > 0
    assert not list(tmp_path.iterdir())
