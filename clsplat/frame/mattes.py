# SPDX-License-Identifier: Apache-2.0
"""Cryptomatte mattes of a frame: which named object each Gaussian belongs to."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray


@dataclass(frozen=True, eq=False)
class Matte:
    """The objects of a matte, and the Gaussians of each object.

    names: names of the objects.
    owners: (n,), the index in `names` of each Gaussian's object.
    """

    names: tuple[str, ...]
    owners: NDArray[np.int32]
