# SPDX-License-Identifier: Apache-2.0
"""scan.cl against NumPy, at sizes around a group's and a chunk's."""

from __future__ import annotations

import numpy as np
import pytest
from pipeline import shaped
from quick import quick

from clsplat.device.buffers import Workspace, allocate, upload
from clsplat.device.context import Device
from clsplat.selftest.case import faults
from clsplat.selftest.cases.primitives import SCAN_CASE
from clsplat.stages.scan import CHUNK_ELEMENTS_PER_ITEM, MAX_SCAN_GROUPS, scan


@pytest.mark.parametrize("items", quick((16, 32, 128, 256), 16))
def test_scan_in_every_size_of_group(device: Device, items: int) -> None:
    """One launch up to a chunk, two beyond it, and chunks of several times the usual size."""
    chunk = CHUNK_ELEMENTS_PER_ITEM * items
    for n in (chunk, chunk + 1, 2 * MAX_SCAN_GROUPS * chunk + 1 if items == 16 else 3 * chunk - 1):
        given = SCAN_CASE.random(np.random.default_rng(n), n)
        assert faults(SCAN_CASE.errors(shaped(device, 1, items), given)) == []


@pytest.mark.parametrize(("n", "value"), [(48_000, 0x00020000), (9, 0x80000000), (50_000, 0x00014F8C)])
def test_a_total_over_32_bits_is_told(shaped_device: Device, n: int, value: int) -> None:
    """Over many chunks, within one, and by little: 2^32 + 32,704."""
    values = upload(shaped_device, np.full(n, value, np.uint32))
    total = allocate(shaped_device, (1,), np.uint32)
    scan(shaped_device, Workspace(shaped_device), values, values, total)
    assert total.get()[0] == 0xFFFFFFFF
