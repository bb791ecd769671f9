# SPDX-License-Identifier: Apache-2.0
"""Groups of tests that run in the same process with `-n 2 --dist loadgroup`.

Tests for the same driver are a group, so that its kernels are built only once, which takes most of the time. Other
tests of a file are a group, because they share fixtures. Groups follow from the tests' identifiers. The marker of
pytest-xdist 3.8 has no effect with pytest 9.2.
"""

from __future__ import annotations

from collections.abc import Mapping
from pathlib import PurePath
from typing import Any

import pytest
from xdist.scheduler import LoadScopeScheduling


def group_of(identifier: str, drivers: Mapping[int, str]) -> str:
    """The group of a test. drivers: by index, the words that name a driver in the tests' identifiers."""
    file, _, rest = identifier.partition("::")
    named = [index for index, words in drivers.items() if words in rest.partition("[")[2]]
    return f"driver {max(named, key=lambda index: len(drivers[index]))}" if named else PurePath(file).stem


class ByDriver(LoadScopeScheduling):  # type: ignore[misc]  # it has no types
    """pytest-xdist's scheduler that keeps the tests of a scope together, with these groups as scopes."""

    def __init__(self, config: pytest.Config, log: Any, drivers: Mapping[int, str]) -> None:
        super().__init__(config, log)
        self._drivers = drivers

    def _split_scope(self, nodeid: str) -> str:
        return group_of(nodeid, self._drivers)


def scheduler(config: pytest.Config, log: Any, drivers: Mapping[int, str]) -> ByDriver | None:
    """The scheduler for pytest-xdist; None without `--dist loadgroup`."""
    return ByDriver(config, log, drivers) if config.getvalue("dist") == "loadgroup" else None
