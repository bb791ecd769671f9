# SPDX-License-Identifier: Apache-2.0
"""Clouds of points in files: PLY, LAS and LAZ, and the names under which programs leave one beside a scene."""

from __future__ import annotations

from collections.abc import Iterable
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import NDArray

from clsplat.arrays import Float32, Float64
from clsplat.errors import InputError, warn
from clsplat.files import is_file, open_input
from clsplat.images.reading import one_line
from clsplat.models.codec import ply_file
from clsplat.models.codec.values import colours, full_scale
from clsplat.models.formats.ply import DC

COLOURS = (
    ("red", "green", "blue"),
    ("r", "g", "b"),
    ("diffuse_red", "diffuse_green", "diffuse_blue"),
    ("scalar_red", "scalar_green", "scalar_blue"),
    ("color_red", "color_green", "color_blue"),
)
"""Names of a PLY's colours, in any case; the first that are there count."""
UNCOLOURED = 0.5
"""Grey, of points in a file without colours."""
LAS = (".las", ".laz")
BESIDE = ("points3d.ply", "sparse_pc.ply", "init.ply", "point_cloud.ply", "pointcloud.ply", "points.ply")
"""Names of clouds that programs start from without being told of them, in lower case, in the order in which they are
taken: the 3DGS authors', nerfstudio's, Brush's, and others'."""


@dataclass(frozen=True, eq=False)
class Cloud:
    """points (N, 3) float64 in the world; colors (N, 3) float32 in [0, 1], None where the file has none."""

    points: Float64
    colors: Float32 | None


def clouds_beside(folders: Iterable[Path]) -> list[Path]:
    """The files in these folders that are called as clouds to start from are, by BESIDE, then by folder."""
    found = [path for folder in dict.fromkeys(folders) if folder.is_dir() for path in sorted(folder.iterdir())]
    named = [path for path in found if path.name.lower() in BESIDE and is_file(path)]
    return sorted(named, key=lambda path: BESIDE.index(path.name.lower()))


def read_cloud(path: Path) -> Cloud:
    """Read a PLY (ascii or binary, of points or of Gaussians), LAS or LAZ. Raises InputError for what is none, or has
    no points."""
    if path.suffix.lower() in LAS:
        cloud = _read_las(path)
    else:
        with open_input(path, "a cloud of points") as file:
            head = file.read(4)
        if head == b"LASF":
            cloud = _read_las(path)
        elif not head.startswith(b"ply"):
            raise InputError(f"{path}: begins as no PLY, LAS or LAZ, expected a cloud of points in one of these")
        else:
            points, colors = read_point_cloud(path)
            cloud = Cloud(points, None if of_one_colour(colors) else colors)
    if len(cloud.points) == 0:
        raise InputError(f"{path}: holds no points, expected at least one")
    return cloud


def of_one_colour(colors: Float32) -> bool:
    """True if several points (N, 3) have the same colour, as a file without colours is read."""
    return len(colors) > 1 and bool((colors == colors[0]).all())


def point_colours(levels: NDArray[Any]) -> Float32:
    """Colours (N, 3) in [0, 1] of stored ones, whose white follows from their values (`full_scale`)."""
    colors: Float32 = np.clip(np.asarray(levels, np.float32) / np.float32(full_scale(levels)), 0, 1)
    return colors


def count_points(path: Path) -> int:
    """The number of points that a PLY's header names. Raises InputError."""
    with open_input(path, "a PLY of points") as file:
        return ply_file.read_header(file, path).vertex.count


def read_point_cloud(path: Path) -> tuple[Float64, Float32]:
    """Positions (N, 3) float64 and colours (N, 3) float32 in [0, 1] of a PLY, grey where it has no colours.

    Of a 3DGS model colours are those of SH coefficient 0. Raises InputError for a file that is none, cut short, without
    x y z, or with positions or colours that are not finite.
    """
    with open_input(path, "a PLY of points") as file:
        header = ply_file.read_header(file, path)
        vertex = header.elements[0] if header.elements else None
        if vertex is None or vertex.name != "vertex" or vertex.has_list:
            raise InputError(f"{path}: begins with no plain vertices, expected a point cloud")
        kinds = dict(vertex.properties)
        if missing := [name for name in "xyz" if name not in kinds]:
            raise InputError(f"{path}: PLY has no property {missing[0]!r}, expected x, y and z")
        lower = {name.lower(): name for name in kinds}
        named = next((names for names in (*COLOURS, DC) if all(name in lower for name in names)), None)
        coloured = named and tuple(lower[name] for name in named)
        parts: list[tuple[NDArray[Any], NDArray[Any]]] = [(np.empty((0, 3)), np.empty((0, 3), np.float32))]
        for block in ply_file.read_vertices(file, header, "point"):
            points = np.stack([block[name] for name in "xyz"], axis=1).astype(np.float64)
            levels: NDArray[Any] = np.full(points.shape, UNCOLOURED, np.float32)
            if coloured:
                with np.errstate(over="ignore"):  # a double beyond float32 becomes inf, refused below
                    levels = np.stack([block[name] for name in coloured], axis=1).astype(np.float32)
            parts.append((points, levels))
    points, levels = (np.concatenate(arrays) for arrays in zip(*parts, strict=True))
    good = np.isfinite(points).all(axis=1) & np.isfinite(levels).all(axis=1)
    points, levels = points[good], levels[good]
    _warn_of_left_out(path, good)
    if not coloured:
        return points, levels
    if named == DC:
        return points, np.clip(colours(levels), 0, 1).astype(np.float32)
    stored = np.dtype(kinds[coloured[0]])  # floats hold all values of 8 and 16 bits
    return points, point_colours(levels.astype(stored) if stored.kind in "iu" else levels)


def _read_las(path: Path) -> Cloud:
    """A LAS or LAZ, through laspy."""
    with open_input(path, "a cloud of points") as file:
        if file.read(4) != b"LASF":
            raise InputError(f"{path}: begins as no LAS or LAZ, expected one by its name")
    try:
        import laspy
    except ImportError:
        raise InputError(f"{path}: LAS needs laspy, expected it installed: pip install 'clsplat[las]'") from None
    try:
        las: Any = laspy.read(path)
        points = np.stack([np.asarray(las[axis], np.float64) for axis in "xyz"], axis=1)
        names = set(las.point_format.dimension_names)
        colors = None
        if {"red", "green", "blue"} <= names:
            levels = np.stack([np.asarray(las[name]) for name in ("red", "green", "blue")], axis=1)
            if levels.any() and not of_one_colour(levels):
                colors = point_colours(levels)
    except Exception as error:  # noqa: BLE001  # laspy raises its own, those of struct and NumPy, and LAZ's decoder panics
        why = one_line(f"{type(error).__name__}: {error}")
        raise InputError(f"{path}: does not read as LAS or LAZ ({why}); export it again") from None
    good = np.asarray(np.isfinite(points).all(axis=1))
    _warn_of_left_out(path, good)
    return Cloud(points[good], None if colors is None else colors[good])


def _warn_of_left_out(path: Path, good: NDArray[np.bool_]) -> None:
    """Warn of points that are not finite. Raises InputError where all are such."""
    if good.all():
        return
    bad = int(np.count_nonzero(~good))
    found = f"{path}: {bad:,} of {len(good):,} points have a position or colour that is not finite"
    if bad == len(good):
        raise InputError(f"{found}, expected some that are")
    warn(f"{found}, and are left out")
