# SPDX-License-Identifier: Apache-2.0
"""Every stage that stands by itself against its float64 twin: every driver and shape, at the seams of sizes."""

from __future__ import annotations

import numpy as np
import pytest
from _pytest.mark.structures import ParameterSet
from compare import assert_same_arrays
from pipeline import shaped

from clsplat.device.buffers import Workspace
from clsplat.device.context import Device
from clsplat.selftest.case import Expected, faults
from clsplat.selftest.cases.table import CASES
from clsplat.stages.blend import tile_items

DRAWS = 2
"""Inputs of each size."""


def cases(*, by_shape: bool) -> list[ParameterSet]:
    """Names and sizes; beyond the first four sizes of a case only one in three is not slow."""
    return [
        pytest.param(name, size, id=f"{name}-{size}", marks=pytest.mark.slow if index > 3 and index % 3 else ())
        for name, case in CASES.items()
        for index, size in enumerate(case.sizes)
        if case.by_shape == by_shape
    ]


def check(device: Device, name: str, size: object) -> None:
    case, work = CASES[name], Workspace(device)
    for draw in range(DRAWS):
        rng = np.random.default_rng([draw, *np.atleast_1d(np.array(size)), *name.encode()])
        assert faults(case.errors(device, case.random(rng, size), work)) == []


@pytest.mark.parametrize(("name", "size"), cases(by_shape=True))
def test_in_every_shape(shaped_device: Device, name: str, size: object) -> None:
    check(shaped_device, name, size)


@pytest.mark.parametrize(("name", "size"), cases(by_shape=False))
def test_kernels_that_know_of_no_shape(device: Device, name: str, size: object) -> None:
    check(device, name, size)


@pytest.mark.parametrize("name", [name for name, case in CASES.items() if case.by_shape])
def test_every_shape_has_the_same_bits(shaped_device: Device, default_device: Device, name: str) -> None:
    """And every driver, of the results that have a digest in the self-test."""
    case, other = CASES[name], default_device
    if case.own_bits_of_groups:
        other = shaped(default_device, 1, 64) if tile_items(shaped_device) > 1 else default_device
    given, found = case.random(np.random.default_rng(0), max(case.sizes[:4], key=np.prod)), []
    for device in (shaped_device, other):
        got = case.launch(device, Workspace(device), given)()
        found.append({result: got[result] for result in case.digested or got})
    assert_same_arrays(*found)


def test_one_workspace_for_every_size(default_device: Device) -> None:
    """What is left in the memory of larger inputs is not read."""
    for name, case in CASES.items():
        work, largest = Workspace(default_device), sorted(case.sizes, key=np.prod)[::-1]
        for size in (*largest[:2], *largest[-2:]):
            given = case.random(np.random.default_rng(0), size)
            assert faults(case.errors(default_device, given, work)) == [], f"{name} {size}"


def test_errors() -> None:
    """Relative to a size or in norm; a missing value, or one of another shape, is no small error."""
    values = np.array([1.0, 2.0, 0.0])
    off = values + np.array([0.0, 1e-3, 1e-3])
    assert Expected(values, 0, 1.0).error_of(off) == pytest.approx(1e-3)
    assert Expected(values, 0, 1.0, compared=values == 1).error_of(off) == 0
    assert Expected(values, 0, np.abs(values) + 1e-3).error_of(off) == pytest.approx(1.0)
    assert Expected(values, 0).error_of(off) == pytest.approx(1e-3 * (2 / 5) ** 0.5)
    assert Expected(np.zeros(3), 0).error_of(off) == np.inf
    assert Expected(values, 0, 1.0).error_of(np.array([1.0, np.nan, 0.0])) == np.inf
    assert Expected(values, 0, 1.0).error_of(off[:2]) == np.inf
    assert Expected(values, 0, exact=True).error_of(off) == 2
