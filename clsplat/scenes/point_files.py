# SPDX-License-Identifier: Apache-2.0
"""Reading of point clouds (PLY, LAS and LAZ), and search for the clouds that other programs store with a scene."""

from __future__ import annotations

from collections.abc import Iterable
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import NDArray

from clsplat.arrays import Float32, Float64
from clsplat.errors import InputError, warn
from clsplat.files.documents import is_file, open_input
from clsplat.images.reading import one_line
from clsplat.models.codec import ply_file
from clsplat.models.codec.values import colours, full_scale
from clsplat.models.formats.ply import DC_PROPERTIES

PLY_COLOUR_PROPERTIES = (
    ("red", "green", "blue"),
    ("r", "g", "b"),
    ("diffuse_red", "diffuse_green", "diffuse_blue"),
    ("scalar_red", "scalar_green", "scalar_blue"),
    ("color_red", "color_green", "color_blue"),
)
"""Possible names of a PLY's colour properties, in upper or lower case. The first set that is present is used."""
UNCOLOURED_GREY = 0.5
"""Grey value of points from a file without colours."""
LAS_EXTENSIONS = (".las", ".laz")
START_CLOUD_NAMES = ("points3d.ply", "sparse_pc.ply", "init.ply", "point_cloud.ply", "pointcloud.ply", "points.ply")
"""Names of clouds from which other programs start training by default, in lower case, in order of precedence.

The programs are the 3DGS authors' code, nerfstudio, Brush and others.
"""


@dataclass(frozen=True, eq=False)
class Cloud:
    """A point cloud.

    points: (N, 3) float64, world coordinates.
    colors: (N, 3) float32 in [0, 1], None if the file has none.
    """

    points: Float64
    colors: Float32 | None


def clouds_beside(folders: Iterable[Path]) -> list[Path]:
    """Return the files with a name of START_CLOUD_NAMES in these folders, in the order of names, then of folders."""
    found = [path for folder in dict.fromkeys(folders) if folder.is_dir() for path in sorted(folder.iterdir())]
    named = [path for path in found if path.name.lower() in START_CLOUD_NAMES and is_file(path)]
    return sorted(named, key=lambda path: START_CLOUD_NAMES.index(path.name.lower()))


def read_cloud(path: Path) -> Cloud:
    """Read a point cloud from a PLY (ascii or binary, points or Gaussians), LAS or LAZ.

    Raises InputError for other files and for files without points.
    """
    if path.suffix.lower() in LAS_EXTENSIONS:
        cloud = _read_las(path)
    else:
        with open_input(path, "a cloud of points") as file:
            head = file.read(4)
        if head == b"LASF":
            cloud = _read_las(path)
        elif not head.startswith(b"ply"):
            raise InputError(f"{path}: is not a PLY, LAS or LAZ, expected a point cloud in one of these formats")
        else:
            points, colors = read_point_cloud(path)
            cloud = Cloud(points, None if of_one_colour(colors) else colors)
    if len(cloud.points) == 0:
        raise InputError(f"{path}: holds no points, expected at least one")
    return cloud


def of_one_colour(colors: Float32) -> bool:
    """Return True if there are several colours (N, 3) and all are equal, as for points from a file without colours."""
    return len(colors) > 1 and bool((colors == colors[0]).all())


def point_colours(levels: NDArray[Any]) -> Float32:
    """Convert stored colours (N, 3) to [0, 1]. `full_scale` infers the white level, such as 255, from their range."""
    colors: Float32 = np.clip(np.asarray(levels, np.float32) / np.float32(full_scale(levels)), 0, 1)
    return colors


def count_points(path: Path) -> int:
    """Return the number of points that a PLY's header gives. Raises InputError for other files."""
    with open_input(path, "a PLY of points") as file:
        return ply_file.read_header(file, path).vertex.count


def read_point_cloud(path: Path) -> tuple[Float64, Float32]:
    """Read positions (N, 3) float64 and colours (N, 3) float32 in [0, 1] of a PLY; grey if it has no colours.

    Colours of a 3DGS model come from SH coefficient 0. Points that are not finite are left out, with a warning. Raises
    InputError if the file is not a PLY, is truncated, has no x, y or z, or only points that are not finite.
    """
    with open_input(path, "a PLY of points") as file:
        header = ply_file.read_header(file, path)
        vertex = header.elements[0] if header.elements else None
        if vertex is None or vertex.name != "vertex" or vertex.has_list:
            raise InputError(f"{path}: its first element is not 'vertex' with numbers only, expected a point cloud")
        kinds = dict(vertex.properties)
        if missing := [name for name in "xyz" if name not in kinds]:
            raise InputError(f"{path}: PLY has no property {missing[0]!r}, expected x, y and z")
        lower = {name.lower(): name for name in kinds}
        named = next(
            (names for names in (*PLY_COLOUR_PROPERTIES, DC_PROPERTIES) if all(name in lower for name in names)), None
        )
        coloured = named and tuple(lower[name] for name in named)
        parts: list[tuple[NDArray[Any], NDArray[Any]]] = [(np.empty((0, 3)), np.empty((0, 3), np.float32))]
        for block in ply_file.read_vertices(file, header, "point"):
            points = np.stack([block[name] for name in "xyz"], axis=1).astype(np.float64)
            levels: NDArray[Any] = np.full(points.shape, UNCOLOURED_GREY, np.float32)
            if coloured:
                with np.errstate(over="ignore"):  # a double beyond float32 becomes inf, and is left out below
                    levels = np.stack([block[name] for name in coloured], axis=1).astype(np.float32)
            parts.append((points, levels))
    points, levels = (np.concatenate(arrays) for arrays in zip(*parts, strict=True))
    good = np.isfinite(points).all(axis=1) & np.isfinite(levels).all(axis=1)
    points, levels = points[good], levels[good]
    _warn_of_left_out(path, good)
    if not coloured:
        return points, levels
    if named == DC_PROPERTIES:
        return points, np.clip(colours(levels), 0, 1).astype(np.float32)
    stored = np.dtype(kinds[coloured[0]])  # float32 holds all values of 8 and 16 bits
    return points, point_colours(levels.astype(stored) if stored.kind in "iu" else levels)


def _read_las(path: Path) -> Cloud:
    """Read a LAS or LAZ file with laspy."""
    with open_input(path, "a cloud of points") as file:
        if file.read(4) != b"LASF":
            raise InputError(f"{path}: is not a LAS or LAZ file, although it has such an extension")
    try:
        import laspy
    except ImportError:
        raise InputError(f"{path}: reading LAS needs laspy; install it: pip install 'clsplat[las]'") from None
    try:
        las: Any = laspy.read(path)
        points = np.stack([np.asarray(las[axis], np.float64) for axis in "xyz"], axis=1)
        names = set(las.point_format.dimension_names)
        colors = None
        if {"red", "green", "blue"} <= names:
            levels = np.stack([np.asarray(las[name]) for name in ("red", "green", "blue")], axis=1)
            if levels.any() and not of_one_colour(levels):
                colors = point_colours(levels)
    except Exception as error:  # noqa: BLE001  # errors of laspy, struct and NumPy, and panics of LAZ's decoder
        why = one_line(f"{type(error).__name__}: {error}")
        raise InputError(f"{path}: does not read as LAS or LAZ ({why}); export it again") from None
    good = np.asarray(np.isfinite(points).all(axis=1))
    _warn_of_left_out(path, good)
    return Cloud(points[good], None if colors is None else colors[good])


def _warn_of_left_out(path: Path, good: NDArray[np.bool_]) -> None:
    """Warn of points that are not finite and are left out. Raises InputError if none remains.

    good: (N,), True for the points that are kept.
    """
    if good.all():
        return
    bad = int(np.count_nonzero(~good))
    found = f"{path}: {bad:,} of {len(good):,} points have values that are not finite"
    if bad == len(good):
        raise InputError(f"{found}, expected some finite points")
    warn(f"{found}, and are left out")
