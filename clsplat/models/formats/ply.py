# SPDX-License-Identifier: Apache-2.0
"""The 3DGS model file: a PLY with one vertex a Gaussian, as the paper's authors wrote it and every tool reads it.

https://github.com/graphdeco-inria/gaussian-splatting (scene/gaussian_model.py, save_ply).
Properties: x y z nx ny nz f_dc_0..2 f_rest_* opacity scale_0..2 rot_0..3. f_rest is channel-major: all higher
coefficients of red, then of green, then of blue. Files are streamed in blocks of rows, so that reading or writing
costs the model's own memory and little more.

Means that count from elsewhere than the world's origin are written in the world, as every tool expects, which rounds
them; and once more as they are, in an element behind the vertices, with their origin in a comment. Other tools pass
over both.
"""

from __future__ import annotations

import os
from collections.abc import Iterator, Sequence
from dataclasses import dataclass, field, replace
from itertools import chain, islice
from math import isqrt
from pathlib import Path
from typing import Any, BinaryIO

import numpy as np
from numpy.typing import NDArray

from clsplat.arrays import Float32, Float64, numbers
from clsplat.camera import NEAR
from clsplat.config.checks import misfit
from clsplat.errors import InputError, examples, warn
from clsplat.files import atomic_writer, open_input
from clsplat.gaussians import MAX_SH_DEGREE, Gaussians
from clsplat.models.codec import values
from clsplat.models.codec.values import BLOCK_ROWS
from clsplat.models.edit import take

MAX_HEADER_LINES = 10_000
MAX_LINE_BYTES = 1 << 20
MAX_BLOCK_BYTES, MAX_BLOCK_WORDS = 1 << 26, 1 << 21
MAX_NUMBER_BYTES = 128
"""The longest number in text, as a row of them is made an array whose elements have the width of the widest."""

_TYPES = {"char": "i1", "uchar": "u1", "short": "i2", "ushort": "u2", "int": "i4", "uint": "u4", "float": "f4",
          "double": "f8"}  # fmt: skip
TYPES = _TYPES | {np.dtype(code).name: code for code in _TYPES.values()}
"""NumPy's types by PLY's names, of which newer ones, such as float32, are NumPy's."""
BYTE_ORDERS = {"binary_little_endian": "<", "binary_big_endian": ">"}

POSITION = ("x", "y", "z")
DC = ("f_dc_0", "f_dc_1", "f_dc_2")
SCALE = ("scale_0", "scale_1", "scale_2")
ROTATION = ("rot_0", "rot_1", "rot_2", "rot_3")
ORIGIN = ["comment", "clsplat", "origin"]
NEAR_PLANE = ["comment", "clsplat", "near"]
MIP = ["comment", "SplatRenderMode:", "mip"]
"""The comment of a model that is antialiased, in Brush's words. Some writers add the low-pass: mip-0.1."""
ALONG_RAYS = ["comment", "clsplat", "rays"]
"""The comment of a model that perspective cameras draw along rays."""
FILTER = "filter_3D"
"""Mip-splatting's property: what its renderer adds to the scales."""
LOCAL = "clsplat_local"
"""The element that has the means as they count from the origin."""
REQUIRED = (*POSITION, *DC, "opacity", *SCALE, *ROTATION)


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
    `end_header` included; origin: of the element LOCAL; near: the near plane, where it is not the usual one;
    antialiased, by_rays: as of `Gaussians`."""

    path: Path
    format: str
    elements: list[Element]
    size: int
    origin: Float64 | None = None
    near: float = NEAR
    comments: list[str] = field(default_factory=list)
    antialiased: bool = False
    by_rays: bool = False

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


def recognises(head: bytes) -> bool:
    """A PLY that is not the compressed one."""
    return head.startswith(b"ply") and b"packed_position" not in head.partition(b"end_header")[0]


def read(path: str | os.PathLike[str]) -> Gaussians:
    """Read a 3DGS PLY: ascii or binary of either byte order, properties in any order, of any numeric type.

    SH degree 0 to 3 by the number of f_rest properties (0, 9, 24, 45); of degree 4 (72) the fourth is left out, with a
    warning. Other properties are ignored; FILTER, and bytes after the data, give a warning. Raises InputError, one line
    with the path: not a PLY, truncated, a property missing, values that are not finite, no Gaussians, no such file.
    """
    path = Path(path)
    with open_input(path, "a 3DGS PLY") as file:
        header = read_header(file, path)
        vertex = header.vertex
        rest = _check_properties(header)
        if FILTER in dict(vertex.properties):
            warn(f"{path}: {FILTER}, mip-splatting's filter, is ignored; fuse it first")
        if vertex.count == 0:
            raise InputError(f"{path}: has 0 Gaussians (element vertex 0), expected at least one")
        gaussians = _assemble(read_vertices(file, header, "Gaussian"), vertex.count, rest, path)
        if header.origin is not None:
            _count_from(header.origin, gaussians, _local_means(file, header), path)
        gaussians.near, gaussians.antialiased, gaussians.by_rays = header.near, header.antialiased, header.by_rays
        return gaussians


def read_whole_numbers(path: Path, name: str) -> NDArray[np.int64]:
    """(n,): a property of each Gaussian that holds whole numbers. Raises InputError as `read`, and for a property that
    is not there or holds others."""
    with open_input(path, "a 3DGS PLY") as file:
        header = read_header(file, path)
        kinds = dict(header.vertex.properties)
        if name not in kinds:
            raise InputError(f"{path}: PLY has no property {name}, expected one of {', '.join(kinds)}")
        columns = [np.asarray(block[name], np.float64) for block in read_vertices(file, header, "Gaussian")]
    column = np.concatenate(columns)
    if not (np.abs(column) < 2**31).all() or (column != np.round(column)).any():
        raise InputError(f"{path}: the property {name} holds other values than whole numbers of 32 bits")
    return column.astype(np.int64)


def blocks(path: Path) -> Iterator[Gaussians]:
    """The Gaussians in the file's order, some rows at a time, in the world, each block with the file's origin; values
    that are not finite are passed on. Raises InputError as `read`."""
    with open_input(path, "a 3DGS PLY") as file:
        header = read_header(file, path)
        rest = _check_properties(header)
        origin = np.zeros(3) if header.origin is None else header.origin
        if header.vertex.count == 0:
            yield replace(values.empty(0, _degree(rest)), origin=origin)
        for block in read_vertices(file, header, "Gaussian") if header.vertex.count else ():
            gaussians = replace(values.empty(len(block["x"]), _degree(rest)), origin=origin)
            _fill(gaussians, block, rest)
            yield gaussians


def describe(path: Path) -> dict[str, Any]:
    """The format's part of `clsplat info`: encoding, comments, properties that are ignored, `near`, `antialiased`,
    `by_rays`."""
    known = {*REQUIRED, "nx", "ny", "nz"}
    with open_input(path, "a 3DGS PLY") as file:
        header = read_header(file, path)
    properties = header.vertex.properties
    ignored = [name for name, _ in properties if name not in known and not name.startswith("f_rest_")]
    described = {"encoding": header.format, "comments": header.comments, "ignored": ignored, "near": header.near}
    return described | {"antialiased": header.antialiased, "by_rays": header.by_rays}


def write(
    path: str | os.PathLike[str],
    gaussians: Gaussians,
    *,
    sh_degree: int | None = None,
    comments: Sequence[str] = (),
) -> None:
    """Write a binary little-endian 3DGS PLY of float32, atomically; the same Gaussians give the same bytes.

    sh_degree: pad with zero coefficients up to this degree; the model's own where it is not given. comments: lines of
    the header, such as `colour.comment`. Raises ValueError where the degree is lower than the model's, a comment is no
    line of ASCII, or an array is not as `Gaussians` says; InputError for values that are not finite.
    """
    check_comments(comments)
    values.check_writable(Path(path), gaussians)
    degree = gaussians.sh_degree if sh_degree is None else sh_degree
    if misfit(int, degree) or not gaussians.sh_degree <= degree <= MAX_SH_DEGREE:
        raise ValueError(f"sh_degree {degree}: expected {gaussians.sh_degree} (the model's) to {MAX_SH_DEGREE}")
    stored, padded = gaussians.sh.shape[1] - 1, (degree + 1) ** 2 - 1
    rest_names = [f"f_rest_{index}" for index in range(3 * padded)]
    names = [*POSITION, "nx", "ny", "nz", *DC, *rest_names, "opacity", *SCALE, *ROTATION]
    far, count = bool(gaussians.origin.any()), len(gaussians)
    lines = ["ply", "format binary_little_endian 1.0", *(f"comment {line}" for line in comments)]
    lines += [" ".join([*ORIGIN, *(repr(float(value)) for value in gaussians.origin)])] if far else []
    lines += [" ".join([*NEAR_PLANE, repr(float(gaussians.near))])] if gaussians.near != NEAR else []
    lines += [" ".join(MIP)] if gaussians.antialiased else []
    lines += [" ".join(ALONG_RAYS)] if gaussians.by_rays else []
    lines += [f"element vertex {count}", *(f"property float {name}" for name in names)]
    lines += [f"element {LOCAL} {count}", *(f"property float {name}" for name in POSITION)] if far else []
    lines += ["end_header", ""]
    head = "\n".join(lines).encode("ascii")
    with atomic_writer(path, len(head) + 4 * count * (len(names) + (3 if far else 0))) as file:
        file.write(head)
        for rows in values.row_blocks(count, BLOCK_ROWS):
            sh = gaussians.sh[rows]
            block = np.zeros((len(sh), len(names)), "<f4")
            block[:, 0:3] = gaussians.means[rows] + gaussians.origin if far else gaussians.means[rows]
            block[:, 6:9] = sh[:, 0]
            rest = block[:, 9 : 9 + 3 * padded].reshape(len(sh), 3, padded)  # a view
            rest[:, :, :stored] = sh[:, 1:].transpose(0, 2, 1)
            block[:, -8] = gaussians.opacity_logits[rows]
            block[:, -7:-4] = gaussians.log_scales[rows]
            block[:, -4:] = gaussians.quaternions[rows]
            file.write(block.data)
        if far:
            file.write(np.ascontiguousarray(gaussians.means, "<f4").data)


def check_comments(comments: Sequence[str]) -> None:
    """Raise ValueError for one that is no line of ASCII."""
    for line in comments:
        if not (line.isascii() and line.isprintable()):
            raise ValueError(f"comment {line!r}: expected one line of ASCII")


def read_header(file: BinaryIO, path: Path) -> Header:
    """Read the header and leave `file` at the first byte after it. Raises InputError."""
    if file.read(3) != b"ply" or file.readline(16).strip():
        raise InputError(f"{path}: not a PLY file (it does not begin with a line 'ply')")
    form = ""
    elements: list[Element] = []
    comments: list[str] = []
    origin, near, antialiased, by_rays = None, NEAR, False, False
    for _ in range(MAX_HEADER_LINES):
        line = file.readline(4096)
        if not line.endswith(b"\n"):
            break
        words = line.decode("ascii", "replace").split()
        if not words or words[0] in ("comment", "obj_info"):
            given = numbers(words[3:])  # none where the comment is not one of ours after all
            if words[:3] == ORIGIN:
                origin = given if len(given) == 3 and np.isfinite(given).all() else None
            if words[:3] == NEAR_PLANE:
                near = float(given[0]) if len(given) == 1 and 0 < given[0] < np.inf else NEAR
            antialiased |= words[:2] == MIP[:2] and "".join(words[2:3]).startswith(MIP[2])
            by_rays |= words == ALONG_RAYS
            comments += [" ".join(words[1:])] if words else []
            continue
        if words == ["end_header"]:
            if form not in ("ascii", *BYTE_ORDERS):
                expected = "ascii, binary_little_endian or binary_big_endian"
                raise InputError(f"{path}: PLY header has the format {form or 'missing'!r}, expected {expected}")
            return Header(path, form, elements, file.tell(), origin, near, comments, antialiased, by_rays)
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


def _local_means(file: BinaryIO, header: Header) -> Float32 | None:
    """The element LOCAL, if it is right behind the vertices. Raises InputError where it is cut."""
    wanted = Element(LOCAL, header.vertex.count, [(name, "f4") for name in POSITION])
    behind = len(header.before) + 1
    if header.format == "ascii" or header.elements[behind : behind + 1] != [wanted]:
        return None
    file.seek(header.start(behind))
    row = header.row_type(wanted)
    need = wanted.count * row.itemsize
    data = file.read(need)
    if len(data) != need:
        raise InputError(f"{header.path}: truncated: element {LOCAL} needs {need} bytes, {len(data)} are there")
    rows = np.frombuffer(data, row)
    return np.stack([rows[name] for name in POSITION], axis=1).astype(np.float32)


def _count_from(origin: Float64, gaussians: Gaussians, local: Float32 | None, path: Path) -> None:
    """Have the means count from the origin: as they were written, unless the vertices were moved since."""
    world = gaussians.means.astype(np.float64)
    with np.errstate(invalid="ignore", over="ignore"):
        means = (world - origin).astype(np.float32)
        if local is not None:
            means = np.where((local + origin).astype(np.float32) == world, local, means)
    if not np.isfinite(means).all():
        raise InputError(f"{path}: the origin in the comment, {origin}, leaves means that are not finite")
    gaussians.origin, gaussians.means = origin, np.ascontiguousarray(means)


def _check_properties(header: Header) -> int:
    """The number of f_rest properties. Raises InputError where the layout is not a 3DGS model's."""
    path, names = header.path, [name for name, _ in header.vertex.properties]
    missing = [name for name in REQUIRED if name not in names]
    if missing:
        noun = "property" if len(missing) == 1 else "properties"
        raise InputError(f"{path}: PLY lacks the {noun} {examples(missing)}, expected a 3DGS model")
    rest = sum(name.startswith("f_rest_") for name in names)
    counts = [3 * (degree * (degree + 2)) for degree in range(MAX_SH_DEGREE + 2)]
    if rest not in counts:
        raise InputError(f"{path}: PLY has {rest} f_rest properties, expected {', '.join(map(str, counts))} (SH)")
    for index in range(rest):
        if f"f_rest_{index}" not in names:
            raise InputError(f"{path}: PLY lacks the property f_rest_{index}, though it has {rest} of f_rest")
    if rest == counts[-1]:
        left_out = f"SH of degree {MAX_SH_DEGREE + 1} is left out, {MAX_SH_DEGREE} is the highest that is known"
        warn(f"{path}: {left_out}")
    return rest


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
        except ValueError as error:
            raise InputError(f"{path}: a value after {what} {first} is no number ({error})") from None
        yield {name: table[:, index] for index, (name, _) in enumerate(vertex.properties)}
    if header.elements[-1] is vertex and next(lines, None) is not None:
        warn(f"{path}: text after the last {what} ignored")


def _degree(rest: int) -> int:
    """The degree of SH that is kept of a file with so many f_rest properties."""
    return min(isqrt(1 + rest // 3) - 1, MAX_SH_DEGREE)


def _columns(gaussians: Gaussians, rest: int) -> dict[str, NDArray[Any]]:
    """The place in the arrays of each property that is kept."""
    columns: dict[str, NDArray[Any]] = {"opacity": gaussians.opacity_logits}
    arrays = (gaussians.means, gaussians.log_scales, gaussians.quaternions, gaussians.sh[:, 0])
    for names, array in zip((POSITION, SCALE, ROTATION, DC), arrays, strict=True):
        columns |= {name: array[:, index] for index, name in enumerate(names)}
    for channel in range(3):
        for index in range(1, gaussians.sh.shape[1]):
            columns[f"f_rest_{channel * (rest // 3) + index - 1}"] = gaussians.sh[:, index, channel]
    return columns


def _fill(gaussians: Gaussians, block: Block, rest: int) -> None:
    """Write a block into as many Gaussians. A double beyond float32 becomes infinite."""
    with np.errstate(over="ignore", invalid="ignore"):
        for name, column in _columns(gaussians, rest).items():
            column[:] = block[name]


def _assemble(blocks: Iterator[Block], count: int, rest: int, path: Path) -> Gaussians:
    """Gather the blocks and refuse values that are not finite."""
    first = next(blocks)  # before anything is allocated: an ascii file's count is only a claim
    result = values.empty(count, _degree(rest))
    start = 0
    for block in chain([first], blocks):
        stop = start + len(block["x"])
        _fill(take(result, slice(start, stop)), block, rest)
        start = stop
    if all(np.isfinite(array).all() for array in result.arrays().values()):
        return result
    bad = ~np.isfinite(result.means).all(axis=1)
    if bad.any():
        raise InputError(
            f"{path}: {bad.sum()} of {count} Gaussians have a position that is not finite, the first is {bad.argmax()}"
        )
    columns = _columns(result, rest).items()
    name, row = next(
        (name, (~np.isfinite(column)).argmax()) for name, column in columns if not np.isfinite(column).all()
    )
    raise InputError(f"{path}: {name} of Gaussian {row} is not finite")
