# SPDX-License-Identifier: Apache-2.0
"""Reading of PLY files: the header, and the rows of the vertices.

Format: http://paulbourke.net/dataformats/ply/. Comments that describe models are parsed with the header.
Only clsplat writes ORIGIN_COMMENT, NEAR_PLANE_COMMENT and ALONG_RAYS_COMMENT. Other programs also write comments
about antialiasing.
"""

from __future__ import annotations

import os
import re
from collections.abc import Iterator
from dataclasses import dataclass, field
from itertools import islice
from pathlib import Path
from typing import Any, BinaryIO

import numpy as np
from numpy.typing import NDArray

from clsplat.arrays import Float64, numbers
from clsplat.camera import DEFAULT_NEAR_PLANE
from clsplat.errors import InputError, examples, warn
from clsplat.images.colour import MAX_PLY_LINE_BYTES
from clsplat.models.codec import antialias, values
from clsplat.models.codec.values import IO_BLOCK_ROWS

MAX_PLY_HEADER_LINES = 10_000
MAX_PLY_HEADER_BYTES = 1 << 24
"""Largest size of the header in bytes, because it is held in memory."""
MAX_BLOCK_BYTES, MAX_BLOCK_WORDS = 1 << 26, 1 << 21
"""Largest size of a block of rows: bytes of a binary file, numbers of an ascii file."""
MAX_NUMBER_TEXT_BYTES = 128
"""Longest text of a number, in bytes. It bounds the memory of a row: NumPy makes all texts as wide as the longest."""

_PLY_1_0_DTYPES = {"char": "i1", "uchar": "u1", "short": "i2", "ushort": "u2", "int": "i4", "uint": "u4", "float": "f4",
          "double": "f8"}  # fmt: skip
PLY_DTYPES = _PLY_1_0_DTYPES | {np.dtype(code).name: code for code in _PLY_1_0_DTYPES.values()}
"""NumPy types by PLY name. Newer PLY files use NumPy's names, such as float32."""
PLY_BYTE_ORDERS = {"binary_little_endian": "<", "binary_big_endian": ">"}

_NAN_TEXT = re.compile(r"[-+]?(?:1\.#(?:[qs]?nan|ind)\d*|[qs]?nan(?:\(\w*\))?)", re.IGNORECASE)
_INFINITY_TEXT = re.compile(r"([-+]?)1\.#inf\d*", re.IGNORECASE)

ORIGIN_COMMENT = ["comment", "clsplat", "origin"]
NEAR_PLANE_COMMENT = ["comment", "clsplat", "near"]
ANTIALIASED_COMMENT = ["comment", "SplatRenderMode:", "mip"]
"""Comment of an antialiased model, as Brush and other programs write it."""
ALONG_RAYS_COMMENT = ["comment", "clsplat", "rays"]
"""Comment in the PLY header of a model whose Gaussians perspective cameras evaluate along each pixel's ray, and do not
project to ellipses (`Gaussians.by_rays`)."""


@dataclass
class Element:
    """An element of a PLY header.

    properties: name and NumPy type of each property, without byte order. The type is "" for a list.
    """

    name: str
    count: int
    properties: list[tuple[str, str]] = field(default_factory=list)

    @property
    def row_bytes(self) -> int:
        """Bytes of a row. The element must have no lists."""
        return sum(np.dtype(code).itemsize for _, code in self.properties)

    @property
    def has_list(self) -> bool:
        return any(code == "" for _, code in self.properties)


@dataclass
class PlyHeader:
    """Parsed header of a PLY file.

    path: the file, for messages.
    format: "ascii" or a key of PLY_BYTE_ORDERS.
    size: the header's length in bytes, `end_header` included.
    origin: point in the world that the means in the element `ply.LOCAL_MEANS_ELEMENT` are relative to; None if no
        comment states it.
    near, by_rays: `Gaussians.near` and `Gaussians.by_rays`, from the header's comments.
    """

    path: Path
    format: str
    elements: list[Element]
    size: int
    origin: Float64 | None = None
    near: float = DEFAULT_NEAR_PLANE
    comments: list[str] = field(default_factory=list)
    by_rays: bool = False

    def is_antialiased(self) -> bool:
        """True if the comments say that the model is antialiased (`codec.antialias`). Warns if they are unclear."""
        said = antialias.of_comments(self.comments)
        if said.warning:
            warn(f"{self.path}: {said.warning}")
        return said.antialiased

    @property
    def vertex(self) -> Element:
        """The element `vertex`, which has the Gaussians. Raises InputError if there is none."""
        if vertices := [element for element in self.elements if element.name == "vertex"]:
            return vertices[0]
        names = examples(element.name for element in self.elements) or "none"
        raise InputError(f"{self.path}: PLY has no element 'vertex' (elements: {names})")

    @property
    def before(self) -> list[Element]:
        """The elements that the file stores before its vertices."""
        return self.elements[: self.elements.index(self.vertex)]

    def start(self, index: int) -> int:
        """Byte offset of the element `index` in a binary file, or of the data's end if `index` is one past the last."""
        return self.size + sum(element.count * element.row_bytes for element in self.elements[:index])

    def row_type(self, element: Element) -> np.dtype[Any]:
        """Packed dtype of a row of an element in a binary file."""
        order = PLY_BYTE_ORDERS[self.format]
        return np.dtype([(name, order + code) for name, code in element.properties])


def _header_lines(file: BinaryIO, path: Path) -> Iterator[bytes]:
    """Yield the header's complete lines after the first. Raises InputError if the header exceeds its size limits."""
    for _ in range(MAX_PLY_HEADER_LINES):
        line = file.readline(MAX_PLY_LINE_BYTES + 1)
        if len(line) > MAX_PLY_LINE_BYTES or file.tell() > MAX_PLY_HEADER_BYTES:
            raise InputError(
                f"{path}: PLY header has a line of more than {MAX_PLY_LINE_BYTES >> 20} MiB or is longer than "
                f"{MAX_PLY_HEADER_BYTES >> 20} MiB; is it damaged?"
            )
        if not line.endswith(b"\n"):
            return
        yield line
    raise InputError(f"{path}: PLY header has more than {MAX_PLY_HEADER_LINES:,} lines; is it damaged?")


def read_header(file: BinaryIO, path: Path) -> PlyHeader:
    """Read the header and leave `file` at the first byte after it. Raises InputError."""
    if file.read(3) != b"ply" or file.readline(16).strip():
        raise InputError(f"{path}: not a PLY file (it does not begin with a line 'ply')")
    form = ""
    elements: list[Element] = []
    comments: list[str] = []
    origin, near, by_rays = None, DEFAULT_NEAR_PLANE, False
    for line in _header_lines(file, path):
        words = line.decode("ascii", "replace").split()
        if not words or words[0] in ("comment", "obj_info"):
            given = numbers(words[3:])  # an empty array if the words are not numbers
            if words[:3] == ORIGIN_COMMENT:
                origin = given if len(given) == 3 and np.isfinite(given).all() else None
            if words[:3] == NEAR_PLANE_COMMENT:
                near = float(given[0]) if len(given) == 1 and 0 < given[0] < np.inf else DEFAULT_NEAR_PLANE
            by_rays |= words == ALONG_RAYS_COMMENT
            comments += [" ".join(words[1:])] if words else []
            continue
        if words == ["end_header"]:
            if form not in ("ascii", *PLY_BYTE_ORDERS):
                expected = "ascii, binary_little_endian or binary_big_endian"
                raise InputError(f"{path}: PLY header has the format {form or 'missing'!r}, expected {expected}")
            return PlyHeader(path, form, elements, file.tell(), origin, near, comments, by_rays)
        try:
            match words:
                case ["format", name, _]:
                    form = name
                case ["element", name, count] if int(count) >= 0:
                    elements.append(Element(name, int(count)))
                case ["property", "list", _, _, name]:
                    elements[-1].properties.append((name, ""))
                case ["property", kind, name]:
                    elements[-1].properties.append((name, PLY_DTYPES[kind]))
                case _:
                    raise ValueError
        except (ValueError, KeyError, IndexError):
            raise InputError(f"{path}: PLY header has an invalid line: {' '.join(words)[:80]!r}") from None
    raise InputError(f"{path}: PLY header is truncated or damaged (no line 'end_header')")


Block = dict[str, NDArray[Any]]


def read_vertices(file: BinaryIO, header: PlyHeader, what: str) -> Iterator[Block]:
    """Yield the vertices in blocks of rows. A block maps each property's name to its column.

    The file's length is checked before the first block, so the caller may then allocate memory for all vertices. The
    check is exact for a binary file; an ascii file must have at least two bytes per number. Raises InputError.

    what: noun for one vertex in messages, such as "Gaussian".
    """
    path, vertex = header.path, header.vertex
    names = [name for name, _ in vertex.properties]
    if double := next((name for name in names if names.count(name) > 1), None):
        raise InputError(f"{path}: PLY has the property {double} twice")
    if vertex.has_list:
        raise InputError(f"{path}: PLY has a list property in its vertices, expected numbers only")
    read = _ascii_blocks if header.format == "ascii" else _binary_blocks
    return read(file, header, what)


def _binary_blocks(file: BinaryIO, header: PlyHeader, what: str) -> Iterator[Block]:
    path, vertex = header.path, header.vertex
    for element in header.before:
        if element.has_list:
            raise InputError(f"{path}: PLY has lists before its vertices (in {element.name!r}), which is not supported")
    start = header.start(len(header.before))
    row = header.row_type(vertex)
    need, have = vertex.count * row.itemsize, max(0, os.fstat(file.fileno()).st_size - start)
    if have < need:
        whole = have // row.itemsize
        raise InputError(f"{path}: truncated: has {whole} of {vertex.count} {what}s ({have} of {need} bytes)")
    if have > need and header.elements[-1] is vertex:
        warn(f"{path}: {have - need} bytes after the last {what} are ignored")
    file.seek(start)
    block = min(IO_BLOCK_ROWS, max(MAX_BLOCK_BYTES // max(row.itemsize, 1), 1))
    for first in range(0, vertex.count, block):
        count = min(block, vertex.count - first)
        rows = values.read_rows(file, row, count, path)
        yield {name: rows[name] for name, _ in vertex.properties}


def _text_lines(file: BinaryIO, path: Path) -> Iterator[bytes]:
    """Yield the lines of an ascii file that are not blank. Raises InputError for a line too long to be a row."""
    while line := file.readline(MAX_PLY_LINE_BYTES + 1):
        if len(line) > MAX_PLY_LINE_BYTES:
            raise InputError(f"{path}: has a line of more than {MAX_PLY_LINE_BYTES} bytes, expected rows of numbers")
        if not line.isspace():
            yield line


def _parse_row(words: list[bytes], where: str) -> list[float]:
    """Parse a row of numbers. NaN and infinity may be written as by Microsoft's C library, such as 1.#INF.

    Raises InputError, prefixed with `where`, for any other text.
    """
    found = []
    for word in words:
        text = word.decode("ascii", "replace")
        try:
            found.append(np.nan if _NAN_TEXT.fullmatch(text) else float(_INFINITY_TEXT.sub(r"\1inf", text)))
        except ValueError:
            raise InputError(f"{where} has {text[:40]!r}, expected a number") from None
    return found


def _ascii_blocks(file: BinaryIO, header: PlyHeader, what: str) -> Iterator[Block]:
    """Yield the vertices of an ascii file in blocks of float64 columns, like `read_vertices`."""
    path, vertex = header.path, header.vertex
    lines = _text_lines(file, path)
    # a value takes at least a character and a blank
    least, have = 2 * vertex.count * len(vertex.properties) - 1, os.fstat(file.fileno()).st_size - header.size
    too_many = have < least
    for element in header.before:
        for _ in islice(lines, element.count):
            pass
    width = len(vertex.properties)
    block = min(IO_BLOCK_ROWS, max(MAX_BLOCK_WORDS // max(width, 1), 1))
    for first in range(0, vertex.count, block):
        count = min(block, vertex.count - first)
        rows = [line.split() for line in islice(lines, count)]
        for index, words in enumerate(rows):
            if len(words) != width:
                raise InputError(f"{path}: {what} {first + index} has {len(words)} values, expected {width}")
            if max(map(len, words), default=0) > MAX_NUMBER_TEXT_BYTES:
                raise InputError(f"{path}: {what} {first + index} has a value that is not a number")
        if len(rows) < count:
            raise InputError(f"{path}: truncated: has {first + len(rows)} {what}s, expected {vertex.count}")
        if too_many:
            raise InputError(f"{path}: truncated: has {have} bytes, too few for {vertex.count} {what}s")
        try:
            table = np.array(rows, dtype="S").astype(np.float64).reshape(count, width)
        except ValueError:
            table = np.array([_parse_row(words, f"{path}: {what} {first + at}") for at, words in enumerate(rows)])
        yield {name: table[:, index] for index, (name, _) in enumerate(vertex.properties)}
    if header.elements[-1] is vertex and next(lines, None) is not None:
        warn(f"{path}: text after the last {what} is ignored")
