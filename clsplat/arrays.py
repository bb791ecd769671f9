# SPDX-License-Identifier: Apache-2.0
"""Types of NumPy arrays by element type, and conversion of parsed JSON to arrays."""

from __future__ import annotations

from typing import Any

import numpy as np
from numpy.typing import NDArray

Float32 = NDArray[np.float32]
Float64 = NDArray[np.float64]
Int64 = NDArray[np.int64]
Bool = NDArray[np.bool_]


def numbers(given: Any) -> Float64:
    """Convert a list of numbers, or nested lists, to an array. Other values, and booleans, give an empty array (0,)."""
    rows = given if isinstance(given, list) else []
    if any(isinstance(value, bool) for row in rows for value in (row if isinstance(row, list) else [row])):
        return np.empty(0)
    try:
        return np.array(given, np.float64)
    except (TypeError, ValueError, OverflowError):
        return np.empty(0)
