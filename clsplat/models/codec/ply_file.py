# SPDX-License-Identifier: Apache-2.0
"""A PLY file of any contents: its header, and the rows of its vertices.

http://paulbourke.net/dataformats/ply/ has the format. The comments that models have are read with the header: ORIGIN,
NEAR_PLANE and ALONG_RAYS are clsplat's own, those of antialiasing many programs'.
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
from clsplat.camera import NEAR
from clsplat.errors import InputError, examples, warn
from clsplat.models.codec import antialias, values
from clsplat.models.codec.values import BLOCK_ROWS

MAX_HEADER_LINES = 10_000
MAX_LINE_BYTES = 1 << 20
MAX_HEADER_BYTES = 1 << 24
"""Of all its lines together, which are held."""
MAX_BLOCK_BYTES, MAX_BLOCK_WORDS = 1 << 26, 1 << 21
MAX_NUMBER_BYTES = 128
"""The longest number in text, as a row of them is made an array whose elements have the width of the widest."""

_TYPES = {"char": "i1", "uchar": "u1", "short": "i2", "ushort": "u2", "int": "i4", "uint": "u4", "float": "f4",
          "double": "f8"}  # fmt: skip
TYPES = _TYPES | {np.dtype(code).name: code for code in _TYPES.values()}
"""NumPy's types by PLY's names, of which newer ones, such as float32, are NumPy's."""
BYTE_ORDERS = {"binary_little_endian": "<", "binary_big_endian": ">"}

_NAN = re.compile(r"[-+]?(?:1\.#(?:[qs]?nan|ind)\d*|[qs]?nan(?:\(\w*\))?)", re.IGNORECASE)
_INFINITE = re.compile(r"([-+]?)1\.#inf\d*", re.IGNORECASE)

ORIGIN = ["comment", "clsplat", "origin"]
NEAR_PLANE = ["comment", "clsplat", "near"]
MIP = ["comment", "SplatRenderMode:", "mip"]
"""The comment of a model that is antialiased, in Brush's words, which other programs read and write too."""
ALONG_RAYS = ["comment", "clsplat", "rays"]
"""The comment of a model that perspective cameras draw along rays."""


@dataclass
class Element:
    """An element of the header: rows of `properties`, (name, NumPy type without byte order), "" for a list."""

    name: str
    count: int
    properties: list[tuple[str, str]] = field(default_factory=list)

    @property
    def row_bytes(self) -> int:
        """Bytes of a row, for an element without lists."""
        return sum(np.dtype(code).itemsize for _, code in self.properties)

    @property
    def has_list(self) -> bool:
        return any(code == "" for _, code in self.properties)


@dataclass
class Header:
    """path: of the file, for messages; format: "ascii" or a key of BYTE_ORDERS; size: the header's length in bytes,
    `end_header` included; origin: of the element LOCAL in a model; near: the near plane, where it is not the usual
    one; by_rays: as of `Gaussians`."""

    path: Path
    format: str
    elements: list[Element]
    size: int
    origin: Float64 | None = None
    near: float = NEAR
    comments: list[str] = field(default_factory=list)
    by_rays: bool = False

    def is_antialiased(self) -> bool:
        """True if the comments say so (`codec.antialias`). Warns where they say both, or what is not understood."""
        said = antialias.of_comments(self.comments)
        if said.warning:
            warn(f"{self.path}: {said.warning}")
        return said.antialiased

    @property
    def vertex(self) -> Element:
        """The element of the Gaussians. Raises InputError where there is none."""
        if vertices := [element for element in self.elements if element.name == "vertex"]:
            return vertices[0]
        names = examples(element.name for element in self.elements) or "none"
        raise InputError(f"{self.path}: PLY has no element 'vertex' (elements: {names})")

    @property
    def before(self) -> list[Element]:
        """The elements stored before the vertices."""
        return self.elements[: self.elements.index(self.vertex)]

    def start(self, index: int) -> int:
        """The place in a binary file of the element at this index, or of the end behind the last one."""
        return self.size + sum(element.count * element.row_bytes for element in self.elements[:index])

    def row_type(self, element: Element) -> np.dtype[Any]:
        """The packed record of one row of a binary file."""
        order = BYTE_ORDERS[self.format]
        return np.dtype([(name, order + code) for name, code in element.properties])


def _header_lines(file: BinaryIO, path: Path) -> Iterator[bytes]:
    """The whole lines behind the first. Raises InputError for more than a header may have."""
    for _ in range(MAX_HEADER_LINES):
        line = file.readline(MAX_LINE_BYTES + 1)
        if len(line) > MAX_LINE_BYTES or file.tell() > MAX_HEADER_BYTES:
            raise InputError(
                f"{path}: PLY header has a line of more than {MAX_LINE_BYTES >> 20} MiB or is longer than "
                f"{MAX_HEADER_BYTES >> 20} MiB; is it damaged?"
            )
        if not line.endswith(b"\n"):
            return
        yield line
    raise InputError(f"{path}: PLY header has more than {MAX_HEADER_LINES:,} lines; is it damaged?")


def read_header(file: BinaryIO, path: Path) -> Header:
    """Read the header and leave `file` at the first byte after it. Raises InputError."""
    if file.read(3) != b"ply" or file.readline(16).strip():
        raise InputError(f"{path}: not a PLY file (it does not begin with a line 'ply')")
    form = ""
    elements: list[Element] = []
    comments: list[str] = []
    origin, near, by_rays = None, NEAR, False
    for line in _header_lines(file, path):
        words = line.decode("ascii", "replace").split()
        if not words or words[0] in ("comment", "obj_info"):
            given = numbers(words[3:])  # none where the comment is not one of ours after all
            if words[:3] == ORIGIN:
                origin = given if len(given) == 3 and np.isfinite(given).all() else None
            if words[:3] == NEAR_PLANE:
                near = float(given[0]) if len(given) == 1 and 0 < given[0] < np.inf else NEAR
            by_rays |= words == ALONG_RAYS
            comments += [" ".join(words[1:])] if words else []
            continue
        if words == ["end_header"]:
            if form not in ("ascii", *BYTE_ORDERS):
                expected = "ascii, binary_little_endian or binary_big_endian"
                raise InputError(f"{path}: PLY header has the format {form or 'missing'!r}, expected {expected}")
            return Header(path, form, elements, file.tell(), origin, near, comments, by_rays)
        try:
            match words:
                case ["format", name, _]:
                    form = name
                case ["element", name, count] if int(count) >= 0:
                    elements.append(Element(name, int(count)))
                case ["property", "list", _, _, name]:
                    elements[-1].properties.append((name, ""))
                case ["property", kind, name]:
                    elements[-1].properties.append((name, TYPES[kind]))
                case _:
                    raise ValueError
        except (ValueError, KeyError, IndexError):
            raise InputError(
                f"{path}: PLY header has a line that is of no PLY header: {' '.join(words)[:80]!r}"
            ) from None
    raise InputError(f"{path}: PLY header is truncated or damaged (no line 'end_header')")


Block = dict[str, NDArray[Any]]


def read_vertices(file: BinaryIO, header: Header, what: str) -> Iterator[Block]:
    """Columns of the vertices by name, a block of rows at a time; `what` a vertex is, for messages.

    That the file has as many as its header says is checked before the first block, binary files to the byte and ascii
    ones as far as their length can tell, so that `count` rows may be allocated then. Raises InputError.
    """
    path, vertex = header.path, header.vertex
    names = [name for name, _ in vertex.properties]
    if double := next((name for name in names if names.count(name) > 1), None):
        raise InputError(f"{path}: PLY has the property {double} twice")
    if vertex.has_list:
        raise InputError(f"{path}: PLY has a list property in its vertices, expected numbers only")
    read = _ascii_blocks if header.format == "ascii" else _binary_blocks
    return read(file, header, what)


def _binary_blocks(file: BinaryIO, header: Header, what: str) -> Iterator[Block]:
    path, vertex = header.path, header.vertex
    for element in header.before:
        if element.has_list:
            raise InputError(f"{path}: PLY has lists (element {element.name!r}) before its vertices, not supported")
    start = header.start(len(header.before))
    row = header.row_type(vertex)
    need, have = vertex.count * row.itemsize, max(0, os.fstat(file.fileno()).st_size - start)
    if have < need:
        whole = have // row.itemsize
        raise InputError(
            f"{path}: truncated: {vertex.count} {what}s need {need} bytes, {have} are there ({whole} {what}s)"
        )
    if have > need and header.elements[-1] is vertex:
        warn(f"{path}: {have - need} bytes after the last {what} ignored")
    file.seek(start)
    block = min(BLOCK_ROWS, max(MAX_BLOCK_BYTES // max(row.itemsize, 1), 1))
    for first in range(0, vertex.count, block):
        count = min(block, vertex.count - first)
        rows = values.read_rows(file, row, count, path)
        yield {name: rows[name] for name, _ in vertex.properties}


def _text_lines(file: BinaryIO, path: Path) -> Iterator[bytes]:
    """Lines that are not empty. Raises InputError for one too long to be a row."""
    while line := file.readline(MAX_LINE_BYTES + 1):
        if len(line) > MAX_LINE_BYTES:
            raise InputError(f"{path}: has a line of more than {MAX_LINE_BYTES} bytes, expected rows of numbers")
        if not line.isspace():
            yield line


def _spelt(words: list[bytes], where: str) -> list[float]:
    """The numbers of a row, some of which are not finite in the words of Microsoft's C. Raises InputError, which begins
    with `where`."""
    found = []
    for word in words:
        text = word.decode("ascii", "replace")
        try:
            found.append(np.nan if _NAN.fullmatch(text) else float(_INFINITE.sub(r"\1inf", text)))
        except ValueError:
            raise InputError(f"{where} has {text[:40]!r}, expected a number") from None
    return found


def _ascii_blocks(file: BinaryIO, header: Header, what: str) -> Iterator[Block]:
    """float64. A row is at least a character and a blank for each property."""
    path, vertex = header.path, header.vertex
    lines = _text_lines(file, path)
    least, have = 2 * vertex.count * len(vertex.properties) - 1, os.fstat(file.fileno()).st_size - header.size
    too_many = have < least
    for element in header.before:
        for _ in islice(lines, element.count):
            pass
    width = len(vertex.properties)
    block = min(BLOCK_ROWS, max(MAX_BLOCK_WORDS // max(width, 1), 1))
    for first in range(0, vertex.count, block):
        count = min(block, vertex.count - first)
        rows = [line.split() for line in islice(lines, count)]
        for index, words in enumerate(rows):
            if len(words) != width:
                raise InputError(f"{path}: {what} {first + index} has {len(words)} values, expected {width}")
            if max(map(len, words), default=0) > MAX_NUMBER_BYTES:
                raise InputError(f"{path}: {what} {first + index} has a value that is no number")
        if len(rows) < count:
            raise InputError(f"{path}: truncated: {vertex.count} {what}s expected, {first + len(rows)} are there")
        if too_many:
            raise InputError(f"{path}: truncated: {vertex.count} {what}s expected, {have} bytes are too few for them")
        try:
            table = np.array(rows, dtype="S").astype(np.float64).reshape(count, width)
        except ValueError:
            table = np.array([_spelt(words, f"{path}: {what} {first + at}") for at, words in enumerate(rows)])
        yield {name: table[:, index] for index, (name, _) in enumerate(vertex.properties)}
    if header.elements[-1] is vertex and next(lines, None) is not None:
        warn(f"{path}: text after the last {what} ignored")
