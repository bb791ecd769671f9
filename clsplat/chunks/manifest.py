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
"""Key under which a checkpoint's state holds the manifest."""
MANIFEST_ARRAYS = ("chunks/lengths", "chunks/slots", "chunks/checksums", "chunks/constants")
"""Names of the manifest's arrays in a checkpoint."""
WRITTEN, ZERO, INFINITE = np.arange(3, dtype=np.uint8)
CONSTANTS = {int(ZERO): 0.0, int(INFINITE): np.inf}
"""Values by code. If all elements of a field of a chunk have one of these values, only its code is stored. The elements
of fields with the code WRITTEN are in the slot."""
_MOST_FIELDS, _MOST_FLOATS = 64, 64
"""Maximum number of fields of a record, and of elements in a row of a field. A manifest with more is damaged."""


@dataclass(frozen=True, eq=False)
class Manifest:
    """List of a checkpoint's chunks in a scratch file.

    path: the scratch file.
    slot_bytes: bytes of a slot; the record is at its beginning, and may be shorter.
    fields: shape of a row of each field of a record, by the field's name. Fields are float32.
    lengths: (chunks,) int64, the number of rows of each chunk.
    slots: (chunks,) int64, the slot of each chunk; NO_SLOT if nothing is written.
    checksums: (chunks, fields) uint32, the crc32 of each field of each chunk. Fields without elements are left out.
    constants: uint8 in the shape of `checksums`: WRITTEN if the field is in the slot, otherwise the key of CONSTANTS
        for the value of all its elements.
    """

    path: Path
    slot_bytes: int
    fields: Mapping[str, tuple[int, ...]]
    lengths: NDArray[np.int64]
    slots: NDArray[np.int64]
    checksums: NDArray[np.uint32]
    constants: NDArray[np.uint8]

    def arrays(self) -> dict[str, NDArray[Any]]:
        """Return the arrays that a checkpoint stores for the manifest, keyed by MANIFEST_ARRAYS."""
        return dict(zip(MANIFEST_ARRAYS, (self.lengths, self.slots, self.checksums, self.constants), strict=True))

    def state(self) -> dict[str, Any]:
        """Return the parts of the manifest that are not arrays, as an entry of a checkpoint's state."""
        fields = {name: list(shape) for name, shape in self.fields.items()}
        sizes = {"rows": CHUNK_ROWS, "slot_bytes": self.slot_bytes}
        return {MANIFEST_KEY: {"file": str(self.path), **sizes, "fields": fields}}


def manifest_of(arrays: Mapping[str, NDArray[Any]], state: Mapping[str, Any]) -> Manifest | None:
    """Read the manifest from a checkpoint's arrays and state. Raises ValueError for damaged data.

    Returns None if the checkpoint has no manifest, because its arrays hold the Gaussians.
    """
    if (record := state.get(MANIFEST_KEY)) is None:
        return None
    if not isinstance(record, dict) or not set(MANIFEST_ARRAYS) <= arrays.keys():
        parts = f"an object {MANIFEST_KEY!r} in its state, and the arrays {', '.join(MANIFEST_ARRAYS)}"
        raise ValueError(f"its list of chunks is incomplete: expected {parts}")
    lengths, slots, checksums, constants = (arrays[key] for key in MANIFEST_ARRAYS)
    file, slot_bytes, fields = record.get("file"), record.get("slot_bytes"), record.get("fields")
    if not isinstance(file, str) or type(slot_bytes) is not int or record.get("rows") != CHUNK_ROWS:
        found = f"file {file!r:.80}, slot_bytes {slot_bytes!r:.80} and rows {record.get('rows')!r:.80}"
        raise ValueError(f"its list of chunks has {found}, expected a path, a whole number and {CHUNK_ROWS}")
    if not isinstance(fields, dict) or len(fields) > _MOST_FIELDS or not all(map(_is_shape, fields.values())):
        limits = f"at most {_MOST_FIELDS} shapes of at most {_MOST_FLOATS} elements"
        raise ValueError(f"the fields of its chunks are damaged: expected {limits}")
    shapes = {name: tuple(shape) for name, shape in fields.items()}
    filled = sum(0 not in shape for shape in shapes.values())
    least, most = _record_bytes(shapes), _MOST_FIELDS * _MOST_FLOATS * 4 * CHUNK_ROWS
    if not least <= slot_bytes <= most:
        raise ValueError(f"its chunks are in slots of {slot_bytes} bytes, expected {least} to {most} bytes")
    by_chunk, by_field = lengths.shape[:1], (*lengths.shape[:1], filled)
    wanted = (
        (lengths, by_chunk, np.int64),
        (slots, by_chunk, np.int64),
        (checksums, by_field, np.uint32),
        (constants, by_field, np.uint8),
    )
    for array, shape, kind in wanted:
        if array.shape != shape or array.dtype != kind:
            raise ValueError(f"its list of chunks has {array.dtype} {array.shape}, expected {np.dtype(kind)} {shape}")
    if not 1 <= lengths.min(initial=CHUNK_ROWS + 1) <= lengths.max(initial=1) <= CHUNK_ROWS:
        raise ValueError(f"its list of chunks is empty, or a chunk has no rows or more than {CHUNK_ROWS}")
    written = slots[slots >= 0]
    if slots.min() < -1 or len(np.unique(written)) < len(written):
        raise ValueError("two of its chunks are in the same slot, or a slot number is below -1")
    if constants.max(initial=WRITTEN) > INFINITE or (constants[slots < 0] == WRITTEN).any():
        codes = f"0 to {INFINITE}, and not {WRITTEN} for a chunk without a slot"
        raise ValueError(f"its list of chunks has unknown codes of constants: expected {codes}")
    return Manifest(Path(file), slot_bytes, shapes, lengths, slots, checksums, constants)


def _record_bytes(fields: Mapping[str, tuple[int, ...]]) -> int:
    return 4 * CHUNK_ROWS * sum(map(prod, fields.values()))


def _is_shape(value: object) -> bool:
    """Return True for a JSON list that is the shape of an array with at most `_MOST_FLOATS` elements."""
    if not isinstance(value, list) or not all(type(size) is int and 0 <= size <= _MOST_FLOATS for size in value):
        return False
    return prod(value) <= _MOST_FLOATS
