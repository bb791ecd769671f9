# SPDX-License-Identifier: Apache-2.0
"""Variables of the environment that drivers get: a cache where the home can take nothing, and pinned threads."""

from __future__ import annotations

import os
import sys
from collections.abc import Set as AbstractSet
from pathlib import Path

import pytest
from calls import python, raising

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
    monkeypatch.setattr("tempfile.mkdtemp", raising(FileNotFoundError("no usable temporary directory")))
    environment = {"HOME": "/dev/null/home"}
    assert make_cache_folder(environment) is None
    assert "POCL_CACHE_DIR" not in environment


@pytest.mark.skipif(os.name == "nt", reason="homes are kept otherwise on Windows")
def test_devices_are_found_and_nothing_is_left(tmp_path: Path) -> None:
    environment = {**os.environ, "HOME": "/dev/null/home", "TMPDIR": str(tmp_path)}
    for name in ("POCL_CACHE_DIR", "XDG_CACHE_HOME"):
        environment.pop(name, None)
    code = "from clsplat.device.selection import list_devices; print(len(list_devices()))"
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


FEWER = ("POCL_CPU_MAX_CU_COUNT", "POCL_MAX_PTHREAD_COUNT", "POCL_MAX_COMPUTE_UNITS")


@LINUX
@pytest.mark.parametrize(
    ("allowed", "given"),
    [
        ({0, 1, 2, 3}, {}),
        *((allowed, {}) for allowed in ({0, 1}, {2, 3}, {0, 1, 2, 4})),  # a thread's number may be nobody's processor
        *(({0, 1, 2, 3}, {name: "1"}) for name in FEWER),
        *(({0, 1, 2, 3}, {"POCL_AFFINITY": value}) for value in ("0", "1", "")),
    ],
)
def test_threads_are_pinned_where_all_processors_may_be_used_and_no_variable_is_set(
    monkeypatch: pytest.MonkeyPatch, allowed: set[int], given: dict[str, str]
) -> None:
    added = {"POCL_AFFINITY": "1"} if allowed == {0, 1, 2, 3} and not given else {}
    assert pinned(monkeypatch, allowed, **given) == given | added
