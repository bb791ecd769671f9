# SPDX-License-Identifier: Apache-2.0
"""Launches sort_radix.cl and sort_bitonic.cl: stable sorts of uint32 keys, with the keys' positions in the input.

A frame's lists need two sorts: by depth in `stages/duplicate.py`, then of the pairs by tile in `stages/ranges.py`.
Lists by append (`stages/append.py`) are sorted tile by tile in their own kernel.
"""

from __future__ import annotations

import numpy as np

from clsplat.device import cl
from clsplat.device.buffers import DeviceArray, Workspace
from clsplat.device.context import Device
from clsplat.device.launch import launch_groups
from clsplat.stages.scan import Elements, chunking

MAX_BITONIC_KEYS = 2048
"""Maximum number of keys for bitonic sort. Keys and positions then take 16 KiB of local memory; every device has 32."""

BITONIC_KEYS_BY_KIND = {"cpu": 512, "gpu": 1024, "other": 1024}
"""Number of keys up to which bitonic sort, a single launch, is faster than radix sort, by kind of device."""


_SORTED_ARRAYS = ("keys", "positions")
SORT_KEY_BYTES = 16
"""Bytes per key of a sort: the key and its position, each in two alternating arrays."""

WIDE_DIGIT_BITS, MIN_WIDE_DIGIT_KEYS = 13, 1 << 17
"""Bits of a wide digit, and the number of keys from which it is used, for groups of one item.

The counters of a wide digit fill 32 KiB of local memory. From this number of keys on, fewer passes save more time than
the larger histograms cost.
"""


def _widest_digit(device: Device, n: int) -> int:
    """Return the bits of a digit in the passes over `n` keys. `Shape.digit_bits`: `device/drivers/shapes.py`."""
    return WIDE_DIGIT_BITS if device.shape.items == 1 and n >= MIN_WIDE_DIGIT_KEYS else device.shape.digit_bits


def scratch_bytes(device: Device, n: int) -> int:
    """Return an upper bound of the scratch bytes of sorts and scans of `n` elements, apart from the results."""
    groups = max(chunking(device, n, device.shape.sort_items)[0], device.shape.chunks)
    histograms_and_totals = 4 * (1 << _widest_digit(device, n)) * (groups + 1)
    return histograms_and_totals + 8 * groups  # the sums of scans


def radix_sort(
    device: Device,
    work: Workspace,
    name: str,
    keys: DeviceArray,
    bits: int,
    base: int = 0,
    elements: Elements | None = None,
) -> tuple[DeviceArray, DeviceArray]:
    """Sort uint32 keys by radix sort. Returns the sorted keys and their positions in the input, workspace arrays whose
    names begin with `name`.

    bits: number of low bits by which the keys minus `base` are sorted.
    base: not larger than any key.
    elements: the number of keys to sort; None sorts all.

    The sort makes as few passes as the widest digit allows, with digits of equal width.
    """
    n, items = keys.shape[0], device.shape.sort_items
    elements = elements or Elements(n)
    groups, chunk = chunking(device, n, items)
    kernels = device.kernels("sort_radix", {"ITEMS": items, **elements.defines})
    alone = groups == items == 1
    passes = max(-(-bits // (WIDE_DIGIT_BITS if alone else _widest_digit(device, n))), 1)
    digit_bits = -(-bits // passes) or 1
    digits = 1 << digit_bits
    counters = cl.LocalMemory(4 * digits)
    turns = [
        [work.array(f"{name}_{kind}{turn}", (n,), np.uint32) for kind in _SORTED_ARRAYS]
        for turn in range(min(passes, 2))
    ]
    if alone:
        numbers = (*elements.arguments, base, digit_bits, passes)
        launch_groups(device, kernels.radix_sort, 1, 1, *numbers, keys, *turns[0], *turns[-1], counters)
        keys_out, positions_out = turns[(passes - 1) % 2]
        return keys_out, positions_out
    rows = 1 if items > 1 else -(-digits // device.shape.chunks)
    histograms = work.array("radix_histograms", (digits * groups,), np.uint32)
    totals = work.array("radix_totals", (digits,), np.uint32)
    positions = keys
    for index in range(passes):
        chunks = (groups, items, *elements.arguments, chunk, base, index * digit_bits, digits)
        keys_out, positions_out = turns[index % 2]
        launch_groups(device, kernels.radix_histogram, *chunks, keys, histograms, counters)
        offsets = (groups, digits, rows, histograms, totals)
        launch_groups(device, kernels.radix_offsets, -(-digits // rows), items, *offsets)
        arrays = (keys, positions, histograms, totals, keys_out, positions_out)
        launch_groups(device, kernels.radix_scatter, *chunks, index == 0, *arrays, counters)
        keys, positions = keys_out, positions_out
    return keys, positions


def bitonic_sort(
    device: Device, work: Workspace, name: str, keys: DeviceArray, elements: Elements | None = None
) -> tuple[DeviceArray, DeviceArray]:
    """Sort at most MAX_BITONIC_KEYS keys in one launch. Returns sorted keys and their positions in the input.

    elements: the number of keys to sort; None sorts all.
    """
    n = keys.shape[0]
    if n > MAX_BITONIC_KEYS:
        raise ValueError(f"{n} keys: bitonic_sort takes at most {MAX_BITONIC_KEYS}")
    elements = elements or Elements(n)
    padded = 1 << max(n - 1, 0).bit_length()
    keys_out = work.array(f"{name}_keys0", (n,), np.uint32)
    positions_out = work.array(f"{name}_positions0", (n,), np.uint32)
    local = cl.LocalMemory(4 * padded)
    kernel = device.kernels("sort_bitonic", elements.defines).bitonic_sort
    arrays = (keys, keys_out, positions_out, local, local)
    launch_groups(device, kernel, 1, device.shape.items, *elements.arguments, padded, *arrays)
    return keys_out, positions_out


def sort(
    device: Device,
    work: Workspace,
    name: str,
    keys: DeviceArray,
    bits: int,
    base: int = 0,
    elements: Elements | None = None,
) -> tuple[DeviceArray, DeviceArray]:
    """Sort by the method that is faster for this number of keys. Returns sorted keys and their positions in the input.

    bits: number of low bits that can be set in a key minus `base`.
    base: not larger than any key.
    elements: the number of keys to sort; None sorts all.
    """
    if keys.shape[0] <= BITONIC_KEYS_BY_KIND[device.kind]:
        return bitonic_sort(device, work, name, keys, elements)
    return radix_sort(device, work, name, keys, bits, base, elements)
