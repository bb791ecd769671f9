# SPDX-License-Identifier: Apache-2.0
"""Both sorts alone against NumPy's stable sort: seam sizes, equal keys, extremes, few bits."""

from __future__ import annotations

from copy import copy

import numpy as np
import pytest
from numpy.typing import NDArray
from pipeline import shaped
from quick import quick

from clsplat.device.buffers import Workspace, upload
from clsplat.device.context import Device
from clsplat.stages import scan as stages_scan
from clsplat.stages.scan import CHUNK_ELEMENTS_PER_ITEM, MAX_SINGLE_CHUNK_ELEMENTS
from clsplat.stages.sort import (
    BITONIC_KEYS_BY_KIND,
    MAX_BITONIC_KEYS,
    WIDE_DIGIT_BITS,
    bitonic_sort,
    radix_sort,
    sort,
)


def check(keys: NDArray[np.uint32], result: tuple[NDArray[np.uint32], NDArray[np.uint32]]) -> None:
    expected = np.argsort(keys, kind="stable")
    np.testing.assert_array_equal(result[1], expected)
    np.testing.assert_array_equal(result[0], keys[expected])


def radix(
    device: Device, keys: NDArray[np.uint32], bits: int, base: int = 0
) -> tuple[NDArray[np.uint32], NDArray[np.uint32]]:
    out = radix_sort(device, Workspace(device), "test", upload(device, keys), bits, base)
    return out[0].get(), out[1].get()


def bitonic(device: Device, keys: NDArray[np.uint32]) -> tuple[NDArray[np.uint32], NDArray[np.uint32]]:
    out = bitonic_sort(device, Workspace(device), "test", upload(device, keys))
    return out[0].get(), out[1].get()


def test_one_item_sorts_a_chunk_in_one_launch(device: Device) -> None:
    """And leaves what it has in the arrays of its last pass: one, two and three passes."""
    alone = shaped(device, 1, 1)
    for bits in (WIDE_DIGIT_BITS, WIDE_DIGIT_BITS + 1, 32):
        keys = np.random.default_rng(bits).integers(0, 2**bits, MAX_SINGLE_CHUNK_ELEMENTS, dtype=np.uint32)
        before = copy(alone.calls)
        check(keys, radix(alone, keys, bits))
        assert alone.calls.since(before).launches == 1


GROUPS = (16, 32, 64, 128, 256)
"""Items of a group: what a GPU may have."""


@pytest.mark.parametrize("items", quick(GROUPS, 64))
def test_radix_at_the_seams_of_a_group_s_tiles(device: Device, items: int) -> None:
    """One key less and one more than a tile, and a second pass over tiles that are not full; digits of 1 to 8 bits."""
    shaped_device, tile = shaped(device, 1, items), CHUNK_ELEMENTS_PER_ITEM * items
    for n, bits in ((tile - 1, 1), (tile, 4), (tile + 1, 5), (2 * tile, 8), (3 * tile + 7, 13), (5 * tile - 1, 32)):
        keys = np.random.default_rng(n).integers(0, 2**bits, n, dtype=np.uint32)
        check(keys, radix(shaped_device, keys, bits))


def test_radix_of_several_tiles_a_group(device: Device, monkeypatch: pytest.MonkeyPatch) -> None:
    """More keys than MOST_GROUPS tiles hold: a group goes over two or three tiles, the last of them cut."""
    monkeypatch.setattr(stages_scan, "MAX_SCAN_GROUPS", 4)
    items = 64  # whose kernels other tests have too
    for n in (5 * CHUNK_ELEMENTS_PER_ITEM * items, 12 * CHUNK_ELEMENTS_PER_ITEM * items - 3):
        keys = np.random.default_rng(n).integers(0, 2**12, n, dtype=np.uint32)
        check(keys, radix(shaped(device, 1, items), keys, 12))


def test_sort_takes_the_one_that_wins(device: Device) -> None:
    for n in (BITONIC_KEYS_BY_KIND[device.kind], BITONIC_KEYS_BY_KIND[device.kind] + 1):
        keys = np.random.default_rng(n).integers(0, 1000, n, dtype=np.uint32)
        out = sort(device, Workspace(device), "test", upload(device, keys), 10)
        check(keys, (out[0].get(), out[1].get()))


def test_bitonic_refuses_more_than_local_memory_holds(device: Device) -> None:
    with pytest.raises(ValueError, match="at most"):
        bitonic(device, np.zeros(MAX_BITONIC_KEYS + 1, np.uint32))
