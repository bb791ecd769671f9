#!/usr/bin/env python3
# SPDX-License-Identifier: Apache-2.0
"""Measure how the time of the sort grows with the number of keys, beside NumPy's stable argsort of the same keys.

    python tools/bench/bench_sort.py [--max 3e7] [--repeat 5] [--device DEVICE] [--json] [--plot sort.svg]

keys: one sort of n random uint32 keys of 31 bits. pairs: the pipeline's sorts of n (tile, Gaussian) pairs by tile and
depth. n / 4 Gaussians are sorted by depth (31 bits); the pairs that they emit in this order are sorted by tile (11
bits). The time excludes emitting the pairs. NumPy sorts keys of 64 bits, tile << 32 | depth, in one sort. Sizes are
1e4, 3e4, 1e5 and so on. Times are wall times from an idle device to an idle device.

Every result is compared with NumPy's order; the exit status is 1 if one differs. The deviation from linear growth is
the ratio of the largest to the smallest time per key, for 1e5 keys and more.
"""

from __future__ import annotations

import statistics
import sys
import time
from collections.abc import Callable, Sequence
from functools import partial
from pathlib import Path
from typing import Any

import numpy as np
from measuring import Result, machine, number, options_parser, parsed, require, show, sizes, tool
from numpy.typing import NDArray
from plotting import Panel, plot_growth

from clsplat.device.buffers import Workspace, upload
from clsplat.device.context import Device
from clsplat.device.selection import open_device
from clsplat.errors import ClsplatError
from clsplat.progress import aligned
from clsplat.stages.sort import sort

SMALLEST, LINEAR_FROM = 10_000, 100_000
TARGET = 4_000_000
"""An additional size: the number of pairs in a large frame."""
DEPTH_BITS = 31
"""Bits of a positive float32."""
TILES_X, TILES_Y = 50, 30
"""Tiles of an image of 800 x 480 pixels."""
SIDE = 2
"""Pairs per Gaussian, which reaches 2 x 2 tiles."""

UInt32 = NDArray[np.uint32]
Order = NDArray[np.integer[Any]]
Case = tuple[Callable[[], object], Callable[[], Order], Callable[[], Order]]
"""A sort to time, a function that returns its result as an order of the keys, and NumPy's order."""


def random_keys(n: int) -> UInt32:
    """n keys of 31 bits, the same in every call."""
    return np.random.default_rng(n).integers(0, 1 << DEPTH_BITS, n, dtype=np.uint32)


def random_pairs(n: int) -> tuple[UInt32, UInt32]:
    """Depths (n / 4,) of Gaussians as bits, and each one's block of 2 x 2 tiles (n / 4, 4); the same in every call."""
    rng = np.random.default_rng(n)
    count = n // SIDE**2
    depths = rng.uniform(2.0, 10.0, count).astype(np.float32).view(np.uint32)
    first = rng.integers(0, TILES_Y - 1, count) * TILES_X + rng.integers(0, TILES_X - 1, count)
    block = [row * TILES_X + column for row in range(SIDE) for column in range(SIDE)]
    return depths, (first[:, None] + block).astype(np.uint32)


def keys_case(device: Device, n: int) -> Case:
    """The `Case` of one sort of n keys."""
    keys, work = random_keys(n), Workspace(device)
    once = partial(sort, device, work, "keys", upload(device, keys), DEPTH_BITS)
    return once, once()[1].get, partial(np.argsort, keys, kind="stable")


def pairs_case(device: Device, n: int) -> Case:
    """The `Case` of the pipeline's two sorts of n pairs. NumPy orders the tiles by depth beforehand, untimed."""
    depths, tiles = random_pairs(n)
    by_depth = np.argsort(depths, kind="stable")
    work = Workspace(device)
    depth_keys, tile_keys = upload(device, depths), upload(device, np.ascontiguousarray(tiles[by_depth].ravel()))
    tile_bits = (TILES_X * TILES_Y - 1).bit_length()
    keys = tiles.ravel().astype(np.uint64) << np.uint64(32) | np.repeat(depths, SIDE**2).astype(np.uint64)

    def both() -> tuple[Any, Any]:
        _, gaussian_from_rank = sort(device, work, "depth", depth_keys, DEPTH_BITS)
        _, pair_from_sorted = sort(device, work, "tile", tile_keys, tile_bits)
        return gaussian_from_rank, pair_from_sorted

    def ours() -> Order:
        gaussian_from_rank, pair_from_sorted = (array.get().astype(np.int64) for array in both())
        rank, slot = np.divmod(pair_from_sorted, SIDE**2)
        order: Order = gaussian_from_rank[rank] * SIDE**2 + slot
        return order

    return both, ours, partial(np.argsort, keys, kind="stable")


CASES: dict[str, Callable[[Device, int], Case]] = {"keys": keys_case, "pairs": pairs_case}


def measure(device: Device, name: str, n: int, repeat: int) -> Result:
    """A row of the table. Raises ClsplatError if the order is not NumPy's."""
    work, ours, by_numpy = CASES[name](device, n)
    if not np.array_equal(ours(), by_numpy()):  # this also builds the kernels and allocates the arrays
        raise ClsplatError(f"{name}: the order of {n} differs from NumPy's, expected the same")
    times, numpy_times = [], []
    for _ in range(repeat):  # alternating, so that other load affects both
        times.append(device.timed(work)[1])
        start = time.perf_counter()
        by_numpy()
        numpy_times.append(1e3 * (time.perf_counter() - start))
    ms, numpy_ms = statistics.median(times), statistics.median(numpy_times)
    return {"sort": name, "n": n, "ms": ms, "ns_per_key": 1e6 * ms / n, "numpy_ms": numpy_ms, "ratio": numpy_ms / ms}


def deviation(rows: list[Result]) -> float | None:
    """Ratio of largest to smallest time per key, from LINEAR_FROM keys on; None with fewer than two such sizes."""
    times = [row["ns_per_key"] for row in rows if row["n"] >= LINEAR_FROM]
    return max(times) / min(times) if len(times) > 1 else None


def table(result: Result) -> list[str]:
    """Text table of the rows, and their deviation from linear growth."""
    rows: list[tuple[str, ...]] = [("sort", "n", "ms", "ns a key", "NumPy ms", "NumPy / ours")]
    for row in result["rows"]:
        times = (f"{row['ms']:.3f}", f"{row['ns_per_key']:.2f}", f"{row['numpy_ms']:.3f}", f"{row['ratio']:.2f}")
        rows.append((row["sort"], f"{row['n']:,}", *times))
    found = ", ".join(f"{name} {value:.2f}" for name, value in result["deviation"].items() if value is not None)
    note = f"largest over smallest time a key, from {LINEAR_FROM:,} up: {found}" if found else ""
    return [*aligned(rows), *(["", note] if note else [])]


def plot(path: Path, result: Result) -> None:
    """Plot of milliseconds, and of nanoseconds per key, over the number of keys."""
    times, per_key = {}, {}
    for name in CASES:
        rows = [row for row in result["rows"] if row["sort"] == name]
        for label, key in ((name, "ms"), (f"{name}, NumPy", "numpy_ms")):
            times[label] = [(row["n"], row[key]) for row in rows]
            per_key[label] = [(row["n"], 1e6 * row[key] / row["n"]) for row in rows]
    panels = [Panel("keys or pairs", "ms, median", times), Panel("keys or pairs", "ns a key", per_key)]
    plot_growth(path, panels, f"Sort on {result['device']}, {result['driver'].split('  ')[0]}")


@tool("bench_sort")
def main(arguments: Sequence[str]) -> int:
    """Run the measurement and print its results."""
    parser = options_parser(__doc__)
    parser.add_argument("--max", metavar="N", type=number, default=30_000_000)
    options = parsed(parser, arguments)
    require(options.max >= SMALLEST, f"--max {options.max}: expected at least {SMALLEST}")
    device = open_device(options.device)
    rows = []
    for n in sorted({*sizes(SMALLEST, options.max), *([TARGET] if options.max >= TARGET else [])}):
        print(f"{n:,} keys", file=sys.stderr, flush=True)
        rows += [measure(device, name, n, options.repeat) for name in CASES]
    found = {name: deviation([row for row in rows if row["sort"] == name]) for name in CASES}
    result = {**machine(device, options.repeat), "rows": rows, "deviation": found}
    show(result, table(result), as_json=options.json)
    if options.plot is not None:
        plot(options.plot, result)
    return 0


if __name__ == "__main__":
    sys.exit(main(sys.argv[1:]))
