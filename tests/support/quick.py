# SPDX-License-Identifier: Apache-2.0
"""Choice of the parameters that quick runs test. The others get the marker `slow`, and run in CI.

Where a test runs on each driver or in each shape, the others run on the default driver alone, in COMMON_SHAPES
(`pipeline.has_slow_parameters`).
"""

from __future__ import annotations

from collections.abc import Iterable

import pytest
from _pytest.mark.structures import ParameterSet


def quick(values: Iterable[object], *chosen: object) -> list[ParameterSet]:
    """Parameters for all values; all except the chosen ones are marked slow."""
    every = list(values)
    assert set(chosen) <= set(every), "a chosen one is none of them"
    return [pytest.param(value, marks=() if value in chosen else pytest.mark.slow) for value in every]
