# SPDX-License-Identifier: Apache-2.0
"""Edges of the rules by which Gaussians are marked: x > edge decides as the comparison that it is for, to the ulp."""

from __future__ import annotations

from collections.abc import Callable
from math import inf

import numpy as np
import pytest

from clsplat.optimisation.density_rules import edge

RULES: dict[str, Callable[[np.ndarray], np.ndarray]] = {
    "a threshold that float32 has not": lambda x: x >= 2e-4,
    "one that it has": lambda x: x > 0.25,
    "in float64": lambda x: x >= np.log(0.005 / 0.995),
    "zero": lambda x: x > 0,
    "whole": lambda x: x >= 3,
    **{f"a size over {size}": lambda x, size=size: np.exp(x) > size for size in (1e-3, 0.0437, 0.999, 1.0, 1.3, 700.0)},
    **{f"a half over {size}": lambda x, size=size: np.exp(x) / 1.6 > size for size in (2e-3, 0.437, 0.7, 1.0, 5.1)},
}


def beside(value: float, count: int) -> np.ndarray:
    """The float32 numbers next to a number, so many on either side."""
    at = np.float32(value).view(np.int32)
    return (at + np.arange(-count, count + 1, dtype=np.int32)).view(np.float32)


@pytest.mark.parametrize("name", RULES)
def test_an_edge_decides_as_its_rule(name: str) -> None:
    holds = RULES[name]
    found = edge(holds)
    assert found == np.float32(found)
    some = np.random.default_rng(0).normal(0, 8, 100_000).astype(np.float32)
    near = beside(found, 2000) if found else beside(1e-38, 2000)
    values = np.concatenate([some, near, np.array([found, 0, -0.0, -inf, inf, np.nan], np.float32)])
    with np.errstate(over="ignore"):
        np.testing.assert_array_equal(values > np.float32(found), holds(values))


def test_an_edge_of_always_and_never() -> None:
    assert edge(lambda x: x > -inf) == -inf
    assert edge(lambda x: x >= -inf) == -inf
    assert edge(lambda x: x > inf) == inf
    assert edge(lambda x: x >= inf) == np.finfo(np.float32).max
