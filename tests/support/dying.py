# SPDX-License-Identifier: Apache-2.0
"""Drivers that misbehave (`stand_in/sitecustomize.py`), and calls of clsplat with them."""

from __future__ import annotations

from collections.abc import Callable, Iterator
from dataclasses import replace
from pathlib import Path

import pytest
from calls import Capture
from drivers import KEPT
from pipeline import DEFAULT
from tiny import short

from clsplat.cli.main import main
from clsplat.config.training import OptimiserConfig
from clsplat.device import sandbox, selection
from clsplat.device.context import Device, all_devices
from clsplat.device.drivers import driver_records
from clsplat.device.drivers.quirks import wants_cache
from clsplat.device.drivers.worker_process import TRUST_DRIVER_VARIABLE
from clsplat.device.selection import open_device

ALWAYS = 10**6
"""A number that is larger than the number of kernel texts in any test."""
Standing = Callable[..., Path]


DRIVER = min(
    (index for index in KEPT if not wants_cache(all_devices()[index])),
    key=lambda index: (index not in DEFAULT, index),
    default=min(KEPT, default=0),
)
"""Index of the device whose driver misbehaves.

It is a device whose driver has a cache, if there is one, and the default device if that has. With another driver,
every process would build all kernels again.
"""


@pytest.fixture(scope="session")
def standing_device() -> Device:
    """The device DRIVER, without misbehaviour."""
    return open_device(str(DRIVER))


@pytest.fixture
def standing(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> Iterator[Standing]:
    """Function that makes the driver of DRIVER misbehave: its arguments are HOW, FIRST and LAST of `sitecustomize.py`.

    The driver has no record of earlier tests. The function returns the file with the numbered texts.
    """
    monkeypatch.setenv("XDG_CACHE_HOME", str(tmp_path / "cache"))
    monkeypatch.setenv("CLSPLAT_DEVICE", str(DRIVER))
    monkeypatch.delenv(TRUST_DRIVER_VARIABLE)
    monkeypatch.delenv("CLSPLAT_SHAPE", raising=False)
    monkeypatch.setenv("PYTHONPATH", str(Path(__file__).with_name("stand_in")))
    numbers = tmp_path / "numbers"

    def misbehave(how: str, first: int, last: int = ALWAYS) -> Path:
        monkeypatch.setenv("CLSPLAT_STAND_IN", f"{how} {first} {last} {numbers}")
        forget()
        return numbers

    yield misbehave
    forget()


def forget() -> None:
    """Bring clsplat to the state of a new process: without open devices, and without processes that try kernels."""
    for process in sandbox._processes.values():
        process.close()
    selection._open.cache_clear()
    driver_records.tell_once.cache_clear()


VERBS = {
    "train": "train {scene} -o {new} --iterations 3",
    "eval": "eval {run}",
    "render": "render {run} --cameras {scene} -o {new}/####.exr --channels rgb,alpha,depth",
    "view": "view {run} --port 0",
    "bench": "bench --gaussians 300 --size 64x48 --repeat 1",
    "tune": "tune",
    "selftest": "selftest --device {device}",
    "convert": "convert {run} {new}.ply --prune-contribution 0.01 --cameras {scene}",
    "demo": "demo -o {new}",
}


def call(verb: str, scene: Path, run: Path, new: Path) -> int:
    given = {"scene": scene, "run": run, "new": new, "device": DRIVER}
    return main([word.format(**given) for word in VERBS[verb].split()])


def error_of(capsys: Capture) -> str:
    """The line of error. Fails if there are several or a traceback."""
    said = capsys.readouterr().err
    assert "Traceback" not in said
    (line,) = [line for line in said.splitlines() if line.startswith("clsplat: error: ")]
    assert said.splitlines()[-1] == line
    return line


LATE = replace(
    short(iterations=16, checkpoint_every=5), optimiser=OptimiserConfig(means_rate_steps=400, sh_rest_every=3)
)
"""A training that builds and launches some kernels for the first time after ten steps or more.

These move rows of the model, or leave out the higher SH bands.
"""


def number_of(name: str, numbers: Path) -> int:
    """Number of the first text or kernel with this name, as listed in the file `numbers`."""
    return next(number for number, line in enumerate(numbers.read_text().splitlines(), 1) if name in line)
