# SPDX-License-Identifier: Apache-2.0
"""Copies of chunks between records and the slots of a pool: twin of kernels/chunk_records.cl.

A record has all fields of a chunk one after the other. A pool has an array for each field, with a row for each slot.
The step up to which each chunk has been caught up crosses with the records, as a field of one word.
"""

from __future__ import annotations

from collections.abc import Mapping
from typing import Any

import numpy as np
from numpy.typing import NDArray

Words = NDArray[np.uint32]


def to_slots(slots: NDArray[np.integer[Any]], records: Words, before: Mapping[str, Words]) -> dict[str, Words]:
    """Return a pool's fields after the records of k chunks have been copied into k of its slots.

    slots: (k,), the slot of each record.
    records: (k, words), the 32-bit words of all fields, one field after the other.
    before: the pool's fields before the copy by name, each (slots of the pool, words), in the order of a record.
    """
    after, begin = {}, 0
    for name, words in before.items():
        after[name] = words.copy()
        after[name][slots] = records[:, begin : begin + words.shape[1]]
        begin += words.shape[1]
    return after


def to_records(slots: NDArray[np.integer[Any]], fields: Mapping[str, Words]) -> Words:
    """Return the records (k, words) of k slots of a pool.

    slots: (k,), numbers of the slots.
    fields: the pool's fields by name, each (slots of the pool, words), in the order of a record.
    """
    return np.concatenate([words[slots] for words in fields.values()], axis=1)
