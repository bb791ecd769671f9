# SPDX-License-Identifier: Apache-2.0
"""The 3DGS PLY: a PLY with a vertex for each Gaussian, as the paper's authors write it and every tool reads it.

https://github.com/graphdeco-inria/gaussian-splatting (scene/gaussian_model.py, save_ply).
Properties: x y z nx ny nz f_dc_0..2 f_rest_* opacity scale_0..2 rot_0..3. f_rest is channel-major: all higher
coefficients of red, then of green, then of blue. Files are streamed in blocks of rows, so reading or writing takes
little more than the model's own memory.

Every tool expects means in world coordinates. A model with an `origin` has means relative to it, and their conversion
rounds. So a second element stores the exact means, and a comment their origin. Other tools ignore both.
"""

from __future__ import annotations

import os
from collections.abc import Callable, Iterable, Iterator, Sequence
from dataclasses import replace
from functools import partial
from itertools import chain
from math import isqrt
from pathlib import Path
from typing import Any, BinaryIO

import numpy as np
from numpy.typing import NDArray

from clsplat.arrays import Float32, Float64
from clsplat.camera import DEFAULT_NEAR_PLANE
from clsplat.config.checks import misfit
from clsplat.errors import InputError, examples, warn
from clsplat.files.atomic import atomic_writer
from clsplat.files.documents import open_input
from clsplat.gaussians import MAX_SH_DEGREE, Gaussians
from clsplat.models.codec import values
from clsplat.models.codec.ply_file import (
    ALONG_RAYS_COMMENT,
    ANTIALIASED_COMMENT,
    NEAR_PLANE_COMMENT,
    ORIGIN_COMMENT,
    Block,
    Element,
    PlyHeader,
    read_header,
    read_vertices,
)
from clsplat.models.codec.repair import finite_rows, replace_infinities
from clsplat.models.codec.values import IO_BLOCK_ROWS
from clsplat.models.edit import take

__all__ = ["Element", "PlyHeader", "read_header", "read_vertices"]
"""Re-exported from `codec.ply_file` for readers of other PLYs."""

POSITION_PROPERTIES = ("x", "y", "z")
DC_PROPERTIES = ("f_dc_0", "f_dc_1", "f_dc_2")
SCALE_PROPERTIES = ("scale_0", "scale_1", "scale_2")
ROTATION_PROPERTIES = ("rot_0", "rot_1", "rot_2", "rot_3")
MIP_FILTER_PROPERTY = "filter_3D"
"""Property in Mip-Splatting's files: the filter size that Mip-Splatting's renderer adds to the scales."""
LOCAL_MEANS_ELEMENT = "clsplat_local"
"""Element of the PLY with the exact means, which are relative to the model's origin."""
RGB_PROPERTY_NAMES = (("red", "green", "blue"), ("r", "g", "b"), ("diffuse_red", "diffuse_green", "diffuse_blue"))
"""Names, in upper or lower case, of the colour properties that nerfstudio's exports and point files have in place of
f_dc."""
REQUIRED_PLY_PROPERTIES = (*POSITION_PROPERTIES, *DC_PROPERTIES, "opacity", *SCALE_PROPERTIES, *ROTATION_PROPERTIES)


def recognises(head: bytes) -> bool:
    """True for a PLY that is not a compressed PLY."""
    return head.startswith(b"ply") and b"packed_position" not in head.partition(b"end_header")[0]


def read(path: str | os.PathLike[str]) -> Gaussians:
    """Read a 3DGS PLY: ascii or binary of either byte order, properties in any order, of any numeric type.

    - The number of f_rest properties (0, 9, 24, 45) gives the SH degree, 0 to 3. Degree 4 (72) is cut, with a warning.
    - Gaussians without scale_2, as in 2DGS, are flat.
    - Colours named as in RGB_PROPERTY_NAMES may replace f_dc. Their range is guessed (`values.full_scale`).
    - Other properties are ignored, MIP_FILTER_PROPERTY with a warning. Bytes after the data cause a warning too.

    Raises InputError, a line that begins with the path, if the file is missing, truncated, not a PLY, lacks a property
    or has no Gaussians.
    """
    path = Path(path)
    with open_input(path, "a 3DGS PLY") as file:
        header = read_header(file, path)
        vertex = header.vertex
        rest = _check_properties(header)
        if MIP_FILTER_PROPERTY in dict(vertex.properties):
            warn(f"{path}: {MIP_FILTER_PROPERTY}, Mip-Splatting's filter, is ignored; fuse it into the scales first")
        if vertex.count == 0:
            raise InputError(f"{path}: has 0 Gaussians (element vertex 0), expected at least one")
        gaussians = _assemble(read_vertices(file, header, "Gaussian"), vertex.count, rest)
        _convert_colours(gaussians, vertex)
        if header.origin is not None:
            _subtract_origin(header.origin, gaussians, _local_means(file, header, 0, vertex.count), path)
        gaussians.near, gaussians.antialiased, gaussians.by_rays = header.near, header.is_antialiased(), header.by_rays
        return gaussians


def read_whole_numbers(path: Path, name: str) -> NDArray[np.int64]:
    """Read the values (n,) of the integer property `name` for all Gaussians that `repair.repaired` does not leave out.

    Raises InputError like `read`, and if the property is missing or has values that are not 32-bit integers.
    """
    with open_input(path, "a 3DGS PLY") as file:
        header = read_header(file, path)
        kinds = dict(header.vertex.properties)
        if name not in kinds:
            raise InputError(f"{path}: PLY has no property {name}, expected one of {', '.join(kinds)}")
        rest, columns = _check_properties(header), []
        for block in read_vertices(file, header, "Gaussian"):
            gaussians = values.empty(len(block["x"]), _degree(rest))
            _fill(gaussians, block, rest)
            replace_infinities(gaussians)
            columns.append(np.asarray(block[name], np.float64)[finite_rows(gaussians)])
    column = np.concatenate(columns)
    if not (np.abs(column) < 2**31).all() or (column != np.round(column)).any():
        raise InputError(f"{path}: the property {name} has values that are not whole numbers of 32 bits")
    return column.astype(np.int64)


def blocks(path: Path) -> Iterator[Gaussians]:
    """Yield the Gaussians in blocks of rows, in the file's order, with means in world coordinates.

    Each block has the file's `origin`, although its means are not relative to it. Non-finite values, and colours named
    as in RGB_PROPERTY_NAMES, are not converted. Raises InputError like `read`.
    """
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


def local_blocks(path: Path) -> Iterator[Gaussians]:
    """Yield the Gaussians in blocks of rows, in the file's order, with the exact means that `read` returns.

    The means of each block are relative to the block's `origin`. Non-finite values, and colours named as in
    RGB_PROPERTY_NAMES, are not converted. Raises InputError like `read`.
    """
    with open_input(path, "a 3DGS PLY") as file, open_input(path, "a 3DGS PLY") as of_means:
        header = read_header(file, path)
        rest, start = _check_properties(header), 0
        antialiased = header.is_antialiased()
        for block in read_vertices(file, header, "Gaussian") if header.vertex.count else ():
            gaussians = values.empty(len(block["x"]), _degree(rest))
            _fill(gaussians, block, rest)
            if header.origin is not None:
                local = _local_means(of_means, header, start, len(gaussians))
                _subtract_origin(header.origin, gaussians, local, path)
            start += len(gaussians)
            yield replace(gaussians, near=header.near, antialiased=antialiased, by_rays=header.by_rays)


def describe(path: Path) -> dict[str, Any]:
    """Details for `clsplat info`: encoding, comments, ignored properties, `near`, `antialiased`, `by_rays`."""
    with open_input(path, "a 3DGS PLY") as file:
        header = read_header(file, path)
    properties = header.vertex.properties
    known = {*REQUIRED_PLY_PROPERTIES, *_colour_names(header.vertex), "nx", "ny", "nz"}
    ignored = [name for name, _ in properties if name not in known and not name.startswith("f_rest_")]
    described = {"encoding": header.format, "comments": header.comments, "ignored": ignored, "near": header.near}
    return described | {"antialiased": header.is_antialiased(), "by_rays": header.by_rays}


def write(
    path: str | os.PathLike[str],
    gaussians: Gaussians,
    *,
    sh_degree: int | None = None,
    comments: Sequence[str] = (),
) -> None:
    """Write a binary little-endian 3DGS PLY of float32, atomically; equal Gaussians give equal bytes.

    sh_degree: degree up to which zero coefficients are added; by default the model's.
    comments: lines for the header, such as `colour.comment`.
    Raises ValueError for a degree lower than the model's, a comment that is not a line of ASCII, and invalid arrays
    (`Gaussians.check`). Raises InputError for non-finite values.
    """
    gaussians.check()
    write_rows(path, gaussians, len(gaussians), partial(_taken, gaussians), sh_degree=sh_degree, comments=comments)


def _taken(gaussians: Gaussians, start: int, stop: int) -> Gaussians:
    return take(gaussians, slice(start, stop))


def write_rows(
    path: str | os.PathLike[str],
    model: Gaussians,
    count: int,
    rows: Callable[[int, int], Gaussians],
    *,
    sh_degree: int | None = None,
    comments: Sequence[str] = (),
) -> None:
    """Write a model of `count` Gaussians like `write`, but with only some of them in memory at a time.

    model: Gaussians with the origin, near plane, SH degree and other properties of the whole model.
    rows: function that returns the Gaussians [start, stop).
    """
    slices = [(block.start, block.stop) for block in values.row_blocks(count, IO_BLOCK_ROWS)]
    write_blocks(
        path,
        model,
        count,
        lambda: (rows(start, stop) for start, stop in slices),
        sh_degree=sh_degree,
        comments=comments,
    )


def write_blocks(
    path: str | os.PathLike[str],
    model: Gaussians,
    count: int,
    blocks: Callable[[], Iterable[Gaussians]],
    *,
    sh_degree: int | None = None,
    comments: Sequence[str] = (),
) -> None:
    """Write a model of `count` Gaussians like `write_rows`, from blocks of rows of any size.

    model: Gaussians with the origin, near plane, SH degree and other properties of the whole model.
    blocks: function that returns all Gaussians of the model in blocks, in order. A second call returns the same.
    """
    check_comments(comments)
    degree = model.sh_degree if sh_degree is None else sh_degree
    if misfit(int, degree) or not model.sh_degree <= degree <= MAX_SH_DEGREE:
        raise ValueError(f"sh_degree is {degree}, expected {model.sh_degree} (the model's) to {MAX_SH_DEGREE}")
    stored, padded = model.sh.shape[1] - 1, (degree + 1) ** 2 - 1
    rest_names = [f"f_rest_{index}" for index in range(3 * padded)]
    names = [
        *POSITION_PROPERTIES,
        "nx",
        "ny",
        "nz",
        *DC_PROPERTIES,
        *rest_names,
        "opacity",
        *SCALE_PROPERTIES,
        *ROTATION_PROPERTIES,
    ]
    far, head = bool(model.origin.any()), _header(model, count, names, comments)
    first = 0
    with atomic_writer(path, len(head) + 4 * count * (len(names) + (3 if far else 0))) as file:
        file.write(head)
        for some in blocks():
            values.check_writable(Path(path), some, first=first)
            first += len(some)
            block = np.zeros((len(some), len(names)), "<f4")
            block[:, 0:3] = some.means + model.origin if far else some.means
            block[:, 6:9] = some.sh[:, 0]
            rest = block[:, 9 : 9 + 3 * padded].reshape(len(some), 3, padded)  # a view: the next line fills the block
            rest[:, :, :stored] = some.sh[:, 1:].transpose(0, 2, 1)
            block[:, -8] = some.opacity_logits
            block[:, -7:-4] = some.log_scales
            block[:, -4:] = some.quaternions
            file.write(block.data)
        for some in blocks() if far else ():
            file.write(np.ascontiguousarray(some.means, "<f4").data)


def _header(gaussians: Gaussians, count: int, names: Sequence[str], comments: Sequence[str]) -> bytes:
    """Header of a 3DGS PLY, up to and including `end_header`. names: names of a Gaussian's properties."""
    lines = ["ply", "format binary_little_endian 1.0", *(f"comment {line}" for line in comments)]
    far = bool(gaussians.origin.any())
    if far:
        lines.append(" ".join([*ORIGIN_COMMENT, *(repr(float(value)) for value in gaussians.origin)]))
    if gaussians.near != DEFAULT_NEAR_PLANE:
        lines.append(" ".join([*NEAR_PLANE_COMMENT, repr(float(gaussians.near))]))
    if gaussians.antialiased:
        lines.append(" ".join(ANTIALIASED_COMMENT))
    if gaussians.by_rays:
        lines.append(" ".join(ALONG_RAYS_COMMENT))
    lines += [f"element vertex {count}", *(f"property float {name}" for name in names)]
    if far:
        lines.append(f"element {LOCAL_MEANS_ELEMENT} {count}")
        lines += [f"property float {name}" for name in POSITION_PROPERTIES]
    return "\n".join([*lines, "end_header", ""]).encode("ascii")


def check_comments(comments: Sequence[str]) -> None:
    """Raise ValueError for a comment that is not a line of ASCII."""
    for line in comments:
        if not (line.isascii() and line.isprintable()):
            raise ValueError(f"comment is {line!r}, expected one line of ASCII")


def _local_means(file: BinaryIO, header: PlyHeader, first: int, count: int) -> Float32 | None:
    """Read `count` exact means (count, 3) from the element LOCAL_MEANS_ELEMENT, from row `first` on.

    Returns None if this element does not follow the vertices, and for an ascii file.
    Raises InputError if the file ends within the element.
    """
    wanted = Element(LOCAL_MEANS_ELEMENT, header.vertex.count, [(name, "f4") for name in POSITION_PROPERTIES])
    behind = len(header.before) + 1
    if header.format == "ascii" or header.elements[behind : behind + 1] != [wanted]:
        return None
    row = header.row_type(wanted)
    file.seek(header.start(behind) + first * row.itemsize)
    need = count * row.itemsize
    data = file.read(need)
    if len(data) != need:
        raise InputError(
            f"{header.path}: truncated: element {LOCAL_MEANS_ELEMENT} needs {need} bytes but has {len(data)}"
        )
    rows = np.frombuffer(data, row)
    return np.stack([rows[name] for name in POSITION_PROPERTIES], axis=1).astype(np.float32)


def _subtract_origin(origin: Float64, gaussians: Gaussians, local: Float32 | None, path: Path) -> None:
    """Make the means relative to `origin`, in place.

    local: exact means (n, 3) of the file; None if it has none. They are used for all vertices whose world coordinates
    still agree with them. Other tools may have moved the rest.
    """
    world = gaussians.means.astype(np.float64)
    with np.errstate(invalid="ignore", over="ignore"):
        means = (world - origin).astype(np.float32)
        if local is not None:
            means = np.where((local + origin).astype(np.float32) == world, local, means)
    if not np.isfinite(means[np.isfinite(world)]).all():
        raise InputError(f"{path}: the origin in the comment, {origin}, gives means that are not finite")
    gaussians.origin, gaussians.means = origin, np.ascontiguousarray(means)


def _check_properties(header: PlyHeader) -> int:
    """Check the properties of the vertices. Returns the number of f_rest properties.

    Raises InputError if the properties are not those of a 3DGS model.
    """
    path, names = header.path, [name for name, _ in header.vertex.properties]
    missing = [name for name in REQUIRED_PLY_PROPERTIES if name not in names and name != SCALE_PROPERTIES[2]]
    if _colour_names(header.vertex) != DC_PROPERTIES:
        missing = [name for name in missing if name not in DC_PROPERTIES]
    if missing:
        noun = "property" if len(missing) == 1 else "properties"
        colours = (
            f" with {DC_PROPERTIES[0]} to {DC_PROPERTIES[-1][-1]}, or {' '.join(RGB_PROPERTY_NAMES[0])}"
            if {*DC_PROPERTIES} <= {*missing}
            else ""
        )
        raise InputError(f"{path}: PLY lacks the {noun} {examples(missing)}, expected a 3DGS model{colours}")
    rest = sum(name.startswith("f_rest_") for name in names)
    counts = [3 * (degree * (degree + 2)) for degree in range(MAX_SH_DEGREE + 2)]
    if rest not in counts:
        raise InputError(f"{path}: PLY has {rest} f_rest properties, expected {', '.join(map(str, counts))} (SH)")
    for index in range(rest):
        if f"f_rest_{index}" not in names:
            raise InputError(f"{path}: PLY lacks the property f_rest_{index}, expected f_rest_0 to {rest - 1}")
    if rest == counts[-1]:
        left_out = f"has SH of degree {MAX_SH_DEGREE + 1}; coefficients above degree {MAX_SH_DEGREE} are left out"
        warn(f"{path}: {left_out}")
    return rest


def _degree(rest: int) -> int:
    """SH degree to read from a file with `rest` f_rest properties."""
    return min(isqrt(1 + rest // 3) - 1, MAX_SH_DEGREE)


def _colour_names(vertex: Element) -> tuple[str, ...]:
    """Names of the colour properties: f_dc, or names in RGB_PROPERTY_NAMES if the file has these instead of f_dc."""
    names = [name for name, _ in vertex.properties]
    return _rgb_names(names) or DC_PROPERTIES if set(DC_PROPERTIES).isdisjoint(names) else DC_PROPERTIES


def _rgb_names(names: Iterable[str]) -> tuple[str, ...]:
    """The three of `names` that match an entry of RGB_PROPERTY_NAMES, in the file's spelling; empty if none match."""
    own = {name.lower(): name for name in names}
    return next((tuple(own[name] for name in rgb) for rgb in RGB_PROPERTY_NAMES if own.keys() >= {*rgb}), ())


def _convert_colours(gaussians: Gaussians, vertex: Element) -> None:
    """Convert the colours in `gaussians.sh` to SH coefficients if the file has RGB colours instead of f_dc.

    vertex: the file's element of vertices.
    """
    if (names := _colour_names(vertex)) != DC_PROPERTIES:
        kinds = {np.dtype(kind) for name, kind in vertex.properties if name in names}
        whole = all(kind.kind in "iu" for kind in kinds)
        levels = gaussians.sh[:, 0]
        finite = levels[np.isfinite(levels)]  # an ascii file may have non-finite values in an integer property
        kind = np.dtype("u1") if kinds == {np.dtype("u1")} else np.dtype("i8")
        with np.errstate(invalid="ignore"):  # numbers may not fit the integer type
            white = values.full_scale(finite.astype(kind) if whole else finite)
        gaussians.sh[:, 0] = values.coefficients(levels / white)


def _columns(gaussians: Gaussians, rest: int) -> dict[str, NDArray[Any]]:
    """Views of the model's arrays by the names of the PLY properties. rest: number of f_rest properties."""
    columns: dict[str, NDArray[Any]] = {"opacity": gaussians.opacity_logits}
    arrays = (gaussians.means, gaussians.log_scales, gaussians.quaternions, gaussians.sh[:, 0])
    for names, array in zip(
        (POSITION_PROPERTIES, SCALE_PROPERTIES, ROTATION_PROPERTIES, DC_PROPERTIES), arrays, strict=True
    ):
        columns |= {name: array[:, index] for index, name in enumerate(names)}
    for channel in range(3):
        for index in range(1, gaussians.sh.shape[1]):
            columns[f"f_rest_{channel * (rest // 3) + index - 1}"] = gaussians.sh[:, index, channel]
    return columns


def _fill(gaussians: Gaussians, block: Block, rest: int) -> None:
    """Copy a block of a PLY's rows into `gaussians`, which has a row for each. Doubles beyond float32 become infinite.

    rest: number of f_rest properties.
    """
    with np.errstate(over="ignore", invalid="ignore"):
        for name, column in _columns(gaussians, rest).items():
            if name in block:
                column[:] = block[name]
    if SCALE_PROPERTIES[2] not in block:  # 2DGS: flat Gaussians
        gaussians.log_scales[:, 2] = np.log(values.MIN_SCALE)
    if DC_PROPERTIES[0] not in block:
        gaussians.sh[:, 0] = np.stack([block[name] for name in _rgb_names(block)], axis=1)


def _assemble(blocks: Iterator[Block], count: int, rest: int) -> Gaussians:
    """Copy blocks of a PLY's rows into one model of `count` Gaussians. rest: number of f_rest properties."""
    first = next(blocks)  # reading the first block checks that the file has `count` rows
    result = values.empty(count, _degree(rest))
    start = 0
    for block in chain([first], blocks):
        stop = start + len(block["x"])
        _fill(take(result, slice(start, stop)), block, rest)
        start = stop
    return result
