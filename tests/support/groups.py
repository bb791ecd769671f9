# SPDX-License-Identifier: Apache-2.0
"""Groups of tests that run in the same process with `-n 2 --dist loadgroup`.

Tests for the same driver in the same shape are a group, so that its kernels are built only once, which takes most of
the time; each shape has builds of its own. Tests that name no shape have the driver's own. Shapes with and without a
Gaussian per work-item share all kernels but one, and are a group. Other tests of a file are a group, because they share
fixtures. All files that draw the demo's still life are one group, because each process makes its textures anew.
Groups follow from the tests' identifiers. The marker of pytest-xdist 3.8 has no effect with pytest 9.2.
"""

from __future__ import annotations

import re
from collections.abc import Mapping
from pathlib import Path, PurePath
from typing import Any

import pytest
from xdist.scheduler import LoadScopeScheduling

STILL_LIFE = {
    *("test_capture", "test_capture_sources", "test_coming_from", "test_demo_scene"),
    *("test_sfm", "test_sfm_camera_files", "test_sfm_copies", "test_sfm_upright", "test_sfm_weights"),
    *("test_video_colours", "test_video_frames", "test_video_sfm"),
}
"""Files whose tests draw the demo's still life (`demo_photographs`, `walk_videos`). Its textures take each process 3.5
seconds of processor time."""


def group_of(identifier: str, drivers: Mapping[int, str], own: Mapping[int, str]) -> str:
    """The group of a test.

    drivers: by index, the words that name a driver in the tests' identifiers.
    own: by index, the label of the shape that a driver has by default.
    """
    file, _, rest = identifier.partition("::")
    parameters = rest.partition("[")[2]
    named = [index for index, words in drivers.items() if words in parameters]
    if not named:
        return "still life" if PurePath(file).stem in STILL_LIFE else PurePath(file).stem
    driver, shape = max(named, key=lambda index: len(drivers[index])), re.match(r"\d+x\d+(?=g?-)", parameters)
    return f"driver {driver} in {shape[0]}" if shape and shape[0] != own.get(driver) else f"driver {driver}"


class ByDriver(LoadScopeScheduling):  # type: ignore[misc]  # it has no types
    """pytest-xdist's scheduler that keeps the tests of a scope together, with these groups as scopes."""

    def __init__(self, config: pytest.Config, log: Any, drivers: Mapping[int, str], own: Mapping[int, str]) -> None:
        super().__init__(config, log)
        self._drivers, self._own = drivers, own

    def _split_scope(self, nodeid: str) -> str:
        return group_of(nodeid, self._drivers, self._own)


def scheduler(config: pytest.Config, log: Any, drivers: Mapping[int, str], own: Mapping[int, str]) -> ByDriver | None:
    """The scheduler for pytest-xdist; None without `--dist loadgroup`. drivers, own: those of `group_of`."""
    return ByDriver(config, log, drivers, own) if config.getvalue("dist") == "loadgroup" else None


def begin_apart(config: pytest.Config) -> None:
    """Let each process of pytest-xdist collect from another folder on. The first to import a file of tests compiles it
    for all, which is two thirds of collecting in a fresh checkout; side by side, all would compile the same ones."""
    worker = getattr(config, "workerinput", None)
    if worker is None or config.args_source is not pytest.Config.ArgsSource.TESTPATHS:
        return
    inside = (path for root in config.args for path in (config.rootpath / root).iterdir())
    paths = sorted(str(path) for path in inside if _has_tests(path))
    number = int(worker["workerid"].removeprefix("gw"))
    first = len(paths) * number // worker["workercount"]
    config.args[:] = paths[first:] + paths[:first]


def _has_tests(path: Path) -> bool:
    return any(path.rglob("test_*.py")) if path.is_dir() else path.match("test_*.py")


def in_one_order(config: pytest.Config, items: list[pytest.Item]) -> None:
    """Sort the items by file in these processes, which must all have the same list."""
    if hasattr(config, "workerinput"):
        items.sort(key=lambda item: item.path)
