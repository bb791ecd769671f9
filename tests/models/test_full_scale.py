# SPDX-License-Identifier: Apache-2.0
"""White of stored colours, by their values: `clsplat.models.codec.values.full_scale`."""

from __future__ import annotations

from typing import Any

import numpy as np
import pytest

from clsplat.models.codec.values import full_scale


@pytest.mark.parametrize(
    ("levels", "kind", "white"),
    [
        ([0, 1, 1], "u1", 255),  # almost black
        ([0, 255], "u1", 255),
        ([-5, 127], "i1", 255),
        ([0, 255], "<u2", 255),  # bytes in a wider type
        ([0, 256], "<u2", 65535),
        ([0, 65535], ">u2", 65535),
        ([0, 128], "<i4", 255),
        ([12000, 40000], "<i4", 65535),
        ([0, 0.5, 1], "<f4", 1),
        ([0, 1.0005], "<f4", 1),  # rounding
        ([0.2, 1.7], "<f4", 1),  # brighter than white
        ([0, 1, 2], "<f4", 255),  # whole numbers: almost black bytes
        ([0.5, 128.25], "<f8", 255),  # averages of bytes
        ([0, 255], "<f8", 255),
        ([255.1], "<f4", 255),
        ([300.5, 65535], "<f4", 65535),
        ([np.nan, np.inf, 0.5], "<f4", 1),
        ([], "<f4", 1),
        ([], "<u2", 255),
    ],
)
def test_white_follows_the_values(levels: list[float], kind: str, white: float) -> None:
    values: Any = np.array(levels, kind)
    assert full_scale(values) == white
    assert full_scale(np.stack([values, values])) == white
