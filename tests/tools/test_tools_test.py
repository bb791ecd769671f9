# SPDX-License-Identifier: Apache-2.0
"""tools/test: the command line that it makes, and that a test which crashes or hangs ends the run and is named."""

from __future__ import annotations

import os
import re
import subprocess
import sys
from importlib.machinery import SourceFileLoader
from importlib.util import module_from_spec, spec_from_loader
from pathlib import Path
from types import ModuleType, SimpleNamespace
from typing import Any

import pytest
from calls import python
from groups import STILL_LIFE, begin_apart, group_of, in_one_order

ROOT = Path(__file__).resolve().parents[2]
GROUPS = """
from groups import scheduler
def pytest_xdist_make_scheduler(config, log): return scheduler(config, log, {0: "fast-1.0", 1: "fast-1.0-new"}, {})
"""
NOTES = """
import os, pytest
from pathlib import Path

def note(group):
    with open(Path(__file__).parent / f"{group}.in", "a") as file:
        file.write(os.environ["PYTEST_XDIST_WORKER"])

@pytest.mark.parametrize("i", range(4))
@pytest.mark.parametrize("driver", ["fast-1.0", "fast-1.0-new"])
def test_of_a_driver(driver, i): note(driver)

@pytest.mark.parametrize("i", range(4))
def test_of_none(i): note(Path(__file__).stem)
"""
"""Tests that each write down the process that they are in."""
PATIENCE = 120
"""Seconds for a run of a few: one that hangs never ends."""


@pytest.fixture(scope="module")
def tool() -> ModuleType:
    """The script as a module."""
    spec = spec_from_loader("tools_test", SourceFileLoader("tools_test", str(ROOT / "tools" / "test")))
    module = module_from_spec(spec)
    spec.loader.exec_module(module)
    return module


@pytest.fixture
def commands(tool: ModuleType, monkeypatch: pytest.MonkeyPatch) -> list[list[str]]:
    """What is run in place of pytest."""
    made: list[list[str]] = []

    def run(command: list[str]) -> int:
        made.append(command[3:])
        return 5

    monkeypatch.setattr(tool, "set_up", lambda extras: Path("python") if extras == ("test",) else None)
    monkeypatch.setattr(tool, "run", run)
    monkeypatch.setattr(tool, "cores", lambda: 2)
    monkeypatch.setattr(tool, "memory", lambda: 64 << 30)
    monkeypatch.chdir(ROOT)
    return made


@pytest.mark.parametrize(
    ("given", "wanted"),
    [
        ("", "-n 3 --dist loadgroup"),
        ("--all", "-n 3 --dist loadgroup -m ''"),
        ("-k ply --no-header", "-n 3 --dist loadgroup -k ply --no-header"),
        ("--all -x tests/models/test_ply.py", "-n 3 --dist loadgroup -m '' -x tests/models/test_ply.py"),
        ("-n 0", "-n 0"),
        ("-n4 -q", "-n4 -q"),
        ("--numprocesses=3", "--numprocesses=3"),
        ("-p no:xdist", "-p no:xdist"),
        ("--pdb", "--pdb"),
        ("--write-passed=told", "-n 3 --dist loadgroup --write-passed=told"),
    ],
)
def test_its_command_line(
    given: str, wanted: str, tool: ModuleType, commands: list[list[str]], monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setattr(sys, "argv", ["tools/test", *given.split()])
    assert tool.main() == 5
    assert commands == [[word.strip("'") for word in wanted.split()]]


def test_compiled_tests_are_kept(tool: ModuleType, commands: list[list[str]], monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(sys, "argv", ["tools/test"])
    monkeypatch.setenv("PYTHONDONTWRITEBYTECODE", "1")
    tool.main()
    assert commands and "PYTHONDONTWRITEBYTECODE" not in os.environ


@pytest.mark.parametrize(
    ("cores", "free", "wanted", "of_all"),
    [(1, None, 2, 2), (2, None, 3, 3), (64, None, 4, 4), (8, 11 << 30, 3, 2), (8, 1 << 30, 1, 1)],
)
def test_as_many_processes_as_are_worth_it(
    cores: int, free: int | None, wanted: int, of_all: int, tool: ModuleType, monkeypatch: pytest.MonkeyPatch
) -> None:
    """One more than cores; with all drivers' kernels a process takes more memory."""
    monkeypatch.setattr(tool, "cores", lambda: cores)
    monkeypatch.setattr(tool, "memory", lambda: free)
    assert (tool.processes(), tool.processes(every=True)) == (wanted, of_all)


def test_help_installs_nothing() -> None:
    done = python(ROOT / "tools/test", "--help")
    assert (done.returncode, done.stderr) == (0, "")
    assert "tools/test --all" in done.stdout


def run(tool: ModuleType, folder: Path, *more: str) -> subprocess.CompletedProcess[str]:
    """pytest with the project's settings and in the processes of tools/test, on two files of a few tests."""
    (folder / "conftest.py").write_text(GROUPS)
    (folder / "test_fine.py").write_text(
        "import pytest\n@pytest.mark.parametrize('i', range(20))\ndef test_it(i): pass\n"
    )
    how = ["-c", str(ROOT / "pyproject.toml"), "--rootdir", str(folder), *tool.distribution([])]
    environment = {name: value for name, value in os.environ.items() if not name.startswith(("PYTEST", "COV"))}
    environment["PYTHONPATH"] = str(ROOT / "tests/support")
    environment["PYTEST_DISABLE_PLUGIN_AUTOLOAD"] = "1"  # the others take seconds to be imported in each process
    words = ["-m", "pytest", "-p", "xdist", *how, *more, folder]
    return python(*words, timeout=PATIENCE, cwd=folder, env=environment)


@pytest.mark.slow
def test_a_crash_ends_the_run_and_is_named(tool: ModuleType, tmp_path: Path) -> None:
    body = "import os, pytest\n@pytest.mark.parametrize('i', range(6))\ndef test_it(i):\n    if i == 3: os.abort()\n"
    (tmp_path / "test_aborts.py").write_text(body)
    done = run(tool, tmp_path)
    assert done.returncode == 1, done.stdout
    assert "crashed while running 'test_aborts.py::test_it[3]'" in done.stdout


@pytest.mark.parametrize(
    ("identifier", "wanted"),
    [
        ("tests/stages/test_sort.py::test_it", "test_sort"),
        ("tests/stages/test_sort.py::test_it[64-cloud]", "test_sort"),
        ("tests/stages/test_fast-1.0.py::test_it[64]", "test_fast-1.0"),
        ("tests/scenes/test_sfm.py::test_it[64]", "still life"),
        ("tests/demo/test_demo_scene.py::test_it[fast-1.0]", "driver 0"),
        ("tests/stages/test_sort.py::test_it[8x1-fast-1.0-cloud]", "driver 0"),
        ("tests/stages/test_sort.py::test_it[8x1-fast-1.0-new-cloud]", "driver 1 in 8x1"),
        ("tests/stages/test_sort.py::test_it[1x32g-fast-1.0-new-8x1]", "driver 1 in 1x32"),
        ("tests/stages/test_sort.py::test_it[fast-1.0-8x1]", "driver 0"),
        ("tests/stages/test_blend.py::test_it[fast-1.0-new-a/b]", "driver 1"),
    ],
)
def test_a_driver_s_tests_in_a_shape_are_a_group_and_else_a_file_s(identifier: str, wanted: str) -> None:
    assert group_of(identifier, {0: "fast-1.0", 1: "fast-1.0-new"}, {0: "8x1", 1: "16x1"}) == wanted


def test_the_files_that_draw_the_still_life_are_named() -> None:
    drawing = re.compile(r"^(from|import) (demo_photographs|walk_videos)\b", re.MULTILINE)
    files = (ROOT / "tests").rglob("test_*.py")
    assert {file.stem for file in files if drawing.search(file.read_text("utf-8"))} == STILL_LIFE


def collected(folder: Path, source: pytest.Config.ArgsSource, **process: Any) -> list[str]:
    """Names of the places that a process collects from, in order."""
    config: Any = SimpleNamespace(rootpath=folder, args=["tests"], args_source=source, **process)
    begin_apart(config)
    return [Path(place).name for place in config.args]


def test_each_process_begins_to_collect_elsewhere(tmp_path: Path) -> None:
    for name in ("a/test_it.py", "b/test_it.py", "c/deeper/test_it.py", "support/it.py", "test_it.py", "conftest.py"):
        (tmp_path / "tests" / name).parent.mkdir(parents=True, exist_ok=True)
        (tmp_path / "tests" / name).touch()
    of_all, of_some = pytest.Config.ArgsSource.TESTPATHS, pytest.Config.ArgsSource.ARGS
    first, second = ({"workerid": f"gw{number}", "workercount": 2} for number in range(2))
    assert collected(tmp_path, of_all, workerinput=first) == ["a", "b", "c", "test_it.py"]
    assert collected(tmp_path, of_all, workerinput=second) == ["c", "test_it.py", "a", "b"]
    assert collected(tmp_path, of_all) == collected(tmp_path, of_some, workerinput=second) == ["tests"]


def test_all_processes_have_one_order() -> None:
    items: Any = [SimpleNamespace(path=Path(file), name=name) for file, name in ("b1", "b0", "a1", "a2")]
    alone: Any = SimpleNamespace()
    in_one_order(alone, items)
    assert [item.name for item in items] == ["1", "0", "1", "2"]
    process: Any = SimpleNamespace(workerinput={})
    in_one_order(process, items)
    assert [f"{item.path}{item.name}" for item in items] == ["a1", "a2", "b1", "b0"]


@pytest.mark.slow
def test_a_group_stays_in_one_process(tool: ModuleType, tmp_path: Path) -> None:
    for name in ("test_one.py", "test_other.py"):
        (tmp_path / name).write_text(NOTES)
    done = run(tool, tmp_path)
    assert done.returncode == 0, done.stdout
    found = {path.stem: path.read_text() for path in tmp_path.glob("*.in")}
    tests = {"fast-1.0": 8, "fast-1.0-new": 8, "test_one": 4, "test_other": 4}
    assert {name: text[:3] * tests[name] for name, text in found.items()} == found


@pytest.mark.slow
def test_what_hangs_ends_and_is_named(tool: ModuleType, tmp_path: Path) -> None:
    (tmp_path / "test_hangs.py").write_text("import time\ndef test_it():\n    time.sleep(1000)\n")
    done = run(tool, tmp_path, "-o", "faulthandler_timeout=1")
    assert done.returncode == 1, done.stdout
    assert "crashed while running 'test_hangs.py::test_it'" in done.stdout
    assert "Timeout (0:00:01)!" in done.stderr
