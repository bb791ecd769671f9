# SPDX-License-Identifier: Apache-2.0
"""Twin of kernels/chunk_records.cl: copies between records of chunks and the slots of a pool, word by word."""

from __future__ import annotations

from collections.abc import Mapping
from typing import Any

import numpy as np
from numpy.typing import NDArray

Words = NDArray[np.uint32]


def to_slots(slots: NDArray[np.integer[Any]], records: Words, before: Mapping[str, Words]) -> dict[str, Words]:
    """The fields of all slots after each record (k, words) has been copied to its slot.

    before: by field, (slots, words), in the order of a record.
    """
    after, begin = {}, 0
    for name, words in before.items():
        after[name] = words.copy()
        after[name][slots] = records[:, begin : begin + words.shape[1]]
        begin += words.shape[1]
    return after


def to_records(slots: NDArray[np.integer[Any]], fields: Mapping[str, Words]) -> Words:
    """Records (k, words) of these slots. fields: (slots, words), in the order of a record."""
    return np.concatenate([words[slots] for words in fields.values()], axis=1)
