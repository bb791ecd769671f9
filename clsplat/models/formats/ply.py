# SPDX-License-Identifier: Apache-2.0
"""The 3DGS model file: a PLY with one vertex per Gaussian, as the paper's authors write it and every tool reads it.

https://github.com/graphdeco-inria/gaussian-splatting (scene/gaussian_model.py, save_ply).
Properties: x y z nx ny nz f_dc_0..2 f_rest_* opacity scale_0..2 rot_0..3. f_rest is channel-major: all higher
coefficients of red, then of green, then of blue. Files are streamed in blocks of rows, so reading or writing takes
little more than the model's own memory.

Every tool expects means in world coordinates, so means relative to another origin are converted, which rounds them. The
exact means follow in a second element, with their origin in a comment. Other tools ignore both.
"""

from __future__ import annotations

import os
from collections.abc import Iterable, Iterator, Sequence
from dataclasses import replace
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
from clsplat.models.codec.soundness import finite_rows, mend
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
"""Element with the means relative to the origin."""
RGB_PROPERTY_NAMES = (("red", "green", "blue"), ("r", "g", "b"), ("diffuse_red", "diffuse_green", "diffuse_blue"))
"""Names, in upper or lower case, of colour properties that nerfstudio's exports and point files have instead of f_dc.
"""
REQUIRED_PLY_PROPERTIES = (*POSITION_PROPERTIES, *DC_PROPERTIES, "opacity", *SCALE_PROPERTIES, *ROTATION_PROPERTIES)


def recognises(head: bytes) -> bool:
    """True for a PLY that is not a compressed PLY."""
    return head.startswith(b"ply") and b"packed_position" not in head.partition(b"end_header")[0]


def read(path: str | os.PathLike[str]) -> Gaussians:
    """Read a 3DGS PLY: ascii or binary of either byte order, properties in any order, of any numeric type.

    - SH degree 0 to 3 by the number of f_rest properties (0, 9, 24, 45). Degree 4 (72) is cut to 3, with a
      warning.
    - Gaussians without scale_2, as 2DGS writes them, are flat.
    - Colours named as in RGB_PROPERTY_NAMES may replace f_dc; their values show their range (`values.full_scale`).
    - Other properties are ignored. MIP_FILTER_PROPERTY, and bytes after the data, give a warning.

    Raises InputError, one line with the path, if the file is missing, truncated, not a PLY, lacks a property or has no
    Gaussians.
    """
    path = Path(path)
    with open_input(path, "a 3DGS PLY") as file:
        header = read_header(file, path)
        vertex = header.vertex
        rest = _check_properties(header)
        if MIP_FILTER_PROPERTY in dict(vertex.properties):
            warn(f"{path}: {MIP_FILTER_PROPERTY}, mip-splatting's filter, is ignored; fuse it first")
        if vertex.count == 0:
            raise InputError(f"{path}: has 0 Gaussians (element vertex 0), expected at least one")
        gaussians = _assemble(read_vertices(file, header, "Gaussian"), vertex.count, rest)
        _take_colours(gaussians, vertex)
        if header.origin is not None:
            _count_from(header.origin, gaussians, _local_means(file, header), path)
        gaussians.near, gaussians.antialiased, gaussians.by_rays = header.near, header.is_antialiased(), header.by_rays
        return gaussians


def read_whole_numbers(path: Path, name: str) -> NDArray[np.int64]:
    """An integer property of each Gaussian, (n,), without the Gaussians that `soundness.sound` leaves out.

    Raises InputError like `read`, and for a property that is missing or has other values.
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
            mend(gaussians)
            columns.append(np.asarray(block[name], np.float64)[finite_rows(gaussians)])
    column = np.concatenate(columns)
    if not (np.abs(column) < 2**31).all() or (column != np.round(column)).any():
        raise InputError(f"{path}: the property {name} holds other values than whole numbers of 32 bits")
    return column.astype(np.int64)


def blocks(path: Path) -> Iterator[Gaussians]:
    """Gaussians in the file's order and in world coordinates, some rows at a time, each block with the file's origin.

    Non-finite values, and colours named as in RGB_PROPERTY_NAMES, are passed through. Raises InputError like `read`.
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


def describe(path: Path) -> dict[str, Any]:
    """The format's part of `clsplat info`: encoding, comments, ignored properties, `near`, `antialiased`, `by_rays`."""
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

    sh_degree: pad with zero coefficients up to this degree; the model's own by default.
    comments: lines for the header, such as `colour.comment`.
    Raises ValueError if the degree is lower than the model's, a comment is not a line of ASCII, or an array is not as
    `Gaussians` requires. Raises InputError for non-finite values.
    """
    check_comments(comments)
    values.check_writable(Path(path), gaussians)
    degree = gaussians.sh_degree if sh_degree is None else sh_degree
    if misfit(int, degree) or not gaussians.sh_degree <= degree <= MAX_SH_DEGREE:
        raise ValueError(f"sh_degree is {degree}, expected {gaussians.sh_degree} (the model's) to {MAX_SH_DEGREE}")
    stored, padded = gaussians.sh.shape[1] - 1, (degree + 1) ** 2 - 1
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
    far, count = bool(gaussians.origin.any()), len(gaussians)
    head = _header(gaussians, names, comments)
    with atomic_writer(path, len(head) + 4 * count * (len(names) + (3 if far else 0))) as file:
        file.write(head)
        for rows in values.row_blocks(count, IO_BLOCK_ROWS):
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


def _header(gaussians: Gaussians, names: Sequence[str], comments: Sequence[str]) -> bytes:
    """Header of a written file, including its last line. names: properties of a Gaussian."""
    lines = ["ply", "format binary_little_endian 1.0", *(f"comment {line}" for line in comments)]
    far, count = bool(gaussians.origin.any()), len(gaussians)
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


def _local_means(file: BinaryIO, header: PlyHeader) -> Float32 | None:
    """Means of the element LOCAL_MEANS_ELEMENT, if it follows the vertices directly. Raises InputError if it is
    truncated."""
    wanted = Element(LOCAL_MEANS_ELEMENT, header.vertex.count, [(name, "f4") for name in POSITION_PROPERTIES])
    behind = len(header.before) + 1
    if header.format == "ascii" or header.elements[behind : behind + 1] != [wanted]:
        return None
    file.seek(header.start(behind))
    row = header.row_type(wanted)
    need = wanted.count * row.itemsize
    data = file.read(need)
    if len(data) != need:
        raise InputError(
            f"{header.path}: truncated: element {LOCAL_MEANS_ELEMENT} needs {need} bytes but has {len(data)}"
        )
    rows = np.frombuffer(data, row)
    return np.stack([rows[name] for name in POSITION_PROPERTIES], axis=1).astype(np.float32)


def _count_from(origin: Float64, gaussians: Gaussians, local: Float32 | None, path: Path) -> None:
    """Make the means relative to the origin. Uses the exact means `local` where no tool has moved the vertex."""
    world = gaussians.means.astype(np.float64)
    with np.errstate(invalid="ignore", over="ignore"):
        means = (world - origin).astype(np.float32)
        if local is not None:
            means = np.where((local + origin).astype(np.float32) == world, local, means)
    if not np.isfinite(means[np.isfinite(world)]).all():
        raise InputError(f"{path}: the origin in the comment, {origin}, gives means that are not finite")
    gaussians.origin, gaussians.means = origin, np.ascontiguousarray(means)


def _check_properties(header: PlyHeader) -> int:
    """Number of f_rest properties. Raises InputError if the layout is not a 3DGS model's."""
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
    """SH degree that is read from a file with this number of f_rest properties."""
    return min(isqrt(1 + rest // 3) - 1, MAX_SH_DEGREE)


def _colour_names(vertex: Element) -> tuple[str, ...]:
    """Properties to read colours from: f_dc, unless the file lacks these and has colours by another name."""
    names = [name for name, _ in vertex.properties]
    return _rgb_names(names) or DC_PROPERTIES if set(DC_PROPERTIES).isdisjoint(names) else DC_PROPERTIES


def _rgb_names(names: Iterable[str]) -> tuple[str, ...]:
    """Properties among `names` that match an entry of RGB_PROPERTY_NAMES, as spelt in the file; empty if none does."""
    spelt = {name.lower(): name for name in names}
    return next((tuple(spelt[name] for name in rgb) for rgb in RGB_PROPERTY_NAMES if spelt.keys() >= {*rgb}), ())


def _take_colours(gaussians: Gaussians, vertex: Element) -> None:
    """Turn colours that were read in place of f_dc into SH coefficients."""
    if (names := _colour_names(vertex)) != DC_PROPERTIES:
        kinds = {np.dtype(kind) for name, kind in vertex.properties if name in names}
        whole = all(kind.kind in "iu" for kind in kinds)
        levels = gaussians.sh[:, 0]
        finite = levels[np.isfinite(levels)]  # ascii may have non-finite values for integers too
        kind = np.dtype("u1") if kinds == {np.dtype("u1")} else np.dtype("i8")
        with np.errstate(invalid="ignore"):  # numbers that do not fit the type
            white = values.full_scale(finite.astype(kind) if whole else finite)
        gaussians.sh[:, 0] = values.coefficients(levels / white)


def _columns(gaussians: Gaussians, rest: int) -> dict[str, NDArray[Any]]:
    """The part of the model's arrays into which each property is read, by the property's name."""
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
    """Write a block into a model of as many Gaussians. A double beyond the range of float32 becomes infinite."""
    with np.errstate(over="ignore", invalid="ignore"):
        for name, column in _columns(gaussians, rest).items():
            if name in block:
                column[:] = block[name]
    if SCALE_PROPERTIES[2] not in block:  # 2DGS: flat
        gaussians.log_scales[:, 2] = np.log(values.MIN_SCALE)
    if DC_PROPERTIES[0] not in block:
        gaussians.sh[:, 0] = np.stack([block[name] for name in _rgb_names(block)], axis=1)


def _assemble(blocks: Iterator[Block], count: int, rest: int) -> Gaussians:
    """Gather the blocks into one model."""
    first = next(blocks)  # before anything is allocated: the count of an ascii file is unchecked
    result = values.empty(count, _degree(rest))
    start = 0
    for block in chain([first], blocks):
        stop = start + len(block["x"])
        _fill(take(result, slice(start, stop)), block, rest)
        start = stop
    return result
