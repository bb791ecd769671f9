# SPDX-License-Identifier: Apache-2.0
"""Multiply-adds, halves, both sorts and prefix sums at the seams of groups, launches and digits; all have cases too."""

from __future__ import annotations

from copy import copy

import numpy as np
import pytest
from numpy.typing import NDArray
from pipeline import shaped
from quick import quick

from clsplat.device.buffers import Workspace, allocate, upload
from clsplat.device.context import Device
from clsplat.device.launch import launch_grid
from clsplat.selftest.case import Inputs, faults
from clsplat.selftest.cases.primitives import SCAN_CASE, SORT_CASE
from clsplat.stages import scan as stages_scan
from clsplat.stages.scan import CHUNK_ELEMENTS_PER_ITEM, MAX_SCAN_GROUPS, MAX_SINGLE_CHUNK_ELEMENTS, scan
from clsplat.stages.sort import BITONIC_KEYS_BY_KIND, MAX_BITONIC_KEYS, WIDE_DIGIT_BITS, sort


def test_multiply_add_has_one_rounding(shaped_device: Device) -> None:
    lanes = shaped_device.shape.lanes
    out = allocate(shaped_device, (2 * lanes,), np.float32)
    factor = float(np.float32(1 + 2.0**-12))
    launch_grid(shaped_device, shaped_device.kernels("probe").probe_fma, (1,), out, factor, -(1 + 2.0**-11))
    np.testing.assert_array_equal(out.get(), np.float32(2.0**-24))


def test_every_finite_half(shaped_device: Device) -> None:
    bits = np.arange(2**16, dtype=np.uint16)
    bits = bits[np.isfinite(bits.view(np.float16))]
    out = allocate(shaped_device, (len(bits), 4), np.float32)
    launch_grid(
        shaped_device, shaped_device.kernels("probe").probe_half, (len(bits),), upload(shaped_device, bits), out
    )
    wanted = np.repeat(bits.view(np.float16).astype(np.float32)[:, None], 4, axis=1)
    np.testing.assert_array_equal(out.get().view(np.uint32), wanted.view(np.uint32))


def sort_errors(device: Device, keys: NDArray[np.uint32], bits: int | None) -> list[str]:
    """Of the radix sort, or, without bits, of the bitonic one."""
    return faults(SORT_CASE.errors(device, Inputs(keys=keys, bits=bits, base=None if bits is None else 0)))


def test_one_item_sorts_a_chunk_in_one_launch(device: Device) -> None:
    """And leaves what it has in the arrays of its last pass: one, two and three passes."""
    alone = shaped(device, 1, 1)
    for bits in (WIDE_DIGIT_BITS, WIDE_DIGIT_BITS + 1, 32):
        keys = np.random.default_rng(bits).integers(0, 2**bits, MAX_SINGLE_CHUNK_ELEMENTS, dtype=np.uint32)
        before = copy(alone.calls)
        assert sort_errors(alone, keys, bits) == []
        assert alone.calls.since(before).launches == 1


GROUPS = (16, 32, 64, 128, 256)
"""Items of a group: what a GPU may have."""


@pytest.mark.parametrize("items", quick(GROUPS, 64))
def test_radix_at_the_seams_of_a_group_s_tiles(device: Device, items: int) -> None:
    """One key less and one more than a tile, and a second pass over tiles that are not full; digits of 1 to 8 bits."""
    shaped_device, tile = shaped(device, 1, items), CHUNK_ELEMENTS_PER_ITEM * items
    for n, bits in ((tile - 1, 1), (tile, 4), (tile + 1, 5), (2 * tile, 8), (3 * tile + 7, 13), (5 * tile - 1, 32)):
        keys = np.random.default_rng(n).integers(0, 2**bits, n, dtype=np.uint32)
        assert sort_errors(shaped_device, keys, bits) == []


def test_radix_of_several_tiles_a_group(device: Device, monkeypatch: pytest.MonkeyPatch) -> None:
    """More keys than MOST_GROUPS tiles hold: a group goes over two or three tiles, the last of them cut."""
    monkeypatch.setattr(stages_scan, "MAX_SCAN_GROUPS", 4)
    items = 64  # whose kernels other tests have too
    for n in (5 * CHUNK_ELEMENTS_PER_ITEM * items, 12 * CHUNK_ELEMENTS_PER_ITEM * items - 3):
        keys = np.random.default_rng(n).integers(0, 2**12, n, dtype=np.uint32)
        assert sort_errors(shaped(device, 1, items), keys, 12) == []


def test_sort_takes_the_one_that_wins(device: Device) -> None:
    for n in (BITONIC_KEYS_BY_KIND[device.kind], BITONIC_KEYS_BY_KIND[device.kind] + 1):
        keys = np.random.default_rng(n).integers(0, 1000, n, dtype=np.uint32)
        sorted_keys, places = sort(device, Workspace(device), "test", upload(device, keys), 10)
        np.testing.assert_array_equal(places.get(), np.argsort(keys, kind="stable"))
        np.testing.assert_array_equal(sorted_keys.get(), np.sort(keys))


def test_bitonic_refuses_more_than_local_memory_holds(device: Device) -> None:
    with pytest.raises(ValueError, match="at most"):
        sort_errors(device, np.zeros(MAX_BITONIC_KEYS + 1, np.uint32), None)


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
