# SPDX-License-Identifier: Apache-2.0
"""Types of arrays, a name for each kind of element; and arrays of parsed JSON."""

from __future__ import annotations

from typing import Any

import numpy as np
from numpy.typing import NDArray

Float32 = NDArray[np.float32]
Float64 = NDArray[np.float64]
Int64 = NDArray[np.int64]


def numbers(given: Any) -> Float64:
    """The array of a list of numbers, or of lists of them; (0,) for what is none. True and false are no numbers."""
    rows = given if isinstance(given, list) else []
    if any(isinstance(value, bool) for row in rows for value in (row if isinstance(row, list) else [row])):
        return np.empty(0)
    try:
        return np.array(given, np.float64)
    except (TypeError, ValueError, OverflowError):
        return np.empty(0)
