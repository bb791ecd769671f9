# SPDX-License-Identifier: Apache-2.0
"""mkkellogg's .ksplat, read only, version 0.1, compression levels 0, 1 and 2.

https://github.com/mkkellogg/GaussianSplats3D (src/loaders/SplatBuffer.js). Little-endian: a header of 4096 bytes, one
of 1024 for each section, then the sections, each the lengths of its partly filled buckets, the buckets' centres and the
Gaussians. A Gaussian: position; scale, standard deviations, not logs; quaternion w x y z; red, green, blue, opacity in
bytes; SH above degree 0, by degree, in each channel-major. The frame and the signs of SH are the PLY's. Level 0 has
float32; level 1 half floats, and positions in 16 bits around their bucket's centre; level 2 the same, but SH in bytes
between the two bounds of the header.
"""

from __future__ import annotations

import os
from dataclasses import dataclass
from pathlib import Path
from typing import Any, BinaryIO

import numpy as np
from numpy.typing import NDArray

from clsplat.errors import InputError
from clsplat.files import open_input
from clsplat.gaussians import Gaussians
from clsplat.models.codec import values as packing

HEADER = np.dtype(
    {
        "names": ["major", "minor", "sections", "count", "level", "least_sh", "largest_sh"],
        "formats": ["u1", "u1", "<u4", "<u4", "<u2", "<f4", "<f4"],
        "offsets": [0, 1, 4, 16, 20, 36, 40],
        "itemsize": 4096,
    }
)
SECTION = np.dtype(
    {
        "names": ["count", "room", "bucket_size", "buckets", "block",
                  "bucket_bytes", "range", "full", "partial", "degree"],
        "formats": ["<u4", "<u4", "<u4", "<u4", "<f4", "<u2", "<u4", "<u4", "<u4", "<u2"],
        "offsets": [0, 4, 8, 12, 16, 20, 24, 32, 36, 40],
        "itemsize": 1024,
    }
)  # fmt: skip
BUCKET_BYTES = 12
DEFAULT_RANGE = 32767
DEFAULT_SH = 1.5
"""Value that 0 stands for in the header."""
SH_BYTES = (0, 9, 24, 45)
_POSITION, _FLOAT, _SH = ("<f4", "<u2", "<u2"), ("<f4", "<f2", "<f2"), ("<f4", "<f2", "u1")


@dataclass(frozen=True)
class Section:
    """count Gaussians from byte `start` on, of type `kind`; centres (count of buckets, 3) and ends, the first Gaussian
    behind each bucket, are None at level 0; step: world units of a position's 1, around `middle`."""

    count: int
    start: int
    kind: np.dtype[Any]
    degree: int
    step: float
    middle: int
    centres: NDArray[np.float32] | None
    ends: NDArray[np.int64] | None


def read(path: Path) -> Gaussians:
    """Read it. Raises InputError: another version or level, truncated, counts that do not fit each other, a few
    negative scales."""
    with open_input(path, "a .ksplat file") as file:
        size = os.fstat(file.fileno()).st_size
        if size < HEADER.itemsize:
            raise InputError(f"{path}: truncated: has {size} bytes, expected a header of {HEADER.itemsize}")
        header = packing.read_rows(file, HEADER, 1, path)[0]
        if header["major"] != 0 or header["minor"] < 1 or header["level"] > 2:
            version = f"version {header['major']}.{header['minor']}, compression level {header['level']}"
            raise InputError(f"{path}: {version}, expected a .ksplat of version 0.1, level 0, 1 or 2")
        sections = _sections(file, int(header["sections"]), int(header["level"]), size, path)
        count = sum(section.count for section in sections)
        if count != header["count"] or not count:
            raise InputError(f"{path}: its sections have {count} Gaussians, its header {header['count']}")
        degree = max(section.degree for section in sections if section.count)
        gaussians = packing.empty(count, degree)
        gaussians.sh[:, 1:] = 0
        low, high = float(header["least_sh"]) or -DEFAULT_SH, float(header["largest_sh"]) or DEFAULT_SH
        first = 0
        for section in sections:
            file.seek(section.start)
            for part in packing.row_blocks(section.count):
                block = packing.read_rows(file, section.kind, part.stop - part.start, path)
                rows = slice(first + part.start, first + part.stop)
                with np.errstate(invalid="ignore", over="ignore"):
                    gaussians.means[rows] = _means(section, block, part)
                    gaussians.log_scales[rows] = block["scales"]
                    _higher_sh(gaussians, rows, section.degree, block["sh"], (low, high))
                gaussians.quaternions[rows] = block["quaternions"]
                gaussians.sh[rows, 0] = packing.coefficients(block["rgba"][:, :3] / 255)
                gaussians.opacity_logits[rows] = packing.byte_logits()[block["rgba"][:, 3]]
            first += section.count
    packing.to_log_scales(gaussians, path)
    return gaussians


def describe(path: Path) -> dict[str, Any]:
    """The format's part of `clsplat info`: version and compression level."""
    with open_input(path, "a .ksplat file") as file:
        header = packing.read_rows(file, HEADER, 1, path)[0]
    return {"version": f"{header['major']}.{header['minor']}", "level": int(header["level"])}


def _sections(file: BinaryIO, sections: int, level: int, size: int, path: Path) -> list[Section]:
    """All of them, checked against the file's size."""
    at = HEADER.itemsize + sections * SECTION.itemsize
    if size < at:
        raise InputError(f"{path}: truncated: {sections} sections need {at} bytes, {size} are there")
    result = []
    for index, fields in enumerate(packing.read_rows(file, SECTION, sections, path)):
        head = {name: fields[name].item() for name in SECTION.names or ()}
        name = f"{path}: section {index}"
        if head["degree"] >= len(SH_BYTES):
            raise InputError(f"{name} has SH of degree {head['degree']}, expected 0 to {len(SH_BYTES) - 1}")
        kind = _record(level, head["degree"])
        lengths, buckets = 4 * head["partial"], head["bucket_bytes"] * head["buckets"]
        start = at + lengths + buckets
        end = start + kind.itemsize * head["room"]
        if head["count"] > head["room"] or end > size:
            raise InputError(f"{name} ends at byte {end} with {head['count']} Gaussians, {size} bytes are there")
        centres = ends = None
        if level:
            if head["buckets"] and head["bucket_bytes"] != BUCKET_BYTES:
                raise InputError(f"{name} has buckets of {head['bucket_bytes']} bytes, expected {BUCKET_BYTES}")
            file.seek(at)
            partial = packing.read_rows(file, np.dtype("<u4"), head["partial"], path).astype(np.int64)
            centres = packing.read_rows(file, np.dtype("<f4"), 3 * head["buckets"], path).reshape(-1, 3)
            ends = _ends(head, partial, name)
        scale_range = head["range"] or DEFAULT_RANGE
        step = head["block"] / 2 / scale_range
        result.append(Section(head["count"], start, kind, head["degree"], step, scale_range, centres, ends))
        at = end
    return result


def _record(level: int, degree: int) -> np.dtype[Any]:
    return np.dtype(
        [
            ("means", _POSITION[level], 3),
            ("scales", _FLOAT[level], 3),
            ("quaternions", _FLOAT[level], 4),
            ("rgba", "u1", 4),
            ("sh", _SH[level], (SH_BYTES[degree],)),
        ]
    )


def _ends(head: dict[str, Any], partial: NDArray[np.int64], name: str) -> NDArray[np.int64]:
    """The first Gaussian behind each bucket, the full ones first. Raises InputError where they are not all in one."""
    full = head["full"]
    if full + len(partial) > head["buckets"]:
        raise InputError(
            f"{name} has {full} full and {len(partial)} other buckets, expected {head['buckets']} together"
        )
    lengths = np.concatenate([np.full(full, head["bucket_size"], np.int64), partial])
    ends = np.cumsum(lengths)
    if head["count"] > (ends[-1] if len(ends) else 0):
        raise InputError(f"{name} has {head['count']} Gaussians, its buckets have fewer")
    return ends


def _means(section: Section, block: NDArray[Any], rows: slice) -> NDArray[Any]:
    if section.centres is None or section.ends is None:
        return block["means"]
    bucket = np.searchsorted(section.ends, np.arange(rows.start, rows.stop), side="right")
    return (block["means"].astype(np.float64) - section.middle) * section.step + section.centres[bucket]


def _higher_sh(gaussians: Gaussians, rows: slice, degree: int, stored: NDArray[Any], ends: tuple[float, float]) -> None:
    values = stored.astype(np.float32)
    if stored.dtype == np.uint8:
        values = np.float32(ends[0]) + values / np.float32(255) * np.float32(ends[1] - ends[0])
    for band in range(1, degree + 1):
        at, width = SH_BYTES[band - 1], 2 * band + 1
        part = values[:, at : at + 3 * width].reshape(-1, 3, width)
        gaussians.sh[rows, band**2 : (band + 1) ** 2] = part.transpose(0, 2, 1)
