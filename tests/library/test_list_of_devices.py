# SPDX-License-Identifier: Apache-2.0
"""`clsplat.devices`, and errors of a device that a call in Python names: of its argument, not of the flag."""

from __future__ import annotations

from collections.abc import Callable
from typing import Any

import numpy as np
import pytest
import scenes
from calls import refuses

import clsplat
from clsplat import api
from clsplat.device.selection import list_devices
from clsplat.errors import DeviceError
from clsplat.library.harmonics import spherical_harmonics


def rendered(device: str) -> Any:
    return clsplat.render(*scenes.random_cloud(10, 1, 20, 16, degree=0), device=device)


def opened(device: str) -> Any:
    return api._opened(device, None)  # of `clsplat.train`


def summed(device: str) -> Any:
    return spherical_harmonics(0, np.ones((1, 3)), np.ones((1, 1, 3)), device=device)


def test_the_list_is_that_of_the_command() -> None:
    found = clsplat.devices()
    assert found == list_devices()
    assert [info.index for info in found] == list(range(len(found)))
    assert "devices" in clsplat.__all__


@pytest.mark.parametrize(
    ("call", "device"),
    [(rendered, "abacus"), (rendered, "0,1"), (summed, "abacus"), (summed, "0,1"), (opened, "abacus"), (opened, "0,0")],
)
def test_a_device_that_is_none_is_named_without_the_flag(call: Callable[[str], Any], device: str) -> None:
    assert "--device" not in refuses(rf"^device {device}: ", call, device, error=DeviceError)
