# SPDX-License-Identifier: Apache-2.0
"""PlayCanvas' compressed PLY: 16 bytes a Gaussian in chunks of 256, and a byte for each higher SH coefficient.

https://blog.playcanvas.com/compressing-gaussian-splats and https://github.com/playcanvas/splat-transform (read-ply,
write-compressed-ply). Axes, quaternion order, log scales and signs are as in the 3DGS PLY.

- element `chunk`: bounds of position, log scale and colour (0.5 + C0 f_dc) of 256 Gaussians. Older files have no colour
  bounds; colours are then between 0 and 1. Written log scales are clamped to -20 to 20.
- `vertex`, packed_position and packed_scale: x, y and z in 11, 10 and 11 bits, from the highest bit down, between the
  chunk's bounds.
- `vertex`, packed_rotation: the top 2 bits are the index of the largest of w x y z, which is positive. The other
  components follow in order, 10 bits each for -1/sqrt(2) to 1/sqrt(2).
- `vertex`, packed_color: 8 bits each of red, green and blue, between the bounds, and of opacity, 0 to 1.
- element `sh`, if there are higher coefficients: f_rest_*, channel-major, in bytes for -4 to 4. A byte stands for the
  middle of one of 256 steps, but 0 for -4 and 255 for 4.

Some writers store infinite bounds, such as -inf, the log of a scale of 0. Gaussians at a finite bound keep their value;
all others become infinite.

The Gaussians of a chunk share its bounds, so a written file is sorted by position.
"""

from __future__ import annotations

import os
from collections.abc import Sequence
from pathlib import Path
from typing import Any, BinaryIO

import numpy as np
from numpy.typing import NDArray

from clsplat.errors import InputError
from clsplat.files.atomic import atomic_writer
from clsplat.files.documents import open_input
from clsplat.gaussians import MAX_SH_DEGREE, Gaussians
from clsplat.models.codec import ply_file
from clsplat.models.codec import values as packing
from clsplat.models.formats import ply

CHUNK_GAUSSIANS = 256
MAX_LOG_SCALE = 20.0
CHUNK_BOUND_PROPERTIES = tuple(
    f"{end}_{name}"
    for names in (("x", "y", "z"), ("scale_x", "scale_y", "scale_z"), ("r", "g", "b"))
    for end in ("min", "max")
    for name in names
)
PACKED_PROPERTIES = ("packed_position", "packed_rotation", "packed_scale", "packed_color")
_FIELDS_11_10_11 = ((21, 11), (11, 10), (0, 11))
_FIELDS_RGB_8 = ((24, 8), (16, 8), (8, 8))
_FIELDS_ROTATION_10 = ((20, 10), (10, 10), (0, 10))


def recognises(head: bytes) -> bool:
    """True for a PLY whose header names a packed property."""
    return head.startswith(b"ply") and b"packed_position" in head.partition(b"end_header")[0]


def read(path: Path) -> Gaussians:
    """Read a compressed PLY. Raises InputError for another format, missing elements or properties, or a short file."""
    with open_input(path, "a compressed PLY") as file:
        header = ply_file.read_header(file, path)
        chunks, vertex, sh = _elements(header)
        end, have = header.start(len(header.elements)), os.fstat(file.fileno()).st_size
        if have < end:
            raise InputError(f"{path}: truncated: has {have} bytes, but its header announces {end}")
        bounds = _bounds(file, header, chunks)
        rest = [] if sh is None else [f"f_rest_{index}" for index in range(len(sh.properties))]
        result = packing.empty(vertex.count, {0: 0, 9: 1, 24: 2, 45: 3}[len(rest)])
        for rows in packing.row_blocks(vertex.count):
            block = _rows(file, header, vertex, rows)
            _unpack(block, bounds[np.arange(rows.start, rows.stop) // CHUNK_GAUSSIANS], result, rows)
            if sh is not None:
                table = _rows(file, header, sh, rows)
                columns = np.stack([table[name] for name in rest], axis=1).astype(np.float32)
                steps = np.where(columns == 0, 0, np.where(columns == 255, 256, columns + np.float32(0.5)))
                values = (steps / 256 - 0.5) * 8
                result.sh[rows, 1:] = values.reshape(len(values), 3, -1).transpose(0, 2, 1)
    result.antialiased, result.by_rays = header.is_antialiased(), header.by_rays
    return result


def describe(path: Path) -> dict[str, Any]:
    """Details of a file for `clsplat info`: comments, `antialiased`, `by_rays`."""
    with open_input(path, "a compressed PLY") as file:
        header = ply_file.read_header(file, path)
    return {"comments": header.comments, "antialiased": header.is_antialiased(), "by_rays": header.by_rays}


def write(path: Path, gaussians: Gaussians, *, comments: Sequence[str] = ()) -> None:
    """Write a compressed PLY atomically, with the Gaussians in the order given by `order`.

    comments: lines for the header, in ASCII.
    """
    ply.check_comments(comments)
    packing.check_writable(path, gaussians)
    count, in_order = len(gaussians), order(gaussians)
    rest = 3 * (gaussians.sh.shape[1] - 1)
    lines = ["ply", "format binary_little_endian 1.0", "comment clsplat"]
    lines += [f"comment {line}" for line in comments]
    lines += [" ".join(ply_file.ANTIALIASED_COMMENT)] if gaussians.antialiased else []
    lines += [" ".join(ply_file.ALONG_RAYS_COMMENT)] if gaussians.by_rays else []
    lines += [
        f"element chunk {-(-count // CHUNK_GAUSSIANS)}",
        *(f"property float {name}" for name in CHUNK_BOUND_PROPERTIES),
    ]
    lines += [f"element vertex {count}", *(f"property uint {name}" for name in PACKED_PROPERTIES)]
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
    """Index (n,) of the Gaussian in each row of a written file, which is sorted along a Morton curve by position."""
    return packing.morton_order(gaussians.means)


def _elements(header: ply_file.PlyHeader) -> tuple[ply_file.Element, ply_file.Element, ply_file.Element | None]:
    """The PLY elements `chunk`, `vertex` and `sh`, with their properties checked. `sh` is None if the file has none."""
    path, names = header.path, [element.name for element in header.elements]
    if header.format == "ascii":
        raise InputError(f"{path}: is a compressed PLY in ascii, expected binary")
    for name in ("chunk", "vertex"):
        if names.count(name) != 1:
            raise InputError(f"{path}: its header has {names.count(name)} elements {name!r}, expected one")
    chunks, vertex = (header.elements[names.index(name)] for name in ("chunk", "vertex"))
    sh = header.elements[names.index("sh")] if "sh" in names else None
    wanted = (
        CHUNK_BOUND_PROPERTIES
        if set(dict(chunks.properties)) & set(CHUNK_BOUND_PROPERTIES[12:])
        else CHUNK_BOUND_PROPERTIES[:12]
    )
    if missing := [name for name in wanted if (name, "f4") not in chunks.properties]:
        raise InputError(f"{path}: element chunk lacks {' '.join(missing)}, expected floats")
    if missing := [name for name in PACKED_PROPERTIES if (name, "u4") not in vertex.properties]:
        raise InputError(f"{path}: element vertex lacks {' '.join(missing)}, expected uints")
    if vertex.count == 0:
        raise InputError(f"{path}: has 0 Gaussians (element vertex 0), expected at least one")
    if chunks.count * CHUNK_GAUSSIANS < vertex.count:
        raise InputError(
            f"{path}: has {chunks.count} chunks of {CHUNK_GAUSSIANS} Gaussians, too few for {vertex.count} Gaussians"
        )
    if sh is not None:
        counts = [3 * degree * (degree + 2) for degree in range(1, MAX_SH_DEGREE + 1)]
        properties = [(f"f_rest_{index}", "u1") for index in range(len(sh.properties))]
        if len(sh.properties) not in counts or set(properties) != set(sh.properties):
            raise InputError(
                f"{path}: element sh has unknown properties, expected {' or '.join(map(str, counts))} f_rest_* as uchar"
            )
        if sh.count != vertex.count:
            raise InputError(f"{path}: element sh has {sh.count} rows, expected {vertex.count} like element vertex")
    for element in header.elements:
        kept = [name for name, _ in element.properties]
        if element.has_list or len(set(kept)) < len(kept):
            raise InputError(f"{path}: element {element.name} has a list property, or the same property twice")
    return chunks, vertex, sh


def _rows(file: BinaryIO, header: ply_file.PlyHeader, element: ply_file.Element, rows: slice) -> NDArray[Any]:
    kind = header.row_type(element)
    file.seek(header.start(header.elements.index(element)) + rows.start * kind.itemsize)
    return packing.read_rows(file, kind, rows.stop - rows.start, header.path)


def _bounds(file: BinaryIO, header: ply_file.PlyHeader, chunks: ply_file.Element) -> NDArray[np.float32]:
    """Read the bounds of each chunk, (chunks, 3, 2, 3).

    The second axis is position, log scale and colour; the third minimum and maximum; the last the component.
    """
    table = _rows(file, header, chunks, slice(0, chunks.count))
    bounds = np.zeros((chunks.count, 18), np.float32)
    bounds[:, 15:] = 1
    for index, name in enumerate(CHUNK_BOUND_PROPERTIES):
        if name in (table.dtype.names or ()):
            bounds[:, index] = table[name]
    return bounds.reshape(-1, 3, 2, 3)


def _fields(words: NDArray[Any], layout: tuple[tuple[int, int], ...]) -> NDArray[np.float32]:
    """Bit fields (n, fields) of 32-bit words (n,), scaled to [0, 1]. layout: each field's shift and number of bits."""
    columns = [(words >> shift & (1 << bits) - 1) / np.float32((1 << bits) - 1) for shift, bits in layout]
    return np.stack(columns, axis=1).astype(np.float32)


def _unpack(block: NDArray[Any], bounds: NDArray[np.float32], result: Gaussians, rows: slice) -> None:
    """Unpack `block`, rows of the element `vertex`, into the given rows of the model `result`.

    bounds (n, 3, 2, 3): bounds of each row's chunk, as in `_bounds`.
    """

    def between(words: NDArray[Any], layout: tuple[tuple[int, int], ...], what: int) -> NDArray[np.float32]:
        part = _fields(words, layout)
        low, high = bounds[:, what, 0], bounds[:, what, 1]
        with np.errstate(invalid="ignore"):  # NaN at infinite bounds
            return packing.at_ends(low * (1 - part) + high * part, low, high, part)

    words = {name: block[name].astype(np.uint32) for name in PACKED_PROPERTIES}
    result.means[rows] = between(words["packed_position"], _FIELDS_11_10_11, 0)
    result.log_scales[rows] = between(words["packed_scale"], _FIELDS_11_10_11, 1)
    with np.errstate(over="ignore"):
        result.sh[rows, 0] = packing.coefficients(between(words["packed_color"], _FIELDS_RGB_8, 2))
    result.opacity_logits[rows] = packing.byte_logits()[words["packed_color"] & 255]
    others = (_fields(words["packed_rotation"], _FIELDS_ROTATION_10) - np.float32(0.5)) * np.float32(np.sqrt(2))
    result.quaternions[rows] = packing.restore_largest(words["packed_rotation"] >> 30, others)


def _values(gaussians: Gaussians, rows: NDArray[np.int64]) -> tuple[NDArray[Any], ...]:
    """Positions, log scales and colours of Gaussians, float64 (n, 3) each. Chunks have bounds of these values."""
    return (
        packing.world_means(gaussians, rows),
        np.clip(gaussians.log_scales[rows].astype(np.float64), -MAX_LOG_SCALE, MAX_LOG_SCALE),
        packing.colours(gaussians.sh[rows, 0]),
    )


def _ranges(*values: NDArray[Any]) -> NDArray[np.float32]:
    """Compute the bounds of each chunk, (chunks, 3, 2, 3) as in `_bounds`. The last chunk may be partial.

    values: positions, log scales and colours (n, 3) of Gaussians in the file's order.
    """
    at = np.arange(0, len(values[0]), CHUNK_GAUSSIANS)
    ends = [[np.minimum.reduceat(column, at), np.maximum.reduceat(column, at)] for column in values]
    return np.asarray(ends, np.float32).transpose(2, 0, 1, 3)


def _pack(gaussians: Gaussians, rows: NDArray[np.int64], ranges: NDArray[np.float32]) -> NDArray[Any]:
    """Pack Gaussians into rows of the element `vertex`, (n, 4) uint32.

    rows: indices of the Gaussians. ranges: bounds of their chunks, as in `_bounds`.
    """
    bounds = ranges[np.arange(len(rows)) // CHUNK_GAUSSIANS].astype(np.float64)

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
    words[:, 0] = fields(part(means, 0), _FIELDS_11_10_11)
    words[:, 2] = fields(part(scales, 1), _FIELDS_11_10_11)
    opacity = packing.to_bytes(packing.opacities(gaussians.opacity_logits[rows]))
    words[:, 3] = fields(part(rgb, 2), _FIELDS_RGB_8) | opacity
    which, others = packing.leave_out_largest(packing.unit_quaternions(gaussians.quaternions[rows]))
    words[:, 1] = fields(others / np.sqrt(2) + 0.5, _FIELDS_ROTATION_10) | which.astype(np.uint32) << np.uint32(30)
    return words
