# SPDX-License-Identifier: Apache-2.0
"""Triangle meshes from OBJ files and USD stages, as volumes that select the Gaussians inside."""

from __future__ import annotations

import math
from dataclasses import dataclass
from functools import partial
from itertools import pairwise
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import NDArray

from clsplat.arrays import Float64
from clsplat.errors import InputError
from clsplat.files.documents import open_input
from clsplat.models.formats.usd import USD_SUFFIXES, open_stage, readable, survive

MAX_MESH_TRIANGLES = 100_000
"""Largest number of triangles of a mesh, because each is tested against every Gaussian in the bounding box."""
MAX_MESH_POINTS = 1_000_000
"""Largest number of points in a file, also of points that no triangle uses."""
MAX_MESH_FILE_BYTES = 256 << 20
_MAX_OBJ_LINE_BYTES = 1 << 16
_MAX_POINT_TRIANGLE_PAIRS = 1 << 21
"""Largest number of point-triangle pairs that are processed at once."""


@dataclass(frozen=True, eq=False)
class Mesh:
    """Triangle mesh that bounds a volume.

    corners (T, 3, 3): float64, the three points of each triangle, counterclockwise from outside.
    """

    corners: Float64

    def holds(self, points: Float64) -> NDArray[np.bool_]:
        """Mask (n,), True for points (n, 3) inside the mesh.

        A point is inside if its generalised winding number exceeds 1/2 in magnitude (Jacobson et al. 2013). Small holes
        and reversed orientation do not matter.
        """
        inside = np.zeros(len(points), np.bool_)
        low, high = self.corners.min(axis=(0, 1)), self.corners.max(axis=(0, 1))
        (near,) = np.nonzero(((points >= low) & (points <= high)).all(axis=1))
        rows = max(_MAX_POINT_TRIANGLE_PAIRS // len(self.corners), 1)
        for first in range(0, len(near), rows):
            chosen = near[first : first + rows]
            inside[chosen] = np.abs(self._winding_numbers(points[chosen])) > 0.5
        return inside

    def _winding_numbers(self, points: Float64) -> Float64:
        """Winding numbers (n,) of the mesh around points (n, 3).

        A winding number is the solid angle of all triangles over 4 pi (Van Oosterom and Strackee 1983).
        """
        a, b, c = (self.corners[None, :, k] - points[:, None] for k in range(3))
        la, lb, lc = (np.linalg.norm(side, axis=2) for side in (a, b, c))
        triple = np.einsum("ijk,ijk->ij", a, np.cross(b, c))
        ab, bc, ca = (np.einsum("ijk,ijk->ij", p, q) for p, q in ((a, b), (b, c), (c, a)))
        halves = np.arctan2(triple, la * lb * lc + ab * lc + bc * la + ca * lb)
        return np.asarray(halves.sum(axis=1) / math.tau)


def read_mesh(path: Path) -> Mesh:
    """Read the mesh of an OBJ file, or all meshes of a USD stage at its start time, in world coordinates.

    Polygons become triangle fans. Raises InputError for another file type, an unreadable file, and a mesh with no
    triangles or too many.
    """
    extension = path.suffix.lower()
    if extension == ".obj":
        corners = _of_obj(path)
    elif extension in USD_SUFFIXES:
        survive(path, "clsplat.models.mesh:read_here")
        corners = read_here(path)
    else:
        raise InputError(f"{path}: is not a mesh, expected an .obj file or a USD stage")
    if not 1 <= len(corners) <= MAX_MESH_TRIANGLES:
        raise InputError(f"{path}: has {len(corners):,} triangles, expected 1 to {MAX_MESH_TRIANGLES:,}")
    if not np.isfinite(corners).all():
        raise InputError(f"{path}: has points that are not finite")
    return Mesh(corners)


def _of_obj(path: Path) -> Float64:
    points: list[list[float]] = []
    polygons: list[list[int]] = []
    count = 0
    with open_input(path, "a mesh") as file:
        if (size := path.stat().st_size) > MAX_MESH_FILE_BYTES:
            raise InputError(f"{path}: has {size:,} bytes, expected a mesh of at most {MAX_MESH_FILE_BYTES:,}")
        for number, line in enumerate(iter(partial(file.readline, _MAX_OBJ_LINE_BYTES), b""), 1):
            words = line.split()
            try:
                if words[:1] == [b"v"]:
                    points.append([float(word) for word in words[1:4]])
                elif words[:1] == [b"f"]:
                    indices = [int(word.partition(b"/")[0]) for word in words[1:]]
                    polygons.append([index - 1 if index > 0 else len(points) + index for index in indices])
                    count += max(len(indices) - 2, 0)
                ragged = len(line) == _MAX_OBJ_LINE_BYTES or (words[:1] == [b"v"] and len(points[-1]) < 3)
            except ValueError:
                ragged = True
            if ragged:
                raise InputError(
                    f"{path}: line {number} is {str(line[:40])[1:]}, expected numbers after the letter v or f"
                )
            _check_counts(path, len(points), max(count, len(polygons)))
    return _fans(path, np.array(points, np.float64).reshape(-1, 3), polygons)


def _check_counts(path: Path, points: int, triangles: int) -> None:
    """Raise InputError for more than MAX_MESH_TRIANGLES triangles or MAX_MESH_POINTS points."""
    if triangles > MAX_MESH_TRIANGLES:
        raise InputError(f"{path}: has {triangles:,} triangles or more, expected 1 to {MAX_MESH_TRIANGLES:,}")
    if points > MAX_MESH_POINTS:
        raise InputError(f"{path}: has {points:,} points or more, expected at most {MAX_MESH_POINTS:,}")


def read_here(path: Path) -> Float64:
    """Read the corners (T, 3, 3) of a USD stage's triangles in this process, which a damaged file may crash.

    `survive` calls this function in another process first.
    """
    from pxr import UsdGeom, UsdUtils

    delegate = UsdUtils.CoalescingDiagnosticDelegate()  # suppresses the messages that USD would print
    found = [np.empty((0, 3, 3))]
    stage = open_stage(path, path)
    with readable(path):
        places = UsdGeom.XformCache(stage.GetStartTimeCode())
        for prim in stage.Traverse():
            if prim.IsA(UsdGeom.Mesh):
                matrix = np.array(places.GetLocalToWorldTransform(prim), np.float64)
                found.append(_of_prim(path, UsdGeom.Mesh(prim), stage.GetStartTimeCode(), matrix))
    delegate.TakeUncoalescedDiagnostics()
    return np.concatenate(found)


def _of_prim(path: Path, mesh: Any, time: float, world_from_mesh: Float64) -> Float64:
    points, indices, counts = (
        attribute.Get(time) or []
        for attribute in (mesh.GetPointsAttr(), mesh.GetFaceVertexIndicesAttr(), mesh.GetFaceVertexCountsAttr())
    )
    _check_counts(path, len(points), max(len(counts), len(indices) - 2 * len(counts)))
    points = np.array(points, np.float64).reshape(-1, 3)
    points = points @ world_from_mesh[:3, :3] + world_from_mesh[3, :3]  # USD's matrices multiply row vectors
    indices, counts = list(indices), list(counts)
    ends = np.cumsum([0, *counts])
    if ends[-1] != len(indices):
        raise InputError(f"{path}: {mesh.GetPath()} has {len(indices):,} faceVertexIndices, expected {ends[-1]:,}")
    return _fans(path, points, [indices[begin:end] for begin, end in pairwise(ends)])


def _fans(path: Path, points: Float64, polygons: list[list[int]]) -> Float64:
    """Divide polygons into triangle fans. Returns the corners (T, 3, 3) of all triangles.

    polygons: for each polygon, the indices of its corners in `points` (n, 3).
    """
    fans = [(own[0], one, next_one) for own in polygons for one, next_one in pairwise(own[1:])]
    if fans and not 0 <= min(map(min, fans)) <= max(map(max, fans)) < len(points):
        raise InputError(f"{path}: has faces with indices beyond its {len(points):,} points; is it damaged?")
    return points[np.array(fans, np.int64).reshape(-1, 3)]
