# SPDX-License-Identifier: Apache-2.0
"""Both sorts, and prefix sums."""

from __future__ import annotations

import numpy as np
from numpy.random import Generator

from clsplat.device.buffers import Workspace, upload
from clsplat.device.context import Device
from clsplat.selftest.case import Arrays, Case, Given, Read, Wanted, exactly, read_of
from clsplat.selftest.harness import CaseBench
from clsplat.selftest.scenes import keys
from clsplat.stages.scan import MAX_SINGLE_CHUNK_ELEMENTS, scan
from clsplat.stages.sort import MIN_WIDE_DIGIT_KEYS, bitonic_sort, radix_sort

SCAN_SIZES = (
    *(1, 63, 65, 1025, 0, 2, 64, 1023, 1024, 4096, 4097, 100_003),
    *(MAX_SINGLE_CHUNK_ELEMENTS - 1, MAX_SINGLE_CHUNK_ELEMENTS, MAX_SINGLE_CHUNK_ELEMENTS + 1),
)


def _random(rng: Generator, count: int) -> Given:
    """Keys of few bits, or of many, which begin at a base."""
    bits = int(rng.choice([1, 4, 5, 11, 12, 13, 22, 23, 24, 26, 27, 31, 32, 32]))
    base = int(rng.choice([0, 0, 2**32 - 2**bits, rng.integers(2**32 - 2**bits + 1)]))
    values = (base + rng.integers(0, 2**bits, count)).astype(np.uint32)
    return Given(keys=values, bits=bits, base=base)


def _frozen(bench: CaseBench) -> list[Given]:
    """Keys for both sorts, as another scene may use the sort that this one does not."""
    sizes = ((400, 12), (3000, 20), (30_000 if bench.frozen.name == "crowd" else 5000, 32))
    found = [Given(keys=keys(51 + index, n, bits), bits=bits, base=0) for index, (n, bits) in enumerate(sizes)]
    found[0].base = None
    return found


def _launch(device: Device, work: Workspace, given: Given) -> Read:
    values = upload(device, given.keys)
    if given.base is None:
        found = bitonic_sort(device, work, "sorted", values)
    else:
        found = radix_sort(device, work, "sorted", values, given.bits, given.base)
    return read_of(keys=found[0], places=found[1])


def _twin(given: Given, _: Arrays) -> dict[str, Wanted]:
    order = np.argsort(given.keys, kind="stable")
    return {"keys": exactly(given.keys[order]), "places": exactly(order)}


SORT_CASE = Case(
    sizes=(*SCAN_SIZES, *(127, 128, 129, 2048, 8 * 1024 + 1, MIN_WIDE_DIGIT_KEYS - 1, MIN_WIDE_DIGIT_KEYS)),
    random=_random,
    launch=_launch,
    twin=_twin,
    frozen=_frozen,
    digested=("keys", "places"),
)
BITONIC_CASE = Case(
    sizes=(1, 63, 65, 129, 0, 2, 64, 127, 128, 1023, 1024, 1025, 2048),
    random=lambda rng, count: Given(keys=rng.integers(0, 2**32, count, dtype=np.uint32), base=None),
    launch=_launch,
    twin=_twin,
)


def _launch_scan(device: Device, work: Workspace, given: Given) -> Read:
    values, total = upload(device, given.values), upload(device, np.full(1, 7, np.uint32))
    out = values if given.in_place else upload(device, np.full(len(given.values), 0xFFFFFFFF, np.uint32))
    scan(device, work, values, out, total)
    return read_of(sums=out, total=total)


SCAN_CASE = Case(
    sizes=SCAN_SIZES,
    random=lambda rng, count: Given(
        values=rng.integers(0, 4, count).astype(np.uint32), in_place=bool(rng.random() < 0.5)
    ),
    launch=_launch_scan,
    twin=lambda given, _: {
        "sums": exactly(np.cumsum(given.values) - given.values),
        "total": exactly(given.values.sum(keepdims=True)),
    },
)
