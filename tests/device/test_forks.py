# SPDX-License-Identifier: Apache-2.0
"""Children of a process that has used OpenCL: a fork is told, within seconds, and one that begins anew works."""

from __future__ import annotations

import multiprocessing
import os
import sys
from pathlib import Path
from typing import Any

import numpy as np
import pytest
from calls import python, refuses
from scenes import one

from clsplat.device.context import Device, all_devices
from clsplat.device.drivers import forks
from clsplat.device.selection import open_device
from clsplat.errors import DeviceError
from clsplat.rendering.renderer import Renderer

PATIENCE = 60.0
"""Seconds until a child that hangs is given up: a spawned one builds its kernels."""


def picture() -> float:
    """The sum of a small picture's values."""
    gaussians, camera = one()
    return float(Renderer(open_device()).render(gaussians, camera).image.sum())


def put(results: Any) -> None:
    """Put the picture's sum, or the error's type and text, on a queue."""
    try:
        results.put(picture())
    except DeviceError as error:
        results.put(str(error))


@pytest.mark.slow
@pytest.mark.parametrize(
    "method", [name for name in ("fork", "spawn", "forkserver") if hasattr(os, "fork") or name == "spawn"]
)
def test_a_child_by_each_of_pythons_methods(method: str, default_device: Device) -> None:
    here = picture()
    context: Any = multiprocessing.get_context(method)
    results = context.Queue()
    child = context.Process(target=put, args=(results,))
    child.start()
    try:
        answer = results.get(timeout=PATIENCE)
        child.join(PATIENCE)
        assert child.exitcode == 0
    finally:
        child.kill()
    if method == "fork":
        assert f"was forked from {os.getpid()}, which has used OpenCL" in answer
        assert "get_context('spawn')" in answer
    else:
        assert answer == here
    assert picture() == here, "the parent goes on"


FORK = """
import os, sys
sys.path.insert(0, sys.argv[1])
from test_forks import picture, put
if sys.argv[2] == "used":
    picture()
child = os.fork()
if child == 0:
    try:
        picture()
    except Exception as error:
        print(type(error).__name__)
    sys.exit(7)  # runs destructors
sys.exit(os.waitstatus_to_exitcode(os.waitpid(child, 0)[1]))
"""


@pytest.mark.slow
@pytest.mark.skipif(not hasattr(os, "fork"), reason="this system has no fork")
@pytest.mark.parametrize(("parent", "printed"), [("used", "DeviceError\n"), ("fresh", "")])
def test_a_fork_by_hand(parent: str, printed: str) -> None:
    """One that OpenCL was not used in before may use it."""
    paths = {"PYTHONPATH": os.pathsep.join(sys.path)}
    done = python("-c", FORK, Path(__file__).parent, parent, timeout=PATIENCE, env={**os.environ, **paths})
    assert (done.returncode, done.stdout) == (7, printed), done.stderr


def test_each_way_to_a_device_is_closed(default_device: Device, monkeypatch: pytest.MonkeyPatch) -> None:
    """Also to one that was opened before, by calls that do not ask for it anew."""
    array = np.zeros(4, np.float32)
    monkeypatch.setattr(forks, "_owner", [-1])
    for call in (all_devices, open_device, default_device.finish, lambda: default_device.queue):
        refuses("was forked from -1", call, error=DeviceError)
    assert array.sum() == 0
