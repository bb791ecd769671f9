# SPDX-License-Identifier: Apache-2.0
"""Conversion of deep samples from arrays to OpenImageIO's deep data, by way of a scratch deep EXR.

OpenImageIO's Python interface sets deep values one by one, which takes twenty times as long as rendering the frame.
Reading a deep file is fast. So this module writes the samples to an uncompressed deep EXR, whose layout is simple
(https://openexr.com/en/latest/OpenEXRFileLayout.html), and OpenImageIO reads it. OpenImageIO then writes the final file
with its header and compression.
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
from clsplat.files.names import native_name

_EXR_MAGIC, _EXR_VERSION, _EXR_DEEP_FLAG = 20000630, 2, 0x800
_EXR_PIXEL_TYPES = {2: 1, 4: 2}
"""EXR's codes of HALF and FLOAT, by size in bytes."""


def samples_bytes(pixels: int, most: int) -> int:
    """Return an upper bound in bytes of `deep_data`'s scratch file, for at most `most` samples in each pixel."""
    return pixels * (4 + 24 * most) + 40 * pixels + (1 << 12)


def deep_data(scratch: Path, counts: NDArray[np.int32], columns: dict[str, NDArray[Any]]) -> Any:
    """Return OpenImageIO's deep data of some rows of a frame.

    scratch: path of the scratch file to write and read.
    counts (H, W): number of samples of each pixel.
    columns: values (samples,) by channel name, half or float, ordered by row, then by pixel, then front to back.
    Raises ClsplatError if OpenImageIO cannot read the scratch file.
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
    names = sorted(columns)  # EXR sorts channels by name
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
    listed = (name.encode() + b"\0" + struct.pack("<4i", _EXR_PIXEL_TYPES[size], 0, 1, 1) for name, size in channels)
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
    return struct.pack("<2i", _EXR_MAGIC, _EXR_VERSION | _EXR_DEEP_FLAG) + b"".join(texts) + b"\0"
