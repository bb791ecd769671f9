# SPDX-License-Identifier: Apache-2.0
"""Variables of the environment that drivers get: a cache where the home can take nothing, and pinned threads."""

from __future__ import annotations

import os
import sys
from collections.abc import Set as AbstractSet
from pathlib import Path

import pytest
from calls import python

from clsplat.device.drivers.quirks import make_cache_folder, pin_threads


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
    usual, without = (python("-c", code, env=env).stdout for env in (dict(os.environ), environment))
    assert int(without) == int(usual) > 0
    assert not list(tmp_path.iterdir())


LINUX = pytest.mark.skipif(sys.platform != "linux", reason="PoCL pins threads on Linux alone")


def pinned(monkeypatch: pytest.MonkeyPatch, allowed: AbstractSet[int], **given: str) -> dict[str, str]:
    """The environment afterwards, where `allowed` of four processors may be used."""
    monkeypatch.setattr(os, "cpu_count", lambda: 4)
    monkeypatch.setattr(os, "sched_getaffinity", lambda _: set(allowed))
    environment = dict(given)
    pin_threads(environment)
    return environment


@LINUX
def test_threads_are_pinned_where_all_processors_may_be_used(monkeypatch: pytest.MonkeyPatch) -> None:
    assert pinned(monkeypatch, {0, 1, 2, 3}) == {"POCL_AFFINITY": "1"}


@LINUX
@pytest.mark.parametrize("allowed", [{0, 1}, {2, 3}, {0, 1, 2, 4}])
def test_not_where_a_thread_s_number_may_be_nobody_s_processor(
    monkeypatch: pytest.MonkeyPatch, allowed: set[int]
) -> None:
    assert pinned(monkeypatch, allowed) == {}


@LINUX
@pytest.mark.parametrize("name", ["POCL_CPU_MAX_CU_COUNT", "POCL_MAX_PTHREAD_COUNT", "POCL_MAX_COMPUTE_UNITS"])
def test_not_where_pocl_has_fewer_threads(monkeypatch: pytest.MonkeyPatch, name: str) -> None:
    assert pinned(monkeypatch, {0, 1, 2, 3}, **{name: "1"}) == {name: "1"}


@LINUX
@pytest.mark.parametrize("value", ["0", "1", ""])
def test_a_variable_that_is_set_is_left(monkeypatch: pytest.MonkeyPatch, value: str) -> None:
    assert pinned(monkeypatch, {0, 1, 2, 3}, POCL_AFFINITY=value) == {"POCL_AFFINITY": value}
