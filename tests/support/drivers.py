# SPDX-License-Identifier: Apache-2.0
"""The OpenCL devices that tests run on, and the kernel shapes that each of them supports.

CLSPLAT_TEST_DRIVERS, words separated by commas, selects the devices whose platform, version or name contains one of
them.

The extra `test` brings PoCL, so that there is a device everywhere. Without any, pytest skips the tests of the fixtures
`device` and `shaped_device`, which have a parameter for each device, and tests of `default_device` fail.
"""

from __future__ import annotations

import atexit
import os
import shutil
import tempfile
from functools import cache
from pathlib import Path

import pytest

from clsplat.device.context import all_devices
from clsplat.device.drivers.shapes import Shape, default_shape
from clsplat.device.selection import DeviceInfo, list_devices
from clsplat.files.atomic import atomic_write
from clsplat.selftest.driver_check import examine

NARROW = "CLSPLAT_TEST_DRIVERS"
SESSION = "CLSPLAT_TEST_SESSION"
"""Environment variable with the folder of files that all processes of a run share.

The first process sets it, and removes the folder at its end.
"""


def _kept() -> list[DeviceInfo]:
    words = [word.strip().lower() for word in os.environ.get(NARROW, "").split(",") if word.strip()]
    texts = {info.index: f"{info.platform} {info.version} {info.name}".lower() for info in list_devices()}
    return [info for info in list_devices() if not words or any(word in texts[info.index] for word in words)]


KEPT = {info.index: info for info in _kept()}
"""The selected devices, by index."""
if os.environ.get(NARROW) and KEPT:
    os.environ["CLSPLAT_DEVICE"] = str(min(KEPT))  # also for child processes


def check_some_are_kept() -> None:
    """Raise UsageError if CLSPLAT_TEST_DRIVERS selects no device."""
    if os.environ.get(NARROW) and not KEPT:
        there = "; ".join(f"{info.version}, {info.name}" for info in list_devices()) or "none"
        words = f"{NARROW}={os.environ[NARROW]}"
        raise pytest.UsageError(f"{words}: no OpenCL device contains one of these words; there are: {there}")


def label(index: int) -> str:
    """Short name and version of a driver."""
    words = KEPT[index].version.replace("+", " ").split()
    number = words[words.index("PoCL") + 1] if "PoCL" in words else words[1]
    return f"{KEPT[index].platform.split()[0]}-{number}"


def begin_session() -> None:
    """Make the folder that all processes of this run share, if this is the first process."""
    if SESSION not in os.environ:
        folder = tempfile.mkdtemp(prefix="clsplat-tests-")
        os.environ[SESSION] = folder
        atexit.register(shutil.rmtree, folder, ignore_errors=True)


@cache
def why_not(index: int, lanes: int, items: int) -> str:
    """Reason why kernels in this shape cannot run on a device, found by a trial in another process; empty if they can.

    PoCL 3.0 aborts at the first launch of a kernel with a square root of 16 lanes, if its compiler does not recognise
    that the processor has AVX-512. A wrong result is no reason, because tests are to find it.
    """
    device = all_devices()[index]
    if lanes <= default_shape(device).lanes:
        return ""
    answer = Path(os.environ[SESSION]) / f"{index}-{lanes}x{items}"
    if answer.exists():
        return answer.read_text()
    with pytest.MonkeyPatch.context() as patch:
        # a cache of its own, because an aborted build leaves a program without kernels in it
        patch.setenv("POCL_CACHE_DIR", tempfile.mkdtemp(dir=answer.parent))
        report = examine(index, Shape(lanes, items, default_shape(device).chunks), ("arithmetic",), quick=True)
    driver = " ".join(device.platform.version.split("  ")[0].split()[2:])
    ends = {"signal": "aborts", "did not answer": "hangs", "DeviceError": "cannot be used"}
    how = next((verb for words, verb in ends.items() if words in report.end), "")
    reason = f"{driver} {how} in {lanes}x{items} on this processor" if how else ""
    atomic_write(answer, reason.encode())
    return reason
