# SPDX-License-Identifier: Apache-2.0
"""CLSPLAT_SYNC=1: each launch waits, so that the kernel that hangs or fails is the one that is named."""

from __future__ import annotations

from types import SimpleNamespace
from typing import Any

import numpy as np
import pytest
from calls import refuses
from scenes import random_cloud

from clsplat.device.context import Device
from clsplat.device.selection import open_device
from clsplat.errors import DriverError
from clsplat.rendering.renderer import Renderer


@pytest.fixture
def waiting(monkeypatch: pytest.MonkeyPatch) -> Device:
    monkeypatch.setenv("CLSPLAT_SYNC", "1")
    device = open_device()
    return device.with_shape(items=device.shape.items)  # another object, opened with the variable


def test_a_frame_is_the_same(waiting: Device) -> None:
    gaussians, camera = random_cloud(50, 1, 40, 30)
    assert waiting.waits
    frames = [Renderer(device).render(gaussians, camera).image for device in (waiting, open_device())]
    assert np.array_equal(*frames)


class Event:
    def __init__(self, status: int) -> None:
        self.command_execution_status = status


@pytest.mark.parametrize(
    ("status", "text"),
    [(1, "scan.cl, scan_top, does not finish within 0.05 s (CLSPLAT_DRIVER_TIMEOUT)"),
     (-14, "scan.cl, scan_top, failed with OpenCL's status -14")],
)  # fmt: skip
def test_the_kernel_is_named(waiting: Device, monkeypatch: pytest.MonkeyPatch, status: int, text: str) -> None:
    monkeypatch.setenv("CLSPLAT_DRIVER_TIMEOUT", "0.05")
    kernel: Any = SimpleNamespace(
        name="scan_top", variant=SimpleNamespace(stem="scan"), cl_kernel=lambda *_: Event(status)
    )
    with pytest.raises(DriverError, match=r"scan\.cl") as error:
        waiting.enqueue(kernel, (1,), (1,), ())
    assert text in str(error.value)


def test_a_value_that_makes_no_sense(monkeypatch: pytest.MonkeyPatch) -> None:
    device = open_device()
    monkeypatch.setenv("CLSPLAT_SYNC", "yes")
    refuses("CLSPLAT_SYNC=yes: expected 1, or 0", device.with_shape, items=device.shape.items)
