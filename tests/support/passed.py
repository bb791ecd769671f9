# SPDX-License-Identifier: Apache-2.0
"""Two runs of the tests of one checkout, of which the second leaves out what has passed in the first.

pytest --write-passed=FILE    the identifiers of what passed, one a line
pytest --leave-out=FILE       without those; without the file every test runs

With the `=`: pytest takes a word of its own for where the tests are if such a file is there, and finds no conftest.py.
A test for one driver has the driver's name and version in its identifier. One that looks at the list of drivers runs
again, as the second run may have others.
"""

from __future__ import annotations

from collections import defaultdict
from collections.abc import Callable
from pathlib import Path

import pytest

from clsplat.files.atomic import atomic_write

WRITE, LEAVE_OUT = "--write-passed", "--leave-out"
PHASES = {"setup", "call", "teardown"}
OF_ALL_DRIVERS = {"KEPT", "all_devices", "list_devices"}
"""Names in a module whose tests may depend on which drivers there are."""


def pytest_addoption(parser: pytest.Parser) -> None:
    group = parser.getgroup("clsplat")
    group.addoption(WRITE, type=Path, metavar="FILE", help="write the identifiers of the tests that pass")
    group.addoption(LEAVE_OUT, type=Path, metavar="FILE", help="leave out the tests that such a file names")


def record(config: pytest.Config) -> None:
    """Where it is asked for, remember what passes; with pytest-xdist in the process that hears of all tests."""
    if not hasattr(config, "workerinput") and config.getoption(WRITE):
        config.pluginmanager.register(Recorder(config.getoption(WRITE)))


class Recorder:
    """The tests that passed in the processes of this run, for a file."""

    def __init__(self, file: Path) -> None:
        file.unlink(missing_ok=True)  # of a run that is over
        self._file = file
        self._passed: dict[str, set[str]] = defaultdict(set)

    def pytest_runtest_logreport(self, report: pytest.TestReport) -> None:
        if report.outcome == "passed":
            self._passed[report.nodeid].add(report.when)

    def pytest_sessionfinish(self) -> None:
        passed = sorted(name for name, phases in self._passed.items() if phases == PHASES)
        atomic_write(self._file, "".join(f"{name}\n" for name in passed).encode())


def leave_out(config: pytest.Config, items: list[pytest.Item], driver_of: Callable[[pytest.Item], int | None]) -> None:
    """Take from `items` those that have passed before. driver_of(item): the index of the driver that a test is for,
    None where it is for none."""
    file = config.getoption(LEAVE_OUT)
    passed = set(file.read_text("utf-8").splitlines()) if file and file.is_file() else set()
    again = [item for item in items if item.nodeid not in passed or (driver_of(item) is None and _of_all(item))]
    config.hook.pytest_deselected(items=list(set(items) - set(again)))
    items[:] = again


def _of_all(item: pytest.Item) -> bool:
    module = item.getparent(pytest.Module)
    return module is None or bool(OF_ALL_DRIVERS & vars(module.obj).keys())
