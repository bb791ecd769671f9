# SPDX-License-Identifier: Apache-2.0
"""Types of arrays: a name for each kind of element."""

from __future__ import annotations

import numpy as np
from numpy.typing import NDArray

Float32 = NDArray[np.float32]
Float64 = NDArray[np.float64]
Int64 = NDArray[np.int64]
