# SPDX-License-Identifier: Apache-2.0
"""Mattes of a frame: masks of named objects."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray


@dataclass(frozen=True, eq=False)
class Matte:
    """The objects of a matte.

    names: names of the objects.
    owners: (n,), the index of each Gaussian's object.
    """

    names: tuple[str, ...]
    owners: NDArray[np.int32]
