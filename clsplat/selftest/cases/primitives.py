# SPDX-License-Identifier: Apache-2.0
"""Cases of elementary functions (shared/elementary.h, shared/lanes.h), of radix and bitonic sort, and of prefix sums.
Also of the pairs that the projection counts (shared/list_counts.h), and of the lists that `append` makes of them."""

from __future__ import annotations

from collections.abc import Callable, Mapping
from dataclasses import replace

import numpy as np
from numpy.random import Generator
from numpy.typing import NDArray

from clsplat.camera import Camera
from clsplat.device.buffers import DeviceArray, Workspace, allocate, upload
from clsplat.device.context import Device
from clsplat.device.launch import launch_grid
from clsplat.layouts.columns import READBACK, SPLAT, TILE
from clsplat.optimisation.dropout import Thinning
from clsplat.reference.append import lists_of
from clsplat.selftest.case import Arrays, Case, Expected, Inputs, Read, exactly, faults, fresh_readback, read_of
from clsplat.selftest.cases.steps import random_scene
from clsplat.selftest.harness import Array, CaseBench, StageOutcome
from clsplat.selftest.scenes import keys
from clsplat.stages.append import append
from clsplat.stages.chunk_lists import ChunkList
from clsplat.stages.device_camera import pack_camera, tiles_of
from clsplat.stages.device_gaussians import DeviceGaussians, upload_gaussians
from clsplat.stages.duplicate import Band, count, duplicate
from clsplat.stages.project import ListCounts, Projected, project
from clsplat.stages.ranges import tile_lists
from clsplat.stages.scan import MAX_SINGLE_CHUNK_ELEMENTS, scan
from clsplat.stages.sort import MIN_WIDE_DIGIT_KEYS, bitonic_sort, radix_sort

PROBED: dict[str, tuple[float, float, Callable[[Array], Array]]] = {
    "exp": (-87.0, 87.0, np.exp),
    "log2": (1e-3, 1.0, np.log2),
    "sigmoid": (-80.0, 80.0, lambda x: 1 / (1 + np.exp(-x))),
    "exp2": (-8.5, 0.0, np.exp2),
}
"""Tested functions by name, in the order of the rows that probe_elementary writes. Each has its least and greatest
argument, and the exact function."""


def _random_arguments(rng: Generator, count: int) -> Inputs:
    return Inputs(x={name: rng.uniform(low, high, count).astype(np.float32) for name, (low, high, _) in PROBED.items()})


def _launch_probe(device: Device, _: Workspace, given: Inputs) -> Read:
    kernel, outs = device.kernels("probe").probe_elementary, {}
    for name, x in given.x.items():
        outs[name] = allocate(device, (len(PROBED), len(x)), np.float32)
        launch_grid(device, kernel, (len(x),), upload(device, x), outs[name], len(x))
    return lambda: {name: out.get()[row] for row, (name, out) in enumerate(outs.items())}


def _twin_of_probe(given: Inputs, _: Arrays) -> dict[str, Expected]:
    exact = {name: function(given.x[name].astype(np.float64)) for name, (_, _, function) in PROBED.items()}
    return {
        "exp": Expected(exact["exp"], 2.4e-7, exact["exp"]),  # 2 ulp, from the polynomial and the range reduction
        "log2": Expected(exact["log2"], 2.4e-7, np.maximum(np.abs(exact["log2"]), 1)),  # errors near 0 are absolute
        "sigmoid": Expected(exact["sigmoid"], 3.6e-7, exact["sigmoid"]),  # 3 ulp
        "exp2": Expected(exact["exp2"], 2.1e-7, exact["exp2"]),  # the polynomial's 0.8e-7, and rounding
    }


ELEMENTARY_CASE = Case(
    sizes=(20_000, 1, 7, 1000),
    random=_random_arguments,
    launch=_launch_probe,
    twin=_twin_of_probe,
)


SCAN_SIZES = (
    *(1, 63, 65, 1025, 0, 2, 64, 1023, 1024, 4096, 4097, 100_003),
    *(MAX_SINGLE_CHUNK_ELEMENTS - 1, MAX_SINGLE_CHUNK_ELEMENTS, MAX_SINGLE_CHUNK_ELEMENTS + 1),
)


def _random_keys(rng: Generator, count: int) -> Inputs:
    """Random sort keys. base: a number, at most the smallest key, that is subtracted from all keys before the sort.

    bits: number of low bits in which the differences from `base` are random.
    """
    bits = int(rng.choice([1, 4, 5, 11, 12, 13, 22, 23, 24, 26, 27, 31, 32, 32]))
    base = int(rng.choice([0, 0, 2**32 - 2**bits, rng.integers(2**32 - 2**bits + 1)]))
    values = (base + rng.integers(0, 2**bits, count)).astype(np.uint32)
    return Inputs(keys=values, bits=bits, base=base)


def _frozen_keys(bench: CaseBench) -> list[Inputs]:
    """Synthetic keys for the bitonic sort (`base` is None) and for the radix sort (`base` is 0).

    The scene's own keys would test only one of the two sorts.
    """
    sizes = ((400, 12), (3000, 20), (30_000 if bench.frozen.name == "crowd" else 5000, 32))
    found = [Inputs(keys=keys(51 + index, n, bits), bits=bits, base=0) for index, (n, bits) in enumerate(sizes)]
    found[0].base = None
    return found


def _launch_sort(device: Device, work: Workspace, given: Inputs) -> Read:
    values = upload(device, given.keys)
    if given.base is None:
        found = bitonic_sort(device, work, "sorted", values)
    else:
        found = radix_sort(device, work, "sorted", values, given.bits, given.base)
    return read_of({"keys": found[0], "places": found[1]})


def _twin_of_sort(given: Inputs, _: Arrays) -> dict[str, Expected]:
    order = np.argsort(given.keys, kind="stable")
    return {"keys": exactly(given.keys[order]), "places": exactly(order)}


SORT_CASE = Case(
    sizes=(*SCAN_SIZES, *(127, 128, 129, 2048, 8 * 1024 + 1, MIN_WIDE_DIGIT_KEYS - 1, MIN_WIDE_DIGIT_KEYS)),
    random=_random_keys,
    launch=_launch_sort,
    twin=_twin_of_sort,
    frozen=_frozen_keys,
    digested=("keys", "places"),
)
BITONIC_CASE = Case(
    sizes=(1, 63, 65, 129, 0, 2, 64, 127, 128, 1023, 1024, 1025, 2048),
    random=lambda rng, count: Inputs(keys=rng.integers(0, 2**32, count, dtype=np.uint32), base=None),
    launch=_launch_sort,
    twin=_twin_of_sort,
)


def _launch_scan(device: Device, work: Workspace, given: Inputs) -> Read:
    values, total = upload(device, given.values), upload(device, np.full(1, 7, np.uint32))
    out = values if given.in_place else upload(device, np.full(len(given.values), 0xFFFFFFFF, np.uint32))
    scan(device, work, values, out, total)
    return read_of({"sums": out, "total": total})


SCAN_CASE = Case(
    sizes=SCAN_SIZES,
    random=lambda rng, count: Inputs(
        values=rng.integers(0, 4, count).astype(np.uint32), in_place=bool(rng.random() < 0.5)
    ),
    launch=_launch_scan,
    twin=lambda given, _: {
        "sums": exactly(np.cumsum(given.values) - given.values),
        "total": exactly(given.values.sum(keepdims=True)),
    },
)


def group_counts(tile_counts: NDArray[np.integer], items: int) -> tuple[NDArray[np.uint32], NDArray[np.uint32]]:
    """Return `ListCounts.slots` and `ListCounts.sums` for work-groups of `items` work-items.

    tile_counts: (n,), the number of tiles of each Gaussian.
    """
    groups = np.pad(tile_counts.astype(np.int64), (0, -len(tile_counts) % items)).reshape(-1, items)
    before = (np.cumsum(groups, axis=1) - groups).ravel()[: len(tile_counts)]
    return before.astype(np.uint32), groups.sum(axis=1).astype(np.uint32)


def upload_list_counts(
    device: Device, tile_counts: NDArray[np.integer], tile_indices: NDArray[np.integer], tiles: int
) -> ListCounts:
    """Upload the numbers that the projection would count for Gaussians in these tiles.

    tile_counts: (n,), the number of tiles of each Gaussian.
    tile_indices: (pairs,), the tile of each pair, in any order.
    tiles: number of tiles of the image.
    """
    lengths = [*np.bincount(tile_indices, minlength=tiles), np.count_nonzero(tile_counts)]
    arrays = (np.array(lengths, np.uint32), *group_counts(tile_counts, device.shape.items))
    return ListCounts(*(upload(device, array) for array in arrays))


def read_list_counts(
    device: Device,
    work: Workspace,
    model: DeviceGaussians,
    camera: Camera,
    camera_array: DeviceArray,
    thinning: Thinning | None = None,
    chunks: ChunkList | None = None,
) -> Read:
    """Project the model twice: with counts for lists by append, and without. Make the lists of the latter by the radix
    sorts."""
    inputs = (model, camera, camera_array, thinning, chunks)
    counted, plain_work = project(device, work, *inputs, counts_lists=True), Workspace(device)
    plain, tiles = project(device, plain_work, *inputs), tiles_of(camera)
    assert counted.list_counts is not None
    found, band = counted.list_counts, Band(0, tiles[0] * tiles[1])
    totals = count(device, plain_work, plain)
    lists = tile_lists(device, plain_work, duplicate(device, plain_work, plain.splats, totals, tiles, band), band)
    arrays = {
        "splats": counted.splats,
        "tile_counts": counted.tile_counts,
        "lengths": found.lengths,
        "slots": found.slots,
        "sums": found.sums,
        "plain splats": plain.splats,
        "plain tile_counts": plain.tile_counts,
        "ranges": lists.ranges,
    }
    if counted.shown is not None and plain.shown is not None:
        arrays |= {"shown": counted.shown, "plain shown": plain.shown}

    def read() -> Arrays:
        got = read_of(arrays)()
        for name in ("splats", "plain splats"):  # rows of invisible Gaussians are not written
            got[name] = np.where((got["plain tile_counts"] > 0)[:, None], got[name], 0)
            got[name][:, SPLAT.index("UNUSED") :] = 0
        return {**got, "items": np.array(device.shape.items), "visible": np.array(totals.visible)}

    return read


def expected_list_counts(got: Arrays) -> Mapping[str, Expected]:
    """Expect the splats of the projection that does not count, and the lengths of the lists by the radix sorts.

    got: results of `read_list_counts`. The results of the second projection are removed from it.
    """
    slots, sums = group_counts(got["plain tile_counts"], int(got.pop("items")))
    lengths = [*np.diff(got.pop("ranges"), axis=1).ravel(), int(got.pop("visible"))]
    wanted = {"lengths": np.array(lengths, np.uint32), "slots": slots, "sums": sums}
    wanted |= {name.removeprefix("plain "): got.pop(name) for name in list(got) if name.startswith("plain ")}
    return {name: exactly(values) for name, values in wanted.items()}


def _random_view(rng: Generator, rows: int) -> Inputs:
    """A random view of a picture so large that some boxes of tiles are wide."""
    given = random_scene(rng, rows)
    given.camera = Camera(210, 150, 180.0, 195.0, 90.0, 81.0, given.camera.rotation, given.camera.translation)
    return given


def _launch_list_counts(device: Device, work: Workspace, given: Inputs) -> Read:
    camera_array = upload(device, pack_camera(given.camera))
    return read_list_counts(device, work, upload_gaussians(device, given.gaussians), given.camera, camera_array)


LIST_COUNTS_CASE = Case(
    sizes=(1, 63, 65, 700, 2, 64, 255, 256, 257, 1025),
    random=_random_view,
    launch=_launch_list_counts,
    twin=lambda _, got: expected_list_counts(got),
    digested=("splats", "tile_counts", "lengths"),
)


_WHOLE_BOX = 16
"""Largest number of tiles in a box of which all tiles are listed, whatever the ellipse is (SMALL_BOX of tile.h)."""
_EVERYWHERE = 1e6
"""Half width in pixels of an ellipse that reaches every tile of the rows of tiles in which it lies."""
_COUNTS = ("VISIBLE", "PAIRS", "LONGEST", "STOPPED")


def splats_of_boxes(boxes: NDArray[np.int64], depths: NDArray[np.float32]) -> NDArray[np.float32]:
    """Splats (n, len(SPLAT)) that reach the tiles [x0, x1) of the tile rows [y0, y1).

    boxes: (n, 4), with x0, x1, y0 and y1 of each box. A box of more than 16 tiles must be as wide as the image.
    """
    splats = np.zeros((len(boxes), len(SPLAT)), np.float32)
    low, high = TILE * boxes[:, ::2] + TILE / 2, TILE * (boxes[:, 1::2] - 1) + TILE / 2  # centres of the outer tiles
    is_wide = np.prod(boxes[:, 1::2] - boxes[:, ::2], axis=1) > _WHOLE_BOX
    values = {
        "PIXEL_X": (low + high)[:, 0] / 2,
        "PIXEL_Y": (low + high)[:, 1] / 2,
        "HALF_W": np.where(is_wide, _EVERYWHERE, (high - low)[:, 0] / 2),
        "HALF_H": (high - low)[:, 1] / 2,
        "L11": np.full(len(boxes), 1e-6),
        "L22": np.full(len(boxes), 1e-6),
        "LOG2O": np.full(len(boxes), -1.0),
        "DEPTH": depths,
    }
    for name, column in values.items():
        splats[:, SPLAT.index(name)] = column
    return splats


def tiles_of_boxes(boxes: NDArray[np.int64], tiles_x: int) -> list[NDArray[np.int64]]:
    """Return the numbers of each box's tiles in ascending order. tiles_x: number of tiles in a row of the image."""
    return [
        (np.arange(y0, y1)[:, None] * tiles_x + np.arange(x0, x1)).ravel() for x0, x1, y0, y1 in boxes.astype(np.int64)
    ]


def projected_boxes(
    device: Device,
    boxes: NDArray[np.int64],
    depths: NDArray[np.float32],
    tiles: tuple[int, int],
    tile_counts: DeviceArray,
) -> Projected:
    """Upload what the projection would make of the Gaussians with these boxes of tiles: splats and list counts.

    tiles: numbers of tiles across and down.
    tile_counts: (n,), the number of tiles of each box.
    """
    pairs = np.concatenate([np.zeros(0, np.int64), *tiles_of_boxes(boxes, tiles[0])])
    list_counts = upload_list_counts(device, tile_counts.get(), pairs, tiles[0] * tiles[1])
    return Projected(upload(device, splats_of_boxes(boxes, depths)), tile_counts, list_counts=list_counts)


def boxes_of(rng: Generator, count: int, tiles: tuple[int, int]) -> NDArray[np.int64]:
    """Random boxes (count, 4) of tiles, with x0, x1, y0 and y1 each. tiles: numbers of tiles across and down.

    Boxes are empty, are small, have whole rows of tiles, or in rare cases have all tiles.
    """
    begin = rng.integers(0, tiles, (count, 2))
    end = np.minimum(begin + rng.integers(1, 5, (count, 2)), tiles)
    kind = rng.choice(4, count, p=(0.1, 0.7, 0.17, 0.03))
    rows = np.where((kind == 3)[:, None], (0, tiles[1]), np.stack([begin[:, 1], end[:, 1]], axis=1))
    columns = np.where((kind >= 2)[:, None], (0, tiles[0]), np.stack([begin[:, 0], end[:, 0]], axis=1))
    boxes = np.concatenate([columns, rows], axis=1)
    boxes[kind == 0, 1] = boxes[kind == 0, 0]
    return boxes


def depths_of(rng: Generator, count: int) -> NDArray[np.float32]:
    """Random depths (count,). In half of the calls many of them are equal."""
    depths = rng.uniform(0.1, 100, count) if rng.random() < 0.5 else rng.integers(1, 4, count)
    return depths.astype(np.float32)


def _inputs_of_boxes(
    boxes: NDArray[np.int64], depths: NDArray[np.float32], tiles: tuple[int, int], spare: int
) -> Inputs:
    counts = np.prod(boxes[:, 1::2] - boxes[:, ::2], axis=1)
    capacity = max(int(counts.sum()) + spare, 0)
    return Inputs(boxes=boxes, depths=depths, tiles=tiles, counts=counts.astype(np.uint32), capacity=capacity)


def _random_boxes(rng: Generator, count: int) -> Inputs:
    tiles = (int(rng.integers(1, 14)), int(rng.integers(1, 14)))
    spare = int(rng.choice([-1, 0, 1, 1000], p=(0.1, 0.4, 0.3, 0.2)))
    return _inputs_of_boxes(boxes_of(rng, count, tiles), depths_of(rng, count), tiles, spare)


def _frozen_boxes(bench: CaseBench) -> list[Inputs]:
    """Two inputs for tile lists: one with different depths, one with many equal depths.

    Some boxes are as wide as the image.
    """
    rng, tiles = np.random.default_rng(61), (13, 9)
    count = 4000 if bench.frozen.name == "crowd" else 400
    depths = rng.uniform(0.1, 100, count), rng.integers(1, 4, count)
    return [_inputs_of_boxes(boxes_of(rng, count, tiles), each.astype(np.float32), tiles, 100) for each in depths]


def _launch_append(device: Device, work: Workspace, given: Inputs) -> Read:
    counts, readback, host = upload(device, given.counts), fresh_readback(device), np.zeros(len(READBACK), np.uint32)
    projected = projected_boxes(device, given.boxes, given.depths, given.tiles, counts)
    totals, lists = append(device, work, projected, given.tiles, readback, given.capacity, host)

    def read() -> Arrays:
        assert totals.arriving is not None
        assert lists.order is not None
        arrived = totals.arriving()
        pairs, ranges, order = arrived[READBACK.index("PAIRS")], lists.ranges.get(), lists.order.get()
        return {
            "counts": np.array([arrived[READBACK.index(name)] for name in _COUNTS]),
            "tile_counts": counts.get(),
            "first_slots": totals.first_slots.get(),
            "ranges": ranges,
            "gaussians": lists.gaussian_from_sorted.get()[:pairs],
            "slots": lists.slot_from_sorted.get()[:pairs],
            "tiles": np.sort(order),
            "lengths": _digits(np.diff(ranges, axis=1).ravel()[order]),
        }

    return read


def _digits(lengths: NDArray[np.integer]) -> NDArray[np.int64]:
    """Return the number of binary digits of each tile list's length, by which the lists are ordered."""
    return np.array([int(length).bit_length() for length in lengths], np.int64)


def _twin_of_lists(given: Inputs, got: Arrays) -> Mapping[str, Expected]:
    tiles, stops = given.tiles[0] * given.tiles[1], given.counts.sum() > given.capacity
    twin = lists_of(tiles_of_boxes(given.boxes, given.tiles[0]), given.depths, tiles)
    ranges = 0 * twin.ranges if stops else twin.ranges
    lengths = np.diff(ranges, axis=1).ravel()
    none = np.zeros(0, np.int64)
    counts = [0, 0, 0, 1] if stops else [(given.counts > 0).sum(), given.counts.sum(), lengths.max(initial=0), 0]
    return {
        "counts": exactly(np.array(counts)),
        "tile_counts": exactly(0 * given.counts if stops else given.counts),
        "first_slots": exactly(twin.first_slots) if not stops else exactly(got["first_slots"]),
        "ranges": exactly(ranges),
        "gaussians": exactly(none if stops else twin.gaussian_from_sorted),
        "slots": exactly(none if stops else twin.slot_from_sorted),
        "tiles": exactly(np.arange(tiles)),
        "lengths": exactly(np.sort(_digits(lengths))[::-1]),
    }


APPEND_CASE = Case(
    sizes=(1, 63, 65, 700, 0, 2, 64, 255, 256, 257, 1025),
    random=_random_boxes,
    launch=_launch_append,
    twin=_twin_of_lists,
    frozen=_frozen_boxes,
    digested=("counts", "ranges", "gaussians", "slots"),
)


def of_append(bench: CaseBench) -> StageOutcome:
    """Test the lists by append, and the pairs that the projection of the frozen scene counts for such lists."""
    outcome = APPEND_CASE.outcome(bench)
    given = Inputs(gaussians=bench.frozen.gaussians, camera=bench.camera)
    wrong = faults(LIST_COUNTS_CASE.errors(bench.device, given))
    return replace(outcome, trouble=outcome.trouble or ", ".join(wrong))
