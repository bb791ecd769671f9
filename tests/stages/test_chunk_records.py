# SPDX-License-Identifier: Apache-2.0
"""Copies of chunks between records and the slots of a pool: every bit, both ways, and no other slot."""

from __future__ import annotations

from typing import Any

import numpy as np
import pytest
from numpy.typing import NDArray
from quick import quick

from clsplat.chunks.store import record_type
from clsplat.device.buffers import DeviceArray, upload
from clsplat.device.context import Device
from clsplat.gaussians import group_shapes
from clsplat.layouts.columns import CHUNK_ROWS
from clsplat.stages.chunk_records import copy_chunks

SIZES = [(count, coefficients) for count in (1, 2, 33) for coefficients in (1, 4, 16)]
"""Numbers of chunks and of SH coefficients: `sh_rest` has 0, 3 or 15 of them."""
SPARE = 3
"""Slots that no copy uses."""


def fields_of(coefficients: int) -> dict[str, tuple[int, ...]]:
    return {f"first/{name}": shape[1:] for name, shape in group_shapes(1, coefficients).items()}


def any_bits(rng: np.random.Generator, shape: tuple[int, ...]) -> NDArray[np.float32]:
    """Values of any bits, half of them NaN, signalling ones too."""
    words = rng.integers(0, 1 << 32, shape, dtype=np.uint32)
    words[rng.random(shape) < 0.5] |= 0x7F800001
    return words.view(np.float32)


def pool_of(
    device: Device, rng: np.random.Generator, slots: int, coefficients: int
) -> tuple[dict[str, NDArray[np.float32]], dict[str, DeviceArray]]:
    """What is in the slots, on the host and on the device."""
    held = {name: any_bits(rng, (CHUNK_ROWS * slots, *shape)) for name, shape in fields_of(coefficients).items()}
    return held, {name: upload(device, values) for name, values in held.items()}


def bits(values: NDArray[Any]) -> NDArray[np.uint32]:
    return np.ascontiguousarray(values).view(np.uint32)


@pytest.mark.parametrize("size", quick(SIZES, (1, 1), (2, 4), (33, 16)))
def test_both_ways(device: Device, size: tuple[int, int]) -> None:
    count, coefficients = size
    rng, record = np.random.default_rng(size), record_type(fields_of(coefficients))
    held, arrays = pool_of(device, rng, count + SPARE, coefficients)
    slots = rng.permutation(count + SPARE)[:count].astype(np.uint32)
    rows = (CHUNK_ROWS * slots[:, None] + np.arange(CHUNK_ROWS)).astype(np.int64)

    words = count * record.itemsize // 4
    steps = rng.integers(0, 1 << 32, count + SPARE, dtype=np.uint32)
    from_pool, on_device, caught = (
        upload(device, np.zeros(words + count, np.uint32)),
        upload(device, slots),
        upload(device, steps),
    )
    copy_chunks(device, on_device, from_pool, record, arrays, caught, to_records=True)
    read = from_pool.get()[:words].view(record)
    assert from_pool.get()[words:].tolist() == steps[slots].tolist()
    assert record.names is not None
    for name in record.names:
        assert (bits(read[name]) == bits(held[name][rows])).all(), name
        assert (bits(arrays[name].get()) == bits(held[name])).all(), "a copy to records changes the pool"

    given = any_bits(rng, (words + count,)).view(np.uint32)
    copy_chunks(device, on_device, upload(device, given), record, arrays, caught, to_records=False)
    steps[slots] = given[words:]
    assert caught.get().tolist() == steps.tolist()
    for name in record.names:
        held[name][rows] = given[:words].view(record)[name]
        assert (bits(arrays[name].get()) == bits(held[name])).all(), name


def test_a_field_without_elements_is_no_part_of_a_record(device: Device) -> None:
    """`sh_rest` of degree 0 has an array without elements, which no launch gets."""
    record = record_type(fields_of(1))
    assert "first/sh_rest" not in (record.names or ())
    assert record.itemsize == 4 * CHUNK_ROWS * (3 + 4 + 3 + 1 + 3)
    _, arrays = pool_of(device, np.random.default_rng(0), 1, 1)
    before = device.calls.launches
    copy_chunks(
        device,
        upload(device, np.zeros(1, np.uint32)),
        upload(device, np.zeros(record.itemsize // 4 + 1, np.uint32)),
        record,
        arrays,
        upload(device, np.zeros(1, np.uint32)),
        to_records=True,
    )
    assert device.calls.launches - before == 5 + 1, "five fields, and the steps that chunks have been caught up to"
