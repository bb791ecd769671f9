# SPDX-License-Identifier: Apache-2.0
"""Objects of a frame's mattes."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray


@dataclass(frozen=True, eq=False)
class Matte:
    """Objects of a matte.

    names: the name of each object.
    owners: (n,), for each Gaussian the index of its object.
    """

    names: tuple[str, ...]
    owners: NDArray[np.int32]
