# SPDX-License-Identifier: Apache-2.0
"""Elementary functions of the kernels' own (shared/math.h, shared/lanes.h)."""

from __future__ import annotations

from collections.abc import Callable

import numpy as np
from numpy.random import Generator

from clsplat.device.buffers import Workspace, allocate, upload
from clsplat.device.context import Device
from clsplat.device.launch import launch_grid
from clsplat.selftest.case import Arrays, Case, Given, Read, Wanted
from clsplat.selftest.harness import Array

PROBED: dict[str, tuple[float, float, Callable[[Array], Array]]] = {
    "exp": (-87.0, 87.0, np.exp),
    "log2": (1e-3, 1.0, np.log2),
    "sigmoid": (-80.0, 80.0, lambda x: 1 / (1 + np.exp(-x))),
    "exp2": (-8.5, 0.0, np.exp2),
}
"""Functions in the order of the probe's rows, each with the ends of its arguments."""


def _random(rng: Generator, count: int) -> Given:
    return Given(x={name: rng.uniform(low, high, count).astype(np.float32) for name, (low, high, _) in PROBED.items()})


def _launch(device: Device, _: Workspace, given: Given) -> Read:
    kernel, outs = device.kernels("probe").probe_elementary, {}
    for name, x in given.x.items():
        outs[name] = allocate(device, (len(PROBED), len(x)), np.float32)
        launch_grid(device, kernel, (len(x),), upload(device, x), outs[name], len(x))
    return lambda: {name: out.get()[row] for row, (name, out) in enumerate(outs.items())}


def _twin(given: Given, _: Arrays) -> dict[str, Wanted]:
    exact = {name: function(given.x[name].astype(np.float64)) for name, (_, _, function) in PROBED.items()}
    return {
        "exp": Wanted(exact["exp"], 2.4e-7, exact["exp"]),  # 2 ulp: one of the polynomial, one of the reduction
        "log2": Wanted(exact["log2"], 2.4e-7, np.maximum(np.abs(exact["log2"]), 1)),  # it goes through 0
        "sigmoid": Wanted(exact["sigmoid"], 3.6e-7, exact["sigmoid"]),  # 3 ulp
        "exp2": Wanted(exact["exp2"], 2.1e-7, exact["exp2"]),  # 0.8e-7 of the polynomial, the rest of rounding
    }


ELEMENTARY_CASE = Case(
    sizes=(20_000, 1, 7, 1000),
    random=_random,
    launch=_launch,
    twin=_twin,
)
