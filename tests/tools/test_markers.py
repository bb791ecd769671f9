# SPDX-License-Identifier: Apache-2.0
"""Which tests run, on which drivers, and what is said of those that do not."""

from __future__ import annotations

import os
from pathlib import Path

import drivers
import needs
import pytest
from calls import python, refuses
from drivers import KEPT, NARROW
from pipeline import COMMON_SHAPES, DEFAULT, has_slow_parameters
from quick import quick

from clsplat.device.context import Device
from clsplat.device.drivers.shapes import Shape
from clsplat.device.selection import list_devices
from clsplat.selftest.driver_check import DriverReport

ROOT = Path(__file__).resolve().parents[2]


def test_what_is_missing_is_told_with_the_line_that_installs_it(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(needs, "find_spec", lambda _: None)
    assert needs.missing("av") == "needs PyAV: python3 tools/environment.py video"
    refuses("needs PyAV", needs.require, "av", error=pytest.skip.Exception)
    monkeypatch.setattr(needs, "find_spec", lambda _: object())
    assert needs.missing("av") == ""
    monkeypatch.setenv("CLSPLAT_CHROMIUM", "/nowhere/chromium")
    assert needs.missing("chromium") == "needs Chromium: apt-get install chromium, or set CLSPLAT_CHROMIUM"


def test_all_but_the_chosen_are_slow() -> None:
    found = {each.values[0]: [mark.name for mark in each.marks] for each in quick("abc", "a", "c")}
    assert found == {"a": [], "b": ["slow"], "c": []}
    with pytest.raises(AssertionError):
        quick("abc", "d")


def test_slow_parameters_run_on_the_default_driver() -> None:
    (index,) = DEFAULT
    assert all(has_slow_parameters(index, shape) for shape in (None, *COMMON_SHAPES))
    assert not has_slow_parameters(index, (1, 1))
    assert not has_slow_parameters(index + 1, None)


@pytest.mark.parametrize("name", quick(["a", "b"], "a"))
def test_a_slow_parameter_meets_no_shape_but_those(shaped_device: Device, name: str) -> None:
    shape = shaped_device.shape
    assert name == "a" or (shape.lanes, shape.items) in COMMON_SHAPES


def test_words_narrow_the_drivers_down(monkeypatch: pytest.MonkeyPatch) -> None:
    every = list_devices()
    word = every[0].platform
    monkeypatch.setenv(NARROW, f"abacus, {word.upper()}")
    assert drivers._kept() == [info for info in every if word in f"{info.platform} {info.version} {info.name}"]
    monkeypatch.setenv(NARROW, "abacus")
    assert drivers._kept() == []
    monkeypatch.setenv(NARROW, "")
    assert drivers._kept() == every


@pytest.mark.slow
def test_no_driver_of_that_name_is_an_error() -> None:
    options = ["-q", "-p", "xdist", "-p", "no:cacheprovider"]
    environment = {name: value for name, value in os.environ.items() if not name.startswith("PYTEST")}
    environment["PYTEST_DISABLE_PLUGIN_AUTOLOAD"] = "1"  # they take seconds to be imported
    environment[NARROW] = "abacus"
    done = python("-m", "pytest", *options, "tests/tools/test_markers.py", cwd=ROOT, env=environment)
    assert done.returncode == pytest.ExitCode.USAGE_ERROR
    assert f"{NARROW}=abacus: no OpenCL device contains one of these words; there are: " in done.stderr


@pytest.mark.parametrize(
    ("end", "wanted"),
    [
        ("", ""),
        ("the process was ended by signal 6 in arithmetic", " aborts in 16x2 on this processor"),
        ("the driver did not answer within 300 s in arithmetic", " hangs in 16x2 on this processor"),
        ("the process ended with status 1 in arithmetic (KeyError: 1)", ""),
    ],
)
def test_a_shape_that_takes_the_process_down_is_not_tried(
    end: str, wanted: str, monkeypatch: pytest.MonkeyPatch, tmp_path: Path
) -> None:
    asked: list[Shape] = []

    def examine(_index: int, shape: Shape, _stages: object, **_: object) -> DriverReport:
        asked.append(shape)
        return DriverReport(end=end)

    monkeypatch.setattr(drivers, "examine", examine)
    monkeypatch.setattr(drivers, "default_shape", lambda _: Shape(8, 1, 8))
    monkeypatch.setenv(drivers.SESSION, str(tmp_path))
    index, ask = min(KEPT), drivers.why_not.__wrapped__
    for _ in range(2):  # the second time it is remembered, for all processes of the run
        assert ask(index, 16, 2).endswith(wanted)
        assert bool(ask(index, 16, 2)) == bool(wanted)
    assert asked == [Shape(16, 2, 8)]
    assert ask(index, 8, 64) == "", "that has no longer vectors than the device's own shape"
