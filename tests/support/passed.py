# SPDX-License-Identifier: Apache-2.0
"""Flags for two runs of a checkout's tests, the second of which leaves out the tests that have passed in the first.

pytest --write-passed=FILE    writes the identifiers of the tests that passed, one per line
pytest --leave-out=FILE       leaves out these tests; if the file is missing, all tests run

Write the `=`: otherwise pytest takes an existing FILE for the place of the tests, and does not find conftest.py. The
identifier of a test for one driver has the driver's name and version. A test that reads the list of drivers runs again,
since the second run may have other drivers.
"""

from __future__ import annotations

import ast
from collections import defaultdict
from collections.abc import Callable
from functools import cache
from pathlib import Path

import pytest

from clsplat.files.atomic import atomic_write

WRITE, LEAVE_OUT = "--write-passed", "--leave-out"
PHASES = {"setup", "call", "teardown"}
OF_ALL_DRIVERS = {"KEPT", "all_devices", "list_devices"}
"""Names by which a test depends on the list of drivers."""


def pytest_addoption(parser: pytest.Parser) -> None:
    group = parser.getgroup("clsplat")
    group.addoption(WRITE, type=Path, metavar="FILE", help="write the identifiers of the tests that pass")
    group.addoption(LEAVE_OUT, type=Path, metavar="FILE", help="leave out the tests that such a file names")


def record(config: pytest.Config) -> None:
    """With --write-passed, record the tests that pass. With pytest-xdist, its main process does this for all tests."""
    if not hasattr(config, "workerinput") and config.getoption(WRITE):
        config.pluginmanager.register(Recorder(config.getoption(WRITE)))


class Recorder:
    """Plugin that writes the tests that passed in this run to a file."""

    def __init__(self, file: Path) -> None:
        file.unlink(missing_ok=True)  # of an earlier run
        self._file = file
        self._passed: dict[str, set[str]] = defaultdict(set)

    def pytest_runtest_logreport(self, report: pytest.TestReport) -> None:
        if report.outcome == "passed":
            self._passed[report.nodeid].add(report.when)

    def pytest_sessionfinish(self) -> None:
        passed = sorted(name for name, phases in self._passed.items() if phases == PHASES)
        atomic_write(self._file, "".join(f"{name}\n" for name in passed).encode())


def leave_out(config: pytest.Config, items: list[pytest.Item], driver_of: Callable[[pytest.Item], int | None]) -> None:
    """Remove the tests from `items` that have passed before.

    driver_of(item): index of the driver that a test is for; None if it is for none in particular.
    """
    file = config.getoption(LEAVE_OUT)
    passed = set(file.read_text("utf-8").splitlines()) if file and file.is_file() else set()
    again = [item for item in items if item.nodeid not in passed or (driver_of(item) is None and _of_all(item))]
    config.hook.pytest_deselected(items=list(set(items) - set(again)))
    items[:] = again


def _of_all(item: pytest.Item) -> bool:
    """True if a test names one of OF_ALL_DRIVERS, directly or through other names that its module defines."""
    if not isinstance(item, pytest.Function):
        return True
    names, waiting = _names(item.path), [item.originalname]
    seen: set[str] = set()
    while waiting:
        seen.add(name := waiting.pop())
        waiting += names.get(name, set()) - seen
    return bool(OF_ALL_DRIVERS & seen)


@cache
def _names(path: Path) -> dict[str, set[str]]:
    """For each name that a module defines at its top, the names in its definition: decorators and fixtures too."""
    found: dict[str, set[str]] = defaultdict(set)
    for statement in ast.parse(path.read_text("utf-8")).body:
        if isinstance(statement, ast.Import | ast.ImportFrom):
            continue
        nodes = list(ast.walk(statement))
        used = {node.id for node in nodes if isinstance(node, ast.Name)}
        used |= {node.attr for node in nodes if isinstance(node, ast.Attribute)}
        used |= {node.arg for node in nodes if isinstance(node, ast.arg)}
        defined = {getattr(statement, "name", "")}
        defined |= {node.id for node in nodes if isinstance(node, ast.Name) and isinstance(node.ctx, ast.Store)}
        for name in defined:
            found[name] |= used
    return found
