# SPDX-License-Identifier: Apache-2.0
"""Contents of files' headers, read byte by byte, because OpenImageIO translates names when it writes and reads."""

from __future__ import annotations

import struct
from pathlib import Path


def exr_attributes(path: Path) -> dict[str, tuple[str, bytes]]:
    """Type and value of each attribute of the first part (https://openexr.com/en/latest/OpenEXRFileLayout.html)."""
    data = path.read_bytes()
    assert data[:4] == b"\x76\x2f\x31\x01"
    at, found = 8, {}
    while data[at]:
        name, kind, rest = data[at:].split(b"\0", 2)
        at += len(name) + len(kind) + 2
        (size,) = struct.unpack("<i", rest[:4])
        found[name.decode()] = kind.decode(), rest[4 : 4 + size]
        at += 4 + size
    return found


def png_chunks(path: Path) -> dict[str, bytes]:
    """Chunks by kind; of several chunks of a kind, the last. The kind of a text is `tEXt` and its keyword."""
    data = path.read_bytes()
    at, found = 8, {}
    while at < len(data):
        size, kind = struct.unpack(">I4s", data[at : at + 8])
        value = data[at + 8 : at + 8 + size]
        if kind == b"tEXt":
            keyword, _, value = value.partition(b"\0")
            kind += b" " + keyword
        found[kind.decode()] = value
        at += 12 + size
    return found
