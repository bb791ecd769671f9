# SPDX-License-Identifier: Apache-2.0
"""Manifest of a checkpoint whose Gaussians stay in a scratch file: slot, checksums and length of each chunk."""

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
"""Key of the manifest in a checkpoint's state."""
MANIFEST_ARRAYS = ("chunks/lengths", "chunks/slots", "chunks/checksums", "chunks/constants")
"""Names of the manifest's arrays in a checkpoint."""
WRITTEN, ZERO, INFINITE = np.arange(3, dtype=np.uint8)
CONSTANTS = {int(ZERO): 0.0, int(INFINITE): np.inf}
"""Value of all elements of a chunk's field, by the field's code. A field with the code WRITTEN is in the slot."""
_MOST_FIELDS, _MOST_FLOATS = 64, 64
"""Limits for damaged files: number of fields of a record, and number of elements of a row of a field."""


@dataclass(frozen=True, eq=False)
class Manifest:
    """List of a checkpoint's chunks in a scratch file.

    path: the scratch file.
    slot_bytes: bytes of a slot; the record is at its beginning, and may be shorter.
    fields: shape of a row of each field, float32, by name.
    lengths: (chunks,) int64, the number of rows of each chunk.
    slots: (chunks,) int64, the slot of each chunk; NO_SLOT if nothing is written.
    checksums: (chunks, fields with elements) uint32, the crc32 of each field of each chunk.
    constants: uint8 in the shape of `checksums`: WRITTEN if the field is in the slot, or a key of CONSTANTS if all its
        elements have that value.
    """

    path: Path
    slot_bytes: int
    fields: Mapping[str, tuple[int, ...]]
    lengths: NDArray[np.int64]
    slots: NDArray[np.int64]
    checksums: NDArray[np.uint32]
    constants: NDArray[np.uint8]

    def arrays(self) -> dict[str, NDArray[Any]]:
        """Return the manifest's arrays by their names in a checkpoint."""
        return dict(zip(MANIFEST_ARRAYS, (self.lengths, self.slots, self.checksums, self.constants), strict=True))

    def state(self) -> dict[str, Any]:
        """Return the manifest's entries of a checkpoint's state."""
        fields = {name: list(shape) for name, shape in self.fields.items()}
        sizes = {"rows": CHUNK_ROWS, "slot_bytes": self.slot_bytes}
        return {MANIFEST_KEY: {"file": str(self.path), **sizes, "fields": fields}}


def manifest_of(arrays: Mapping[str, NDArray[Any]], state: Mapping[str, Any]) -> Manifest | None:
    """Read a checkpoint's manifest; None if it has the Gaussians as arrays. Raises ValueError for damaged data."""
    if (record := state.get(MANIFEST_KEY)) is None:
        return None
    if not isinstance(record, dict) or not set(MANIFEST_ARRAYS) <= arrays.keys():
        raise ValueError("its list of chunks is incomplete")
    lengths, slots, checksums, constants = (arrays[key] for key in MANIFEST_ARRAYS)
    file, slot_bytes, fields = record.get("file"), record.get("slot_bytes"), record.get("fields")
    if not isinstance(file, str) or type(slot_bytes) is not int or record.get("rows") != CHUNK_ROWS:
        raise ValueError(f"its chunks are not as this version writes them ({CHUNK_ROWS} rows each)")
    if not isinstance(fields, dict) or len(fields) > _MOST_FIELDS or not all(map(_is_shape, fields.values())):
        raise ValueError("the fields of its chunks are not as this version writes them")
    shapes = {name: tuple(shape) for name, shape in fields.items()}
    filled = sum(0 not in shape for shape in shapes.values())
    if not _record_bytes(shapes) <= slot_bytes <= _MOST_FIELDS * _MOST_FLOATS * 4 * CHUNK_ROWS:
        raise ValueError(f"its chunks are not as this version writes them (in slots of {slot_bytes} bytes)")
    by_chunk, by_field = lengths.shape[:1], (*lengths.shape[:1], filled)
    wanted = (
        (lengths, by_chunk, np.int64),
        (slots, by_chunk, np.int64),
        (checksums, by_field, np.uint32),
        (constants, by_field, np.uint8),
    )
    for array, shape, kind in wanted:
        if array.shape != shape or array.dtype != kind:
            raise ValueError(f"its list of chunks has shape {array.shape} of {array.dtype}, expected {shape}")
    if not 1 <= lengths.min(initial=CHUNK_ROWS + 1) <= lengths.max(initial=1) <= CHUNK_ROWS:
        raise ValueError(f"its chunks have lengths that are not from 1 to {CHUNK_ROWS}")
    written = slots[slots >= 0]
    if slots.min() < -1 or len(np.unique(written)) < len(written):
        raise ValueError("two of its chunks are in the same slot, or a slot number is below -1")
    if constants.max(initial=WRITTEN) > INFINITE or (constants[slots < 0] == WRITTEN).any():
        raise ValueError("its list of chunks has constants that are not as this version writes them")
    return Manifest(Path(file), slot_bytes, shapes, lengths, slots, checksums, constants)


def _record_bytes(fields: Mapping[str, tuple[int, ...]]) -> int:
    return 4 * CHUNK_ROWS * sum(map(prod, fields.values()))


def _is_shape(value: object) -> bool:
    """True for a JSON list that is a shape of at most `_MOST_FLOATS` elements."""
    if not isinstance(value, list) or not all(type(size) is int and 0 <= size <= _MOST_FLOATS for size in value):
        return False
    return prod(value) <= _MOST_FLOATS
