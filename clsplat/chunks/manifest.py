# SPDX-License-Identifier: Apache-2.0
"""The manifest of a checkpoint whose Gaussians are in a scratch file: slot, checksums and constants of each chunk."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass
from math import prod
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import NDArray

from clsplat.layouts.columns import CHUNK_ROWS

MANIFEST_KEY = "chunks"
MANIFEST_ARRAYS = ("chunks/slots", "chunks/checksums", "chunks/constants")
"""Names of its arrays in a checkpoint."""
WRITTEN, ZERO, INFINITE = np.arange(3, dtype=np.uint8)
CONSTANTS = {int(ZERO): 0.0, int(INFINITE): np.inf}
"""Values that a field of a chunk may be known to have everywhere. A field that is WRITTEN has those in its slot."""
_MOST_FIELDS, _MOST_FLOATS = 64, 64
"""Limits of what a damaged file can ask for: fields of a record, and elements of a row of one."""


def chunks_of(rows: int) -> int:
    """Number of chunks of a model of `rows` Gaussians."""
    return -(-rows // CHUNK_ROWS)


@dataclass(frozen=True, eq=False)
class Manifest:
    """List of a checkpoint's chunks.

    path: the scratch file.
    count: number of Gaussians.
    fields: shape of a row of each field, float32, by name.
    slots: (chunks,) int64, the slot of each chunk.
    checksums: (chunks, fields with elements) uint32, the crc32 of each field of each chunk.
    constants: of the same shape, uint8: WRITTEN, or the constant that all elements of the field are.
    """

    path: Path
    count: int
    fields: Mapping[str, tuple[int, ...]]
    slots: NDArray[np.int64]
    checksums: NDArray[np.uint32]
    constants: NDArray[np.uint8]

    def arrays(self) -> dict[str, NDArray[Any]]:
        """Its arrays in a checkpoint."""
        return dict(zip(MANIFEST_ARRAYS, (self.slots, self.checksums, self.constants), strict=True))

    def state(self) -> dict[str, Any]:
        """Its part of a checkpoint's state."""
        fields = {name: list(shape) for name, shape in self.fields.items()}
        return {MANIFEST_KEY: {"file": str(self.path), "count": self.count, "rows": CHUNK_ROWS, "fields": fields}}


def manifest_of(arrays: Mapping[str, NDArray[Any]], state: Mapping[str, Any]) -> Manifest | None:
    """The manifest of a checkpoint; None if its Gaussians are arrays. Raises ValueError for a wrong one."""
    if (record := state.get(MANIFEST_KEY)) is None:
        return None
    slots, checksums, constants = (arrays.get(key) for key in MANIFEST_ARRAYS)
    if not isinstance(record, dict) or slots is None or checksums is None or constants is None:
        raise ValueError("its list of chunks is incomplete")
    file, count, fields = record.get("file"), record.get("count"), record.get("fields")
    if not isinstance(file, str) or type(count) is not int or count < 1 or record.get("rows") != CHUNK_ROWS:
        raise ValueError(f"its chunks are not as this version writes them ({CHUNK_ROWS} rows each)")
    if not isinstance(fields, dict) or len(fields) > _MOST_FIELDS or not all(map(_is_shape, fields.values())):
        raise ValueError("the fields of its chunks are not as this version writes them")
    shapes = {name: tuple(shape) for name, shape in fields.items()}
    filled = sum(0 not in shape for shape in shapes.values())
    chunks = chunks_of(count)
    by_field = (chunks, filled)
    wanted = ((slots, (chunks,), np.int64), (checksums, by_field, np.uint32), (constants, by_field, np.uint8))
    for array, shape, kind in wanted:
        if array.shape != shape or array.dtype != kind:
            raise ValueError(f"its list of chunks has shape {array.shape} of {array.dtype}, expected {shape}")
    written = slots[slots >= 0]
    if slots.min() < -1 or len(np.unique(written)) < len(written):
        raise ValueError("two of its chunks have one slot")
    if constants.max(initial=WRITTEN) > INFINITE or (constants[slots < 0] == WRITTEN).any():
        raise ValueError("its list of chunks has constants that are not as this version writes them")
    return Manifest(Path(file), count, shapes, slots, checksums, constants)


def _is_shape(value: object) -> bool:
    """True for a shape of at most `_MOST_FLOATS` elements, as JSON."""
    if not isinstance(value, list) or not all(type(size) is int and 0 <= size <= _MOST_FLOATS for size in value):
        return False
    return prod(value) <= _MOST_FLOATS
