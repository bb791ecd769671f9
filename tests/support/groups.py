# SPDX-License-Identifier: Apache-2.0
"""Which tests run in one process with `-n 2 --dist loadgroup`: a driver's, so that its kernels are built once, which is
what most of the time goes to; else a file's, which share its fixtures.

By the identifier, and not by pytest-xdist's marker: of 3.8, with pytest 9.2, that does nothing.
"""

from __future__ import annotations

from collections.abc import Mapping
from pathlib import PurePath
from typing import Any

import pytest
from xdist.scheduler import LoadScopeScheduling


def group_of(identifier: str, drivers: Mapping[int, str]) -> str:
    """The group of a test. drivers: by their index the words that identifiers name them by."""
    file, _, rest = identifier.partition("::")
    named = [index for index, words in drivers.items() if words in rest.partition("[")[2]]
    return f"driver {max(named, key=lambda index: len(drivers[index]))}" if named else PurePath(file).stem


class ByDriver(LoadScopeScheduling):  # type: ignore[misc]  # it has no types
    """pytest-xdist's way to keep the tests of a scope together, for these groups."""

    def __init__(self, config: pytest.Config, log: Any, drivers: Mapping[int, str]) -> None:
        super().__init__(config, log)
        self._drivers = drivers

    def _split_scope(self, nodeid: str) -> str:
        return group_of(nodeid, self._drivers)


def scheduler(config: pytest.Config, log: Any, drivers: Mapping[int, str]) -> ByDriver | None:
    """The scheduler that pytest-xdist distributes the tests by; None where it is not asked for groups."""
    return ByDriver(config, log, drivers) if config.getvalue("dist") == "loadgroup" else None
