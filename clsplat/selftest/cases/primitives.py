# SPDX-License-Identifier: Apache-2.0
"""Cases of the kernels' own elementary functions (shared/math.h, shared/lanes.h), both sorts, and prefix sums."""

from __future__ import annotations

from collections.abc import Callable

import numpy as np
from numpy.random import Generator

from clsplat.device.buffers import Workspace, allocate, upload
from clsplat.device.context import Device
from clsplat.device.launch import launch_grid
from clsplat.selftest.case import Arrays, Case, Inputs, Read, Wanted, exactly, read_of
from clsplat.selftest.harness import Array, CaseBench
from clsplat.selftest.scenes import keys
from clsplat.stages.scan import MAX_SINGLE_CHUNK_ELEMENTS, scan
from clsplat.stages.sort import MIN_WIDE_DIGIT_KEYS, bitonic_sort, radix_sort

PROBED: dict[str, tuple[float, float, Callable[[Array], Array]]] = {
    "exp": (-87.0, 87.0, np.exp),
    "log2": (1e-3, 1.0, np.log2),
    "sigmoid": (-80.0, 80.0, lambda x: 1 / (1 + np.exp(-x))),
    "exp2": (-8.5, 0.0, np.exp2),
}
"""Functions in the order of the probe's rows, each with the range of its arguments."""


def _random_arguments(rng: Generator, count: int) -> Inputs:
    return Inputs(x={name: rng.uniform(low, high, count).astype(np.float32) for name, (low, high, _) in PROBED.items()})


def _launch_probe(device: Device, _: Workspace, given: Inputs) -> Read:
    kernel, outs = device.kernels("probe").probe_elementary, {}
    for name, x in given.x.items():
        outs[name] = allocate(device, (len(PROBED), len(x)), np.float32)
        launch_grid(device, kernel, (len(x),), upload(device, x), outs[name], len(x))
    return lambda: {name: out.get()[row] for row, (name, out) in enumerate(outs.items())}


def _twin_of_probe(given: Inputs, _: Arrays) -> dict[str, Wanted]:
    exact = {name: function(given.x[name].astype(np.float64)) for name, (_, _, function) in PROBED.items()}
    return {
        "exp": Wanted(exact["exp"], 2.4e-7, exact["exp"]),  # 2 ulp: the polynomial and the range reduction
        "log2": Wanted(exact["log2"], 2.4e-7, np.maximum(np.abs(exact["log2"]), 1)),  # its values pass through 0
        "sigmoid": Wanted(exact["sigmoid"], 3.6e-7, exact["sigmoid"]),  # 3 ulp
        "exp2": Wanted(exact["exp2"], 2.1e-7, exact["exp2"]),  # 0.8e-7 from the polynomial, the rest from rounding
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
    """Keys of few bits or of many, and a base that is not larger than any of them."""
    bits = int(rng.choice([1, 4, 5, 11, 12, 13, 22, 23, 24, 26, 27, 31, 32, 32]))
    base = int(rng.choice([0, 0, 2**32 - 2**bits, rng.integers(2**32 - 2**bits + 1)]))
    values = (base + rng.integers(0, 2**bits, count)).astype(np.uint32)
    return Inputs(keys=values, bits=bits, base=base)


def _frozen_keys(bench: CaseBench) -> list[Inputs]:
    """Keys for both sorts, because a scene of another size may use the other sort."""
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
    return read_of(keys=found[0], places=found[1])


def _twin_of_sort(given: Inputs, _: Arrays) -> dict[str, Wanted]:
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
    return read_of(sums=out, total=total)


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
