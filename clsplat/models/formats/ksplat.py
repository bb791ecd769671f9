# SPDX-License-Identifier: Apache-2.0
"""mkkellogg's .ksplat, version 0.1, compression levels 0, 1 and 2; read only.

https://github.com/mkkellogg/GaussianSplats3D (src/loaders/SplatBuffer.js). Little-endian. A header of 4096 bytes, a
header of 1024 bytes for each section, then the sections. A section has the lengths of its partly filled buckets, the
buckets' centres and the Gaussians.

- A Gaussian: position, scale, quaternion w x y z, bytes of red, green, blue and opacity, and higher SH.
- Scales are standard deviations, not logs. SH above degree 0 are stored by degree, channel-major in each.
- Axes and the signs of SH are as in the 3DGS PLY.
- Level 0: float32.
- Level 1: half floats, and positions in 16 bits around their bucket's centre.
- Level 2: as level 1, but SH in bytes between the header's two bounds.
"""

from __future__ import annotations

import os
from dataclasses import dataclass
from pathlib import Path
from typing import Any, BinaryIO

import numpy as np
from numpy.typing import NDArray

from clsplat.errors import InputError
from clsplat.files.documents import open_input
from clsplat.gaussians import Gaussians
from clsplat.models.codec import values as packing

KSPLAT_HEADER = np.dtype(
    {
        "names": ["major", "minor", "sections", "count", "level", "least_sh", "largest_sh"],
        "formats": ["u1", "u1", "<u4", "<u4", "<u2", "<f4", "<f4"],
        "offsets": [0, 1, 4, 16, 20, 36, 40],
        "itemsize": 4096,
    }
)
KSPLAT_SECTION_HEADER = np.dtype(
    {
        "names": ["count", "room", "bucket_size", "buckets", "block",
                  "bucket_bytes", "range", "full", "partial", "degree"],
        "formats": ["<u4", "<u4", "<u4", "<u4", "<f4", "<u2", "<u4", "<u4", "<u4", "<u2"],
        "offsets": [0, 4, 8, 12, 16, 20, 24, 32, 36, 40],
        "itemsize": 1024,
    }
)  # fmt: skip
BUCKET_CENTRE_BYTES = 12
DEFAULT_POSITION_RANGE = 32767
"""Largest distance, in steps, of a stored position from its bucket's centre. A header with a 0 means this default."""
DEFAULT_SH_BOUND = 1.5
"""Bound b of SH coefficients, which bytes store between -b and b. A header with a 0 means this default."""
SH_VALUES_BY_DEGREE = (0, 9, 24, 45)
_POSITION_DTYPES, _FLOAT_DTYPES, _SH_DTYPES = ("<f4", "<u2", "<u2"), ("<f4", "<f2", "<f2"), ("<f4", "<f2", "u1")


@dataclass(frozen=True)
class Section:
    """A section of a .ksplat file: place and encoding of its Gaussians.

    count: number of Gaussians.
    start: byte offset of the first Gaussian.
    kind: dtype of a record.
    step: world units per step of a stored position.
    middle: the stored number, in steps, that stands for the bucket's centre.
    centres: (buckets, 3), the buckets' centres in world units; None at level 0.
    ends: (buckets,), index of the first Gaussian after each bucket; None at level 0.
    """

    count: int
    start: int
    kind: np.dtype[Any]
    degree: int
    step: float
    middle: int
    centres: NDArray[np.float32] | None
    ends: NDArray[np.int64] | None


def read(path: Path) -> Gaussians:
    """Read a .ksplat file.

    Raises InputError for another version or level, a truncated file, inconsistent counts, or negative scales of only a
    few Gaussians; if many are negative, all are read as logs (`values.all_to_log_scales`).
    """
    with open_input(path, "a .ksplat file") as file:
        size = os.fstat(file.fileno()).st_size
        if size < KSPLAT_HEADER.itemsize:
            raise InputError(f"{path}: truncated: has {size} bytes, expected a header of {KSPLAT_HEADER.itemsize}")
        header = packing.read_rows(file, KSPLAT_HEADER, 1, path)[0]
        if header["major"] != 0 or header["minor"] < 1 or header["level"] > 2:
            version = f"version {header['major']}.{header['minor']}, compression level {header['level']}"
            raise InputError(f"{path}: has {version}, expected a .ksplat of version 0.1, level 0, 1 or 2")
        sections = _sections(file, int(header["sections"]), int(header["level"]), size, path)
        count = sum(section.count for section in sections)
        if count != header["count"] or not count:
            raise InputError(f"{path}: its sections have {count} Gaussians, but its header says {header['count']}")
        degree = max(section.degree for section in sections if section.count)
        gaussians = packing.empty(count, degree)
        gaussians.sh[:, 1:] = 0
        low, high = float(header["least_sh"]) or -DEFAULT_SH_BOUND, float(header["largest_sh"]) or DEFAULT_SH_BOUND
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
    """Details of a file for `clsplat info`: version and compression level."""
    with open_input(path, "a .ksplat file") as file:
        header = packing.read_rows(file, KSPLAT_HEADER, 1, path)[0]
    return {"version": f"{header['major']}.{header['minor']}", "level": int(header["level"])}


def _sections(file: BinaryIO, sections: int, level: int, size: int, path: Path) -> list[Section]:
    """Read the headers of all sections, and check them against the file's size in bytes.

    sections: number of sections. level: compression level.
    """
    at = KSPLAT_HEADER.itemsize + sections * KSPLAT_SECTION_HEADER.itemsize
    if size < at:
        raise InputError(f"{path}: truncated: has {size} bytes, but its {sections} sections need {at}")
    result = []
    for index, fields in enumerate(packing.read_rows(file, KSPLAT_SECTION_HEADER, sections, path)):
        head = {name: fields[name].item() for name in KSPLAT_SECTION_HEADER.names or ()}
        name = f"{path}: section {index}"
        if head["degree"] >= len(SH_VALUES_BY_DEGREE):
            raise InputError(f"{name} has SH of degree {head['degree']}, expected 0 to {len(SH_VALUES_BY_DEGREE) - 1}")
        kind = _record(level, head["degree"])
        lengths, buckets = 4 * head["partial"], head["bucket_bytes"] * head["buckets"]
        start = at + lengths + buckets
        end = start + kind.itemsize * head["room"]
        if head["count"] > head["room"] or end > size:
            found = f"has {head['count']} Gaussians, but room for {head['room']}"
            raise InputError(f"{name} ends at byte {end} of {size}, and {found}; is the file damaged?")
        centres = ends = None
        if level:
            if head["buckets"] and head["bucket_bytes"] != BUCKET_CENTRE_BYTES:
                raise InputError(f"{name} has buckets of {head['bucket_bytes']} bytes, expected {BUCKET_CENTRE_BYTES}")
            file.seek(at)
            partial = packing.read_rows(file, np.dtype("<u4"), head["partial"], path).astype(np.int64)
            centres = packing.read_rows(file, np.dtype("<f4"), 3 * head["buckets"], path).reshape(-1, 3)
            ends = _ends(head, partial, name)
        scale_range = head["range"] or DEFAULT_POSITION_RANGE
        step = head["block"] / 2 / scale_range
        result.append(Section(head["count"], start, kind, head["degree"], step, scale_range, centres, ends))
        at = end
    return result


def _record(level: int, degree: int) -> np.dtype[Any]:
    return np.dtype(
        [
            ("means", _POSITION_DTYPES[level], 3),
            ("scales", _FLOAT_DTYPES[level], 3),
            ("quaternions", _FLOAT_DTYPES[level], 4),
            ("rgba", "u1", 4),
            ("sh", _SH_DTYPES[level], (SH_VALUES_BY_DEGREE[degree],)),
        ]
    )


def _ends(head: dict[str, Any], partial: NDArray[np.int64], name: str) -> NDArray[np.int64]:
    """Index of the first Gaussian after each bucket of a section. Full buckets come first.

    head: the section's header. partial: numbers of Gaussians in the partly filled buckets. name: prefix of errors.
    Raises InputError for more buckets than the header states, or if the buckets hold too few Gaussians.
    """
    full = head["full"]
    if full + len(partial) > head["buckets"]:
        raise InputError(
            f"{name} has {full} full and {len(partial)} partly filled buckets, expected at most {head['buckets']} "
            "in all"
        )
    lengths = np.concatenate([np.full(full, head["bucket_size"], np.int64), partial])
    ends = np.cumsum(lengths)
    if head["count"] > (ends[-1] if len(ends) else 0):
        raise InputError(f"{name} has {head['count']} Gaussians, but its buckets have fewer")
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
        at, width = SH_VALUES_BY_DEGREE[band - 1], 2 * band + 1
        part = values[:, at : at + 3 * width].reshape(-1, 3, width)
        gaussians.sh[rows, band**2 : (band + 1) ** 2] = part.transpose(0, 2, 1)
