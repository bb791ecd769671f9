# SPDX-License-Identifier: Apache-2.0
"""Objects that a frame has mattes of."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray


@dataclass(frozen=True, eq=False)
class Matte:
    """Objects of a frame by their names; owners (n,): the object of each Gaussian, by its index."""

    names: tuple[str, ...]
    owners: NDArray[np.int32]
