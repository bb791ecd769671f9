# SPDX-License-Identifier: Apache-2.0
"""Which of many parameters are tried in the quick run; the others are slow (the marker), and run in CI."""

from __future__ import annotations

from collections.abc import Iterable

import pytest
from _pytest.mark.structures import ParameterSet


def quick(values: Iterable[object], *chosen: object) -> list[ParameterSet]:
    """All of them as parameters, of which only the chosen ones are not slow."""
    every = list(values)
    assert set(chosen) <= set(every), "a chosen one is none of them"
    return [pytest.param(value, marks=() if value in chosen else pytest.mark.slow) for value in every]
