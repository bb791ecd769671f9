# SPDX-License-Identifier: Apache-2.0
"""Every OpenCL driver of the machine, as a parameter of the tests that run kernels."""

from __future__ import annotations

import gc
import os
import shutil
import signal
from collections import Counter
from collections.abc import Iterator
from pathlib import Path
from typing import Any

import pytest
from opencl_drivers import use_every_driver

use_every_driver()
os.environ.setdefault("CLSPLAT_TRUST_DRIVER", "1")  # the test at a driver's first use has tests of its own

from browser import browser  # noqa: F401  # a fixture
from calls import train
from drivers import KEPT, begin_session, check_some_are_kept, label
from dying import standing, standing_device  # noqa: F401  # fixtures
from fakes import folder, model, pipeline  # noqa: F401  # fixtures
from groups import begin_apart, in_one_order, scheduler
from needs import missing
from passed import leave_out, pytest_addoption, record  # noqa: F401  # a hook
from pipeline import DEFAULT, cpu_shape, has_slow_parameters, shaped, shapes_of
from same_bytes import undisturbed  # noqa: F401  # a fixture
from tiny import CONFIG, FEW, short, write_scene

from clsplat.device.context import Device
from clsplat.device.selection import open_device

begin_session()
if signal.getsignal(signal.SIGINT) == signal.SIG_IGN:
    signal.signal(signal.SIGINT, signal.default_int_handler)  # a run in the background; tests interrupt its children
# The folders that PoCL and clsplat use by default, so that tests that change XDG_CACHE_HOME do not build kernels anew
CACHE = Path(os.environ.get("XDG_CACHE_HOME") or Path.home() / ".cache")
os.environ.setdefault("POCL_CACHE_DIR", str(CACHE / "pocl" / "kcache"))
os.environ.setdefault("CLSPLAT_BINARIES", str(CACHE / "clsplat" / "binaries"))


def pytest_configure(config: pytest.Config) -> None:
    check_some_are_kept()
    record(config)
    begin_apart(config)
    gc.disable()  # until the end of the collection, whose objects are all kept


def pytest_collection_finish() -> None:
    """Let garbage collections skip the objects of the collection: they are half a million, and each takes 0.4 s."""
    gc.freeze()
    gc.enable()


@pytest.hookimpl(optionalhook=True)  # of pytest-xdist
def pytest_xdist_make_scheduler(config: pytest.Config, log: Any) -> Any:
    own = {index: open_device(str(index)).shape.label for index in KEPT}
    return scheduler(config, log, {index: label(index) for index in KEPT}, own)


def _driver_and_shape(item: pytest.Item) -> tuple[Any, Any]:
    """Those that a test is for; None where it is for none, or no driver is there."""
    parameters = item.callspec.params if isinstance(item, pytest.Function) and hasattr(item, "callspec") else {}
    shaped = parameters.get("shaped_device", (parameters.get("device"), None))
    return shaped if isinstance(shaped, tuple) else (None, None)


def _is_left_out(item: pytest.Item) -> bool:
    """Whether a test is a slow parameter on a driver, or in a shape, that has no slow ones.

    Tests that compare with `default_device` have all parameters on each driver.
    """
    index, shape = _driver_and_shape(item)
    if index is None or not isinstance(item, pytest.Function) or "default_device" in item.fixturenames:
        return False
    return not has_slow_parameters(index, shape) and any(mark.name == "slow" for mark in item.callspec.marks)


@pytest.hookimpl(tryfirst=True)  # before the slow ones are left out
def pytest_collection_modifyitems(config: pytest.Config, items: list[pytest.Item]) -> None:
    """The quick run has the shape for CPUs, as building kernels for groups of work-items takes long."""
    in_one_order(config, items)
    leave_out(config, items, lambda item: _driver_and_shape(item)[0])
    by_default = {index: cpu_shape(open_device(str(index))) for index in KEPT}  # once: opening one takes 10 ms
    pairs = {item for item in items if _is_left_out(item)}
    config.hook.pytest_deselected(items=list(pairs))
    items[:] = [item for item in items if item not in pairs]
    for item in items:
        index, shape = _driver_and_shape(item)
        if shape is not None and shape != by_default[index]:
            item.add_marker(pytest.mark.slow)
        for marker in item.iter_markers("needs"):
            if reason := missing(*marker.args):
                item.add_marker(pytest.mark.skip(reason=reason))


def pytest_terminal_summary(terminalreporter: pytest.TerminalReporter) -> None:
    """One line for each reason to skip tests."""
    reasons = [str(report.longrepr[2]) for report in terminalreporter.stats.get("skipped", [])]
    counts = Counter(reason.removeprefix("Skipped: ") for reason in reasons)
    if counts:
        terminalreporter.section("skipped")
    for reason, count in counts.most_common():
        terminalreporter.line(f"{count:5} {reason}")


@pytest.fixture(scope="session", params=KEPT, ids=label)
def device(request: pytest.FixtureRequest) -> Iterator[Device]:
    """Each driver in turn, in its own shape."""
    yield (device := open_device(str(request.param)))
    if request.param not in DEFAULT:  # the default device's kernels are used by tests of other fixtures
        device._kernels.clear()  # otherwise each process would come to hold all kernels of all drivers


@pytest.fixture(scope="session")
def default_device() -> Device:
    """The driver that is used unless another is asked for: CLSPLAT_DEVICE, or the first."""
    return open_device()


SHAPED = [(index, shape) for index in KEPT for shape in shapes_of(open_device(str(index)))]


def _shaped_label(parameter: tuple[int, tuple[int, ...]]) -> str:
    index, (lanes, items, *by_gaussian) = parameter
    return f"{lanes}x{items}{'g' if by_gaussian else ''}-{label(index)}"


@pytest.fixture(scope="session", params=SHAPED, ids=_shaped_label)
def shaped_device(request: pytest.FixtureRequest) -> Iterator[Device]:
    """Each driver in kernel shapes."""
    index, shape = request.param
    yield shaped(open_device(str(index)), *shape)
    shaped.cache_clear()  # frees the kernels of all shapes, before those of the next driver or shape are built


@pytest.fixture(scope="session")
def scene_folder(tmp_path_factory: pytest.TempPathFactory) -> Path:
    """A tiny scene on disk; not to be changed."""
    return write_scene(tmp_path_factory.mktemp("cli") / "scene")


@pytest.fixture(scope="session")
def scene(scene_folder: Path) -> Path:
    """That scene; where tests of training are, it is a scene that is read."""
    return scene_folder


@pytest.fixture(scope="session")
def trained(scene_folder: Path, tmp_path_factory: pytest.TempPathFactory) -> Path:
    """A finished run of CONFIG by the command line; not to be changed."""
    run = tmp_path_factory.mktemp("trained") / "run"
    assert train(scene_folder, run, CONFIG) == 0
    return run


@pytest.fixture(scope="session")
def reported(scene_folder: Path, tmp_path_factory: pytest.TempPathFactory) -> Path:
    """A finished run with everything that a report shows; not to be changed."""
    run = tmp_path_factory.mktemp("reported") / "a run"
    assert train(scene_folder, run, short(stages_every=10, eval_at=(10, 30))) == 0
    return run


@pytest.fixture(scope="session")
def begun(scene_folder: Path, tmp_path_factory: pytest.TempPathFactory) -> Path:
    """A run of FEW by the command line; not to be changed."""
    run = tmp_path_factory.mktemp("begun") / "run"
    assert train(scene_folder, run, FEW) == 0
    return run


@pytest.fixture
def run(begun: Path, tmp_path: Path) -> Path:
    """A copy of that run, to be changed."""
    return Path(shutil.copytree(begun, tmp_path / "run"))
