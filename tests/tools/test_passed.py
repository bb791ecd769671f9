# SPDX-License-Identifier: Apache-2.0
"""Tests that have passed in a run, and a second run without it."""

from __future__ import annotations

import os
from collections.abc import Callable
from pathlib import Path

import pytest
from calls import python

ROOT = Path(__file__).resolve().parents[2]
HOOKS = """
import pytest
from groups import scheduler
from passed import leave_out, pytest_addoption, record

def pytest_xdist_make_scheduler(config, log):
    return scheduler(config, log, {1: "driver-1.0"}, {})

def pytest_configure(config):
    record(config)

@pytest.hookimpl(tryfirst=True)
def pytest_collection_modifyitems(config, items):
    leave_out(config, items, lambda item: getattr(item, "callspec", None) and item.callspec.params.get("device"))
"""
TESTS = """
import os, pytest
again = "AGAIN" in os.environ

@pytest.fixture
def torn():
    yield
    assert again

@pytest.mark.parametrize("name", ["a@b", "c d", "e"])
def test_passes(name): pass
def test_fails(): assert again
def test_is_torn_down(torn): pass
@pytest.mark.skipif(not again, reason="there is no browser yet")
def test_is_skipped(): pass
@pytest.mark.xfail
def test_is_expected_to_fail(): assert False
"""
OF_DRIVERS = """
import pytest
KEPT = [0, 1]
@pytest.mark.parametrize("device", [1], ids=["driver-1.0"])
def test_of_one(device): pass
@pytest.fixture
def several(): return len(KEPT)
def test_of_all(several): pass
def test_of_none(): pass
"""
SECOND = {
    "tests/test_some.py::test_fails",
    "tests/test_some.py::test_is_torn_down",
    "tests/test_some.py::test_is_skipped",
    "tests/test_drivers.py::test_of_all",
}
FIRST = {
    *(f"tests/test_some.py::test_passes[{name}]" for name in ("a@b", "c d", "e")),
    "tests/test_drivers.py::test_of_one[driver-1.0]",
    "tests/test_drivers.py::test_of_none",
}


@pytest.fixture
def run(tmp_path: Path) -> Callable[..., set[str]]:
    """Run those tests in a checkout, whose hooks lie in `tests` as the project's; gives what passed."""
    house = tmp_path / "house"
    (house / "tests").mkdir(parents=True)
    (house / "pytest.ini").write_text("[pytest]\ntestpaths = tests\n")
    (house / "tests/conftest.py").write_text(HOOKS)
    (house / "tests/test_some.py").write_text(TESTS)
    (house / "tests/test_drivers.py").write_text(OF_DRIVERS)
    kept = {name: value for name, value in os.environ.items() if not name.startswith(("PYTEST", "COV"))}
    kept["PYTHONPATH"] = os.pathsep.join([str(ROOT), str(ROOT / "tests/support")])
    kept["PYTEST_DISABLE_PLUGIN_AUTOLOAD"] = "1"

    def started(*arguments: str, **more: str) -> set[str]:
        file = tmp_path / "told"
        words = ["-m", "pytest", "-p", "xdist", f"--write-passed={file}", *arguments]
        done = python(*words, cwd=house, env={**kept, **more})
        assert done.returncode in {0, 1}, done.stdout + done.stderr
        return set(file.read_text("utf-8").splitlines())

    return started


@pytest.mark.slow
def test_what_passed_is_left_out_and_nothing_else(run: Callable[..., set[str]], tmp_path: Path) -> None:
    first = run("-n", "2", "--dist", "loadgroup")
    assert first == FIRST | {"tests/test_drivers.py::test_of_all"}
    (tmp_path / "first").write_text("".join(f"{name}\n" for name in first))
    assert run(f"--leave-out={tmp_path / 'first'}", "-n", "2", "--dist", "loadgroup", AGAIN="yes") == SECOND


def test_without_the_file_every_test_runs(run: Callable[..., set[str]], tmp_path: Path) -> None:
    assert run(f"--leave-out={tmp_path / 'nowhere'}", AGAIN="yes") == FIRST | SECOND
