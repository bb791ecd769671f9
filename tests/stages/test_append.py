# SPDX-License-Identifier: Apache-2.0
"""append.cl: the lists of duplicate.cl, sort_radix.cl and ranges.cl, whatever order Gaussians are appended in; it has a
case too."""

from __future__ import annotations

from typing import Any

import numpy as np
import pytest
from compare import assert_same_bits
from numpy.typing import NDArray
from pipeline import shaped
from quick import quick

from clsplat.device.buffers import Workspace, upload
from clsplat.device.context import Device
from clsplat.device.launch import launch_groups
from clsplat.layouts.columns import READBACK
from clsplat.reference.append import lists_of
from clsplat.selftest.case import faults, fresh_readback
from clsplat.selftest.cases.primitives import APPEND_CASE, boxes_of, depths_of, projected_boxes
from clsplat.stages import append as stages_append
from clsplat.stages import probe_atomics
from clsplat.stages.append import append, appends
from clsplat.stages.duplicate import Band, count, duplicate
from clsplat.stages.probe_atomics import atomics_fault
from clsplat.stages.ranges import TileLists, tile_lists

SCENES = 200
RUNS = 5
GROUP_ITEMS = 64


def scene(seed: int) -> tuple[NDArray[np.int64], NDArray[np.float32], tuple[int, int]]:
    """Boxes, depths and the image's tiles; among ten scenes, each of the seams."""
    rng = np.random.default_rng(seed)
    tiles = (int(rng.integers(1, 20)), int(rng.integers(1, 20)))
    boxes = boxes_of(rng, int(rng.choice([1, 2, 63, 64, 65, 300, 1000])), tiles)
    depths = depths_of(rng, len(boxes))
    if seed % 10 == 0:
        depths[:] = 3.0
    elif seed % 10 == 1:
        boxes[:] = (0, tiles[0], 0, tiles[1])
    elif seed % 10 == 2:
        boxes[:, 1] = boxes[:, 0]
    return boxes, depths, tiles


def long_lists(*lengths: int) -> tuple[NDArray[np.int64], NDArray[np.float32], tuple[int, int]]:
    """Lists of these lengths, a tile for each, of Gaussians of one tile in mixed order; many depths are equal."""
    rng = np.random.default_rng(lengths)
    tile = rng.permutation(np.repeat(np.arange(len(lengths)), lengths))
    boxes = np.stack([tile, tile + 1, 0 * tile, 0 * tile + 1], axis=1)
    return boxes, rng.integers(1, 1 + len(tile) // 4, len(tile)).astype(np.float32), (len(lengths), 1)


class Lists:
    """The lists of one scene by both ways, on the device."""

    def __init__(
        self, device: Device, boxes: NDArray[np.int64], depths: NDArray[np.float32], tiles: tuple[int, int]
    ) -> None:
        self.device, self.tiles, self.work = device, tiles, Workspace(device)
        counts = np.prod(boxes[:, 1::2] - boxes[:, ::2], axis=1).astype(np.uint32)
        self.pairs = int(counts.sum())
        self.boxes, self.depths, self.counts = boxes, depths, upload(device, counts)
        self.projected = projected_boxes(device, boxes, depths, tiles, self.counts)

    def radix(self) -> list[NDArray[np.uint32]]:
        band, work = Band(0, self.tiles[0] * self.tiles[1]), Workspace(self.device)
        counted = count(self.device, work, self.projected)
        pairs = duplicate(self.device, work, self.projected.splats, counted, self.tiles, band)
        return self.read(tile_lists(self.device, work, pairs, band))

    def appended(self) -> list[NDArray[np.uint32]]:
        host = np.zeros(len(READBACK), np.uint32)
        readback = fresh_readback(self.device)  # must live until the kernels that read it have ended
        projected = projected_boxes(self.device, self.boxes, self.depths, self.tiles, self.counts)
        _, lists = append(self.device, self.work, projected, self.tiles, readback, self.pairs + 3, host)
        return self.read(lists)

    def read(self, lists: TileLists) -> list[NDArray[np.uint32]]:
        found = lists.gaussian_from_sorted.get()[: self.pairs], lists.slot_from_sorted.get()[: self.pairs]
        return [lists.ranges.get(), *found]


def assert_same_lists(one: list[NDArray[np.uint32]], other: list[NDArray[np.uint32]]) -> None:
    for got, wanted in zip(one, other, strict=True):
        assert_same_bits(got, wanted)


@pytest.mark.slow
def test_lists_are_the_radix_sort_s(device: Device) -> None:
    """Of random scenes, among them equal depths, boxes of all tiles and empty lists; the same in every run."""
    grouped = shaped(device, 1, GROUP_ITEMS)
    for seed in range(SCENES):
        lists = Lists(grouped, *scene(seed))
        wanted = lists.radix()
        for _ in range(RUNS if seed % 20 == 0 else 1):
            assert_same_lists(lists.appended(), wanted)


@pytest.mark.parametrize("items", quick((2, 16, 64, 256), 64))
def test_lists_longer_than_local_memory(device: Device, items: int) -> None:
    boxes, depths, tiles = long_lists(0, 2047, 1, 2048, 2049, 20_000, 4097)
    lists, twin = Lists(shaped(device, 1, items), boxes, depths, tiles), lists_of(boxes[:, :1], depths, tiles[0])
    wanted = [each.astype(np.uint32) for each in (twin.ranges, twin.gaussian_from_sorted, twin.slot_from_sorted)]
    for _ in range(RUNS):
        assert_same_lists(lists.appended(), wanted)


@pytest.mark.parametrize("local", [16, 32, 64])
def test_every_number_of_merges(device: Device, monkeypatch: pytest.MonkeyPatch, local: int) -> None:
    """As many as a list of any length needs, with less local memory."""
    monkeypatch.setattr(stages_append, "LOCAL_PAIRS", local)
    grouped = shaped(device, 1, GROUP_ITEMS)
    lengths = [local * factor + off for factor in (1, 2, 3, 4, 5, 8, 9) for off in (-1, 0, 1)]
    lists = Lists(grouped, *long_lists(*lengths))
    assert_same_lists(lists.appended(), lists.radix())


def test_a_gpu_sorts_few_lists_in_larger_groups(default_device: Device, monkeypatch: pytest.MonkeyPatch) -> None:
    device = shaped(default_device, 1, GROUP_ITEMS)
    boxes, depths, tiles = long_lists(3000, 5, 700)
    wanted, groups = Lists(device, boxes, depths, tiles).appended(), {}

    def launch(given: Device, kernel: Any, number: int, items: int, *arguments: Any) -> None:
        groups[kernel.name] = items
        launch_groups(given, kernel, number, items, *arguments)

    monkeypatch.setattr(device, "kind", "gpu")
    monkeypatch.setattr(stages_append, "launch_groups", launch)
    assert_same_lists(Lists(device, boxes, depths, tiles).appended(), wanted)
    assert groups["sort_lists"] == 256, "3 tiles for the units of a CPU"
    assert groups["append_pairs"] == GROUP_ITEMS


def test_groups_in_any_order(device: Device, monkeypatch: pytest.MonkeyPatch) -> None:
    """Gaussians that are appended by one group after the other, in shuffled order."""
    grouped = shaped(device, 1, GROUP_ITEMS)
    enqueue, rng, shuffled = Device.enqueue, np.random.default_rng(5), []

    def one_by_one(self: Device, kernel, size, local, values, **options):  # type: ignore[no-untyped-def]
        if kernel.name != "append_pairs":
            return enqueue(self, kernel, size, local, values, **options)
        shuffled.append(rng.permutation(size[0] // local[0]))
        for group in shuffled[-1]:
            offset = (int(group) * local[0],)
            event = kernel.cl_kernel(self.queue, local, local, *values, global_offset=offset)
        return event

    for seed in (3, 4, 10, 11):
        boxes, depths, tiles = scene(seed)
        boxes, depths = np.tile(boxes, (5, 1)), np.tile(depths, 5)
        lists = Lists(grouped, boxes, depths, tiles)
        wanted = lists.radix()
        assert_same_lists(lists.appended(), wanted)
        with monkeypatch.context() as patch:
            patch.setattr(Device, "enqueue", one_by_one)
            assert_same_lists(lists.appended(), wanted)
    assert max(len(order) for order in shuffled) > 2


@pytest.mark.parametrize("lengths", [(2**31, 2**31, 5), (2**31, 2**31 - 1), (7, 2)])
def test_a_sum_over_32_bits_is_not_small(device: Device, lengths: tuple[int, ...]) -> None:
    """2^32 + 5 pairs stop a pass with room for 2^31."""
    grouped, tiles = shaped(device, 1, GROUP_ITEMS), len(lengths)
    counts = upload(grouped, np.array([*lengths, 77], np.uint32))
    arrays = [upload(grouped, np.zeros(size, np.uint32)) for size in (1, 2 * tiles, tiles)]
    readback = fresh_readback(grouped)
    kernel = grouped.kernels("append").list_offsets
    launch_groups(grouped, kernel, 2, GROUP_ITEMS, tiles, 1, 2**31, counts, *arrays, readback)
    found, stops = readback.get(), sum(lengths) > 2**31
    expected = {"STOPPED": stops, "PAIRS": 0 if stops else sum(lengths), "VISIBLE": 0 if stops else 77}
    assert {name: found[READBACK.index(name)] for name in expected} == expected


def test_a_driver_that_counts_wrongly_does_not_append(device: Device, monkeypatch: pytest.MonkeyPatch) -> None:
    grouped = device.with_shape(lanes=1, items=GROUP_ITEMS)
    assert appends(grouped)
    assert not appends(shaped(device, 1, 1)), "a list would be sorted by one item"
    places = np.arange(40)
    assert probe_atomics._are_counts(places // 5, places[None] % 5)
    for wrong in (0, 39):
        spoilt = places // 5
        spoilt[wrong] += 1
        assert not probe_atomics._are_counts(spoilt, places[None] % 5)
    broken = device.with_shape(lanes=1, items=GROUP_ITEMS)
    monkeypatch.setattr(probe_atomics, "_are_counts", lambda *_: False)
    assert atomics_fault(broken) == "its integer atomics count wrongly"
    assert not appends(broken)
    monkeypatch.setenv("CLSPLAT_PRETEND", "no-atomics")
    assert atomics_fault(device.with_shape(lanes=1, items=GROUP_ITEMS)) == "it has no 32-bit integer atomics"


def test_the_case_finds_a_wrong_list(default_device: Device) -> None:
    given = APPEND_CASE.random(np.random.default_rng(2), 300)
    assert faults(APPEND_CASE.errors(shaped(default_device, 1, GROUP_ITEMS), given)) == []
    given.depths = given.depths[::-1].copy()
    read = APPEND_CASE.launch(shaped(default_device, 1, GROUP_ITEMS), Workspace(default_device), given)()
    given.depths = given.depths[::-1].copy()
    wanted = APPEND_CASE.twin(given, read)
    assert wanted["gaussians"].error_of(read["gaussians"]) > 0
