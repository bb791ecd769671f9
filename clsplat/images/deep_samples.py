# SPDX-License-Identifier: Apache-2.0
"""Samples of deep pixels, whole rows of them, as OpenImageIO writes them.

OpenImageIO takes deep values from Python one by one, which costs twenty times what a frame does. What it reads itself
it takes as a whole: so the rows go to it as a deep EXR without compression, whose layout is plain
(https://openexr.com/en/latest/OpenEXRFileLayout.html), and from it to the file, with its header and compression.
"""

from __future__ import annotations

import struct
from collections.abc import Sequence
from pathlib import Path
from typing import Any

import numpy as np
import OpenImageIO as oiio
from numpy.typing import NDArray

from clsplat.errors import ClsplatError
from clsplat.files import native_name

_MAGIC, _VERSION, _DEEP = 20000630, 2, 0x800
_PIXEL_TYPES = {2: 1, 4: 2}
"""HALF and FLOAT, by their bytes."""


def samples_bytes(pixels: int, most: int) -> int:
    """More bytes than the file of `deep_data` has for pixels of `most` samples in their rows."""
    return pixels * (4 + 24 * most) + 40 * pixels + (1 << 12)


def deep_data(scratch: Path, counts: NDArray[np.int32], columns: dict[str, NDArray[Any]]) -> Any:
    """OpenImageIO's deep data of rows of pixels.

    scratch: a file to go through; counts (H, W): samples of each pixel; columns: by channel, (samples,) halves or
    floats, in rows, in pixels, front to back. Raises ClsplatError.
    """
    _write(scratch, counts, columns)
    source = oiio.ImageInput.open(native_name(scratch))
    if source is None:
        raise ClsplatError(f"{scratch}: OpenImageIO cannot read deep rows: {oiio.geterror()}")
    try:
        data = source.read_native_deep_image()
    finally:
        source.close()
    if data is None or data.pixels != counts.size:
        raise ClsplatError(f"{scratch}: OpenImageIO cannot read deep rows: {source.geterror()}")
    return data


def _write(path: Path, counts: NDArray[np.int32], columns: dict[str, NDArray[Any]]) -> None:
    height, width = counts.shape
    names = sorted(columns)  # as EXR has channels
    table = np.cumsum(counts, axis=1, dtype="<i4")
    ends = [0, *np.cumsum(table[:, -1], dtype=np.int64).tolist()]
    each = sum(columns[name].itemsize for name in names)
    head = _header(width, height, [(name, columns[name].itemsize) for name in names])
    chunks: list[bytes | memoryview] = []
    place, places = len(head) + 8 * height, []
    for row in range(height):
        begin, end = ends[row], ends[row + 1]
        size = (end - begin) * each
        places.append(place)
        place += 28 + 4 * width + size
        chunks += [struct.pack("<i3Q", row, 4 * width, size, size), table[row].data]
        chunks += [columns[name][begin:end].data for name in names]
    with open(path, "wb") as file:
        file.writelines([head, struct.pack(f"<{height}Q", *places), *chunks])


def _header(width: int, height: int, channels: Sequence[tuple[str, int]]) -> bytes:
    window = struct.pack("<4i", 0, 0, width - 1, height - 1)
    listed = (name.encode() + b"\0" + struct.pack("<4i", _PIXEL_TYPES[size], 0, 1, 1) for name, size in channels)
    attributes = (
        ("channels", "chlist", b"".join(listed) + b"\0"),
        ("chunkCount", "int", struct.pack("<i", height)),
        ("compression", "compression", b"\0"),
        ("dataWindow", "box2i", window),
        ("displayWindow", "box2i", window),
        ("lineOrder", "lineOrder", b"\0"),
        ("pixelAspectRatio", "float", struct.pack("<f", 1)),
        ("screenWindowCenter", "v2f", bytes(8)),
        ("screenWindowWidth", "float", struct.pack("<f", 1)),
        ("type", "string", b"deepscanline"),
        ("version", "int", struct.pack("<i", 1)),
    )
    texts = (f"{name}\0{kind}\0".encode() + struct.pack("<i", len(value)) + value for name, kind, value in attributes)
    return struct.pack("<2i", _MAGIC, _VERSION | _DEEP) + b"".join(texts) + b"\0"
