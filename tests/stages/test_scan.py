# SPDX-License-Identifier: Apache-2.0
"""scan.cl against NumPy, at sizes around a group's and a chunk's."""

from __future__ import annotations

import numpy as np
import pytest
from pipeline import shaped
from quick import quick

from clsplat.device.buffers import Workspace, allocate, upload
from clsplat.device.context import Device
from clsplat.stages.scan import CHUNK_ELEMENTS_PER_ITEM, MAX_SCAN_GROUPS, MAX_SINGLE_CHUNK_ELEMENTS, scan

SIZES = (
    1,
    2,
    63,
    64,
    65,
    1023,
    1024,
    1025,
    4096,
    4097,
    MAX_SINGLE_CHUNK_ELEMENTS - 1,
    MAX_SINGLE_CHUNK_ELEMENTS,
    MAX_SINGLE_CHUNK_ELEMENTS + 1,
    100_003,
)


def check(device: Device, n: int) -> None:
    values = np.random.default_rng(n).integers(0, 4, n).astype(np.uint32)
    out = upload(device, np.full(n, 0xFFFFFFFF, np.uint32))
    sum_array = allocate(device, (1,), np.uint32)
    scan(device, Workspace(device), upload(device, values), out, sum_array)
    np.testing.assert_array_equal(out.get(), np.concatenate([[0], np.cumsum(values)[:-1]]))
    assert sum_array.get()[0] == values.sum()


@pytest.mark.parametrize("n", SIZES)
def test_exclusive_prefix_sum(shaped_device: Device, n: int) -> None:
    check(shaped_device, n)


@pytest.mark.parametrize("items", quick((16, 32, 128, 256), 16))
def test_scan_in_every_size_of_group(device: Device, items: int) -> None:
    """One launch up to a chunk, two beyond it, and chunks of several times the usual size."""
    chunk = CHUNK_ELEMENTS_PER_ITEM * items
    for n in (chunk, chunk + 1, 2 * MAX_SCAN_GROUPS * chunk + 1 if items == 16 else 3 * chunk - 1):
        check(shaped(device, 1, items), n)


def test_scan_in_place(shaped_device: Device) -> None:
    values = np.arange(3 * MAX_SINGLE_CHUNK_ELEMENTS - 1, dtype=np.uint32)
    work = Workspace(shaped_device)
    array, out = upload(shaped_device, values), allocate(shaped_device, (1,), np.uint32)
    scan(shaped_device, work, array, array, out)
    np.testing.assert_array_equal(array.get(), np.cumsum(values) - values)


def test_nothing_to_scan(shaped_device: Device) -> None:
    out = upload(shaped_device, np.full(1, 7, np.uint32))
    scan(shaped_device, Workspace(shaped_device), allocate(shaped_device, (0,), np.uint32), out, out)
    assert out.get()[0] == 0


@pytest.mark.parametrize(("n", "value"), [(48_000, 0x00020000), (9, 0x80000000), (50_000, 0x00014F8C)])
def test_a_total_over_32_bits_is_told(shaped_device: Device, n: int, value: int) -> None:
    """Over many chunks, within one, and by little: 2^32 + 32,704."""
    values = upload(shaped_device, np.full(n, value, np.uint32))
    total = allocate(shaped_device, (1,), np.uint32)
    scan(shaped_device, Workspace(shaped_device), values, values, total)
    assert total.get()[0] == 0xFFFFFFFF
