# SPDX-License-Identifier: Apache-2.0
"""Tags of TIFF files, which most raw formats are: whether a file is a DNG, and whether it is complete."""

from __future__ import annotations

import io
import struct
from collections.abc import Iterator
from pathlib import Path

TIFF_BYTE_ORDERS = {b"II*\0": "<", b"MM\0*": ">"}
"""Byte order, as a character for the module struct, by the first bytes of a TIFF."""
MAX_TIFF_TAGS, MAX_TIFF_DIRECTORIES, MAX_TIFF_VALUES = 1024, 32, 1 << 16
"""Most tags of a directory, directories of a file, and values of a tag that are read. Damaged files may claim more."""
_TYPES = {1: "B", 3: "H", 4: "I", 13: "I"}
_SUBFILE_TYPE, _STRIPS, _SUB_DIRECTORIES, _TILES, _DNG_VERSION = 254, (273, 279), 330, (324, 325), 50706


def is_dng(path: Path, order: str) -> bool:
    """Return True if the first directory of a TIFF has the tag DNGVersion. order: as in TIFF_BYTE_ORDERS."""
    with open(path, "rb") as file:
        return _DNG_VERSION in next(_directories(file, order), {})


def is_cut_off(path: Path, order: str) -> bool:
    """Return True if a full-size picture of a TIFF reaches beyond the file's end. order: as in TIFF_BYTE_ORDERS."""
    size = path.stat().st_size
    with open(path, "rb") as file:
        for tags in _directories(file, order):
            if tags.get(_SUBFILE_TYPE) != (0,):  # a preview, or a picture of unknown type
                continue
            for places, counts in (_STRIPS, _TILES):
                ends = (at + count for at, count in zip(tags.get(places, ()), tags.get(counts, ()), strict=False))
                if any(end > size for end in ends):
                    return True
    return False


def _directories(file: io.BufferedReader, order: str) -> Iterator[dict[int, tuple[int, ...]]]:
    """Yield each directory of a TIFF as the integers of its tags, by the tag's number; () for values of other types."""
    file.seek(4)
    waiting, seen = list(_unpacked(file.read(4), order, "I")), set[int]()
    while waiting and len(seen) < MAX_TIFF_DIRECTORIES:
        at = waiting.pop(0)
        if at in seen or at == 0:
            continue
        seen.add(at)
        file.seek(at)
        count = (*_unpacked(file.read(2), order, "H"), 0)[0]
        entries = file.read(12 * min(count, MAX_TIFF_TAGS))
        following = _unpacked(file.read(4), order, "I")
        tags = {}
        for begin in range(0, len(entries) - 11, 12):
            tag, kind, number, place = struct.unpack_from(f"{order}HHII", entries, begin)
            letter = _TYPES.get(kind, "")
            width = struct.calcsize(letter) * number
            data = entries[begin + 8 : begin + 12]
            if letter and width > 4 and number <= MAX_TIFF_VALUES:
                file.seek(place)
                data = file.read(width)
            tags[tag] = _unpacked(data[:width], order, letter) if number <= MAX_TIFF_VALUES else ()
        yield tags
        waiting += [*tags.get(_SUB_DIRECTORIES, ()), *following]


def _unpacked(data: bytes, order: str, letter: str) -> tuple[int, ...]:
    """Return all integers that the bytes hold. letter: the integers' type in the module struct; "" to return ()."""
    count = len(data) // struct.calcsize(letter) if letter else 0
    return struct.unpack_from(f"{order}{count}{letter}", data) if count else ()
