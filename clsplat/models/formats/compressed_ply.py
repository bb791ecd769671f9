# SPDX-License-Identifier: Apache-2.0
"""PlayCanvas' compressed PLY: 16 bytes a Gaussian in chunks of 256, and a byte for each higher SH coefficient.

https://blog.playcanvas.com/compressing-gaussian-splats and https://github.com/playcanvas/splat-transform (read-ply,
write-compressed-ply). Frame, quaternion order, log scales and signs are the PLY's.

- element `chunk`: least and largest position, log scale and colour (0.5 + C0 f_dc) of 256 Gaussians; older files have
  no colours, which are then 0 to 1. Log scales are cut to -20 to 20 when written.
- element `vertex`: packed_position and packed_scale, 11, 10 and 11 bits from the top, between the chunk's bounds;
  packed_rotation, in the top 2 bits which of w x y z is the largest, then the others in order, 10 bits each for
  -1/sqrt(2) to 1/sqrt(2), the largest being positive; packed_color, 8 bits each of red, green, blue, between the
  bounds, and opacity, 0 to 1.
- element `sh`, where there are higher coefficients: f_rest_*, channel-major, bytes for -4 to 4: the middle of one of
  256 steps, but 0 and 255 are the ends.

An infinite bound is that of the Gaussians at that end of the steps, and of those between the ends: writers that let one
pass, as for a scale of 0 whose log is -inf, lose what is between.

A chunk's Gaussians share its bounds, so that they are sorted to lie near each other when written.
"""

from __future__ import annotations

import os
from collections.abc import Sequence
from pathlib import Path
from typing import Any, BinaryIO

import numpy as np
from numpy.typing import NDArray

from clsplat.errors import InputError
from clsplat.files import atomic_writer, open_input
from clsplat.gaussians import MAX_SH_DEGREE, Gaussians
from clsplat.models.codec import ply_file
from clsplat.models.codec import values as packing
from clsplat.models.formats import ply

CHUNK = 256
MAX_LOG_SCALE = 20.0
BOUNDS = tuple(
    f"{end}_{name}"
    for names in (("x", "y", "z"), ("scale_x", "scale_y", "scale_z"), ("r", "g", "b"))
    for end in ("min", "max")
    for name in names
)
PACKED = ("packed_position", "packed_rotation", "packed_scale", "packed_color")
_111011 = ((21, 11), (11, 10), (0, 11))
_8888 = ((24, 8), (16, 8), (8, 8))
_ROTATION = ((20, 10), (10, 10), (0, 10))


def recognises(head: bytes) -> bool:
    """A PLY whose header names a packed property."""
    return head.startswith(b"ply") and b"packed_position" in head.partition(b"end_header")[0]


def read(path: Path) -> Gaussians:
    """Read it. Raises InputError: not a compressed PLY, elements or properties missing, truncated."""
    with open_input(path, "a compressed PLY") as file:
        header = ply_file.read_header(file, path)
        chunks, vertex, sh = _elements(header)
        end, have = header.start(len(header.elements)), os.fstat(file.fileno()).st_size
        if have < end:
            raise InputError(f"{path}: truncated: its header promises {end} bytes, {have} are there")
        bounds = _bounds(file, header, chunks)
        rest = [] if sh is None else [f"f_rest_{index}" for index in range(len(sh.properties))]
        result = packing.empty(vertex.count, {0: 0, 9: 1, 24: 2, 45: 3}[len(rest)])
        for rows in packing.row_blocks(vertex.count):
            block = _rows(file, header, vertex, rows)
            _unpack(block, bounds[np.arange(rows.start, rows.stop) // CHUNK], result, rows)
            if sh is not None:
                table = _rows(file, header, sh, rows)
                columns = np.stack([table[name] for name in rest], axis=1).astype(np.float32)
                steps = np.where(columns == 0, 0, np.where(columns == 255, 256, columns + np.float32(0.5)))
                values = (steps / 256 - 0.5) * 8
                result.sh[rows, 1:] = values.reshape(len(values), 3, -1).transpose(0, 2, 1)
    result.antialiased, result.by_rays = header.is_antialiased(), header.by_rays
    return result


def describe(path: Path) -> dict[str, Any]:
    """The format's part of `clsplat info`: comments, `antialiased`, `by_rays`."""
    with open_input(path, "a compressed PLY") as file:
        header = ply_file.read_header(file, path)
    return {"comments": header.comments, "antialiased": header.is_antialiased(), "by_rays": header.by_rays}


def write(path: Path, gaussians: Gaussians, *, comments: Sequence[str] = ()) -> None:
    """Write it, atomically, the Gaussians in the order of `order`. comments: lines of the header, in ASCII."""
    ply.check_comments(comments)
    packing.check_writable(path, gaussians)
    count, in_order = len(gaussians), order(gaussians)
    rest = 3 * (gaussians.sh.shape[1] - 1)
    lines = ["ply", "format binary_little_endian 1.0", "comment clsplat"]
    lines += [f"comment {line}" for line in comments]
    lines += [" ".join(ply_file.MIP)] if gaussians.antialiased else []
    lines += [" ".join(ply_file.ALONG_RAYS)] if gaussians.by_rays else []
    lines += [f"element chunk {-(-count // CHUNK)}", *(f"property float {name}" for name in BOUNDS)]
    lines += [f"element vertex {count}", *(f"property uint {name}" for name in PACKED)]
    lines += [f"element sh {count}", *(f"property uchar f_rest_{index}" for index in range(rest))] if rest else []
    blocks = [in_order[rows] for rows in packing.row_blocks(count)]
    bounds = [_ranges(*_values(gaussians, rows)) for rows in blocks]
    with atomic_writer(path) as file:
        file.write("\n".join([*lines, "end_header", ""]).encode("ascii"))
        for block in bounds:
            file.write(block.astype("<f4").tobytes())
        for rows, block in zip(blocks, bounds, strict=True):
            file.write(_pack(gaussians, rows, block).tobytes())
        for rows in blocks if rest else ():
            sh = gaussians.sh[rows, 1:].transpose(0, 2, 1)
            file.write(np.clip(np.floor((sh / 8 + 0.5) * 256), 0, 255).astype(np.uint8).tobytes())


def order(gaussians: Gaussians) -> NDArray[np.int64]:
    """(n,) which Gaussian each row of the file is."""
    return packing.morton_order(gaussians.means)


def _elements(header: ply_file.Header) -> tuple[ply_file.Element, ply_file.Element, ply_file.Element | None]:
    """chunk, vertex and sh, if there is one, their properties checked."""
    path, names = header.path, [element.name for element in header.elements]
    if header.format == "ascii":
        raise InputError(f"{path}: a compressed PLY in ascii, expected binary")
    for name in ("chunk", "vertex"):
        if names.count(name) != 1:
            raise InputError(f"{path}: {names.count(name)} elements {name!r} in the header, expected one")
    chunks, vertex = (header.elements[names.index(name)] for name in ("chunk", "vertex"))
    sh = header.elements[names.index("sh")] if "sh" in names else None
    wanted = BOUNDS if set(dict(chunks.properties)) & set(BOUNDS[12:]) else BOUNDS[:12]
    if missing := [name for name in wanted if (name, "f4") not in chunks.properties]:
        raise InputError(f"{path}: element chunk lacks {' '.join(missing)}, expected floats")
    if missing := [name for name in PACKED if (name, "u4") not in vertex.properties]:
        raise InputError(f"{path}: element vertex lacks {' '.join(missing)}, expected uints")
    if vertex.count == 0:
        raise InputError(f"{path}: has 0 Gaussians (element vertex 0), expected at least one")
    if chunks.count * CHUNK < vertex.count:
        raise InputError(f"{path}: {chunks.count} chunks are too few for {vertex.count} Gaussians, {CHUNK} in each")
    if sh is not None:
        counts = [3 * degree * (degree + 2) for degree in range(1, MAX_SH_DEGREE + 1)]
        properties = [(f"f_rest_{index}", "u1") for index in range(len(sh.properties))]
        if len(sh.properties) not in counts or set(properties) != set(sh.properties):
            raise InputError(f"{path}: element sh, expected uchars f_rest_*, {', '.join(map(str, counts))} of them")
        if sh.count != vertex.count:
            raise InputError(f"{path}: element sh has {sh.count} rows, expected {vertex.count}, as vertex has")
    for element in header.elements:
        kept = [name for name, _ in element.properties]
        if element.has_list or len(set(kept)) < len(kept):
            raise InputError(f"{path}: element {element.name} has a list or a property twice, expected numbers")
    return chunks, vertex, sh


def _rows(file: BinaryIO, header: ply_file.Header, element: ply_file.Element, rows: slice) -> NDArray[Any]:
    kind = header.row_type(element)
    file.seek(header.start(header.elements.index(element)) + rows.start * kind.itemsize)
    return packing.read_rows(file, kind, rows.stop - rows.start, header.path)


def _bounds(file: BinaryIO, header: ply_file.Header, chunks: ply_file.Element) -> NDArray[np.float32]:
    """(chunks, 3, 2, 3): of position, log scale and colour, the least and the largest."""
    table = _rows(file, header, chunks, slice(0, chunks.count))
    bounds = np.zeros((chunks.count, 18), np.float32)
    bounds[:, 15:] = 1
    for index, name in enumerate(BOUNDS):
        if name in (table.dtype.names or ()):
            bounds[:, index] = table[name]
    return bounds.reshape(-1, 3, 2, 3)


def _fields(words: NDArray[Any], layout: tuple[tuple[int, int], ...]) -> NDArray[np.float32]:
    """(n, fields), each 0 to 1, of (shift, bits)."""
    columns = [(words >> shift & (1 << bits) - 1) / np.float32((1 << bits) - 1) for shift, bits in layout]
    return np.stack(columns, axis=1).astype(np.float32)


def _unpack(block: NDArray[Any], bounds: NDArray[np.float32], result: Gaussians, rows: slice) -> None:
    """block: rows of `vertex`; bounds (n, 3, 2, 3) of each."""

    def between(words: NDArray[Any], layout: tuple[tuple[int, int], ...], what: int) -> NDArray[np.float32]:
        part = _fields(words, layout)
        low, high = bounds[:, what, 0], bounds[:, what, 1]
        with np.errstate(invalid="ignore"):  # of infinite bounds
            return packing.at_ends(low * (1 - part) + high * part, low, high, part)

    words = {name: block[name].astype(np.uint32) for name in PACKED}
    result.means[rows] = between(words["packed_position"], _111011, 0)
    result.log_scales[rows] = between(words["packed_scale"], _111011, 1)
    with np.errstate(over="ignore"):
        result.sh[rows, 0] = packing.coefficients(between(words["packed_color"], _8888, 2))
    result.opacity_logits[rows] = packing.byte_logits()[words["packed_color"] & 255]
    others = (_fields(words["packed_rotation"], _ROTATION) - np.float32(0.5)) * np.float32(np.sqrt(2))
    result.quaternions[rows] = packing.restore_largest(words["packed_rotation"] >> 30, others)


def _values(gaussians: Gaussians, rows: NDArray[np.int64]) -> tuple[NDArray[Any], ...]:
    """Position, log scale and colour, float64 (n, 3) each."""
    return (
        packing.world_means(gaussians, rows),
        np.clip(gaussians.log_scales[rows].astype(np.float64), -MAX_LOG_SCALE, MAX_LOG_SCALE),
        packing.colours(gaussians.sh[rows, 0]),
    )


def _ranges(*values: NDArray[Any]) -> NDArray[np.float32]:
    """(chunks, 3, 2, 3) as `_bounds`, of whole chunks but for the last."""
    at = np.arange(0, len(values[0]), CHUNK)
    ends = [[np.minimum.reduceat(column, at), np.maximum.reduceat(column, at)] for column in values]
    return np.asarray(ends, np.float32).transpose(2, 0, 1, 3)


def _pack(gaussians: Gaussians, rows: NDArray[np.int64], ranges: NDArray[np.float32]) -> NDArray[Any]:
    """(n, 4) uint32: the rows of `vertex`."""
    bounds = ranges[np.arange(len(rows)) // CHUNK].astype(np.float64)

    def fields(parts: NDArray[Any], layout: tuple[tuple[int, int], ...]) -> NDArray[np.uint32]:
        word = np.zeros(len(parts), np.uint32)
        for column, (shift, bits) in zip(parts.T, layout, strict=True):
            top = (1 << bits) - 1
            word |= np.clip(np.rint(column * top), 0, top).astype(np.uint32) << np.uint32(shift)
        return word

    def part(values: NDArray[Any], what: int) -> NDArray[Any]:
        low, width = bounds[:, what, 0], bounds[:, what, 1] - bounds[:, what, 0]
        return (values - low) / np.where(width > 0, width, 1)

    means, scales, rgb = _values(gaussians, rows)
    words = np.empty((len(rows), 4), "<u4")
    words[:, 0] = fields(part(means, 0), _111011)
    words[:, 2] = fields(part(scales, 1), _111011)
    opacity = packing.to_bytes(packing.opacities(gaussians.opacity_logits[rows]))
    words[:, 3] = fields(part(rgb, 2), _8888) | opacity
    which, others = packing.leave_out_largest(packing.unit_quaternions(gaussians.quaternions[rows]))
    words[:, 1] = fields(others / np.sqrt(2) + 0.5, _ROTATION) | which.astype(np.uint32) << np.uint32(30)
    return words
