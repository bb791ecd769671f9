# SPDX-License-Identifier: Apache-2.0
"""--max-device-mem: sizes are read, buffers are counted, and the limit holds."""

from __future__ import annotations

import numpy as np
import pytest
from calls import refuses

from clsplat.cli.main import main
from clsplat.config.checks import parse_bytes
from clsplat.device.buffers import Workspace, allocate
from clsplat.device.context import Device
from clsplat.device.selection import open_device
from clsplat.errors import CapacityError


@pytest.mark.parametrize(
    ("text", "size"),
    [
        ("256MiB", 256 * 2**20),
        ("2GiB", 2 * 2**30),
        ("1.5G", 3 * 2**29),
        ("1.5g", 3 * 2**29),
        ("300KiB", 300 * 2**10),
        ("500MB", 500_000_000),
        ("1 TB", 10**12),
        ("4096", 4096),
        ("4096B", 4096),
    ],
)
def test_sizes_that_can_be_read(text: str, size: int) -> None:
    assert parse_bytes(text) == size


@pytest.mark.parametrize("text", ["", "lots", "-1MiB", "0", "0.1", "1.5X", "MiB", "1e9", "nan", "1 000"])
def test_sizes_that_make_no_sense(text: str) -> None:
    refuses(r"--max-device-mem .*expected a size such as 256MiB", parse_bytes, text)


@pytest.mark.parametrize(
    "call",
    [
        ["train", "nowhere", "-o", "never"],
        ["eval", "nowhere.ply"],
        ["render", "nowhere.ply", "--cameras", ".", "-o", "{name}.png"],
        ["bench"],
    ],
    ids=lambda call: call[0],
)
def test_a_bad_size_is_exit_status_2(call: list[str], capsys: pytest.CaptureFixture[str]) -> None:
    assert main([*call, "--max-device-mem", "lots"]) == 2
    assert "--max-device-mem lots: expected a size" in capsys.readouterr().err


def test_buffers_are_counted_while_they_live(default_device: Device) -> None:
    device = default_device.with_memory_limit(10_000)
    first = allocate(device, (1000,), np.float32)
    second = allocate(device, (1500,), np.float32).reshaped(3, 500)
    assert device.memory.used == device.memory.peak == 10_000
    del second
    assert (device.memory.used, device.memory.peak) == (4000, 10_000)
    said = "--max-device-mem 10,000 bytes is too little: 4,000 bytes of the device's memory are in use, and 6,004 bytes"
    refuses(said, allocate, device, (1501,), np.float32, error=CapacityError)
    del first
    assert device.memory.used == 0


def test_a_limit_is_its_own_devices(default_device: Device) -> None:
    limited = open_device(None, 1234)
    assert (limited.memory.limit, limited.budget) == (1234, 1234)
    assert open_device().memory.limit is None
    assert limited.with_switches({}).memory is limited.memory
    assert default_device.budget == default_device.cl_device.global_mem_size


def test_a_workspace_needs_no_room_for_what_it_replaces(default_device: Device) -> None:
    device = default_device.with_memory_limit(8000)
    work = Workspace(device)
    for elements in (100, 1500, 2000, 50):
        assert work.array("a", (elements,)).shape == (elements,)
    assert device.memory.used == device.memory.peak == 8000
    work.clear()
    assert device.memory.used == 0


def test_a_workspace_hands_out_what_it_has(default_device: Device, monkeypatch: pytest.MonkeyPatch) -> None:
    work = Workspace(default_device)
    first = work.array("a", (6, 2))
    assert work.array("a", (6, 2)) is first
    assert work.array("a", (6, 2), np.uint32).dtype == np.uint32
    assert work.array("a", (12,)).buffer is first.buffer
    assert work.array("a", (100,)).buffer is not first.buffer
    assert work.array("a", (6, 2)).buffer is not first.buffer, "a buffer that was replaced is not handed out"
    monkeypatch.setenv("CLSPLAT_POISON", "1")
    work = Workspace(default_device)
    for _ in range(2):
        array = work.array("a", (3,))
        assert np.isnan(array.get()).all()
        array.fill(0.0)
