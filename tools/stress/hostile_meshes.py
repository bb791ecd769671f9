# SPDX-License-Identifier: Apache-2.0
"""Meshes among the hostile files (`hostile.py`): a cube as an OBJ file and as a USD stage, and how they are read."""

from __future__ import annotations

from pathlib import Path

import numpy as np

from clsplat.models.mesh import read_mesh

CORNERS = [(x, y, z) for z in (-1, 1) for y in (-1, 1) for x in (-1, 1)]
SIDES = ((0, 2, 3, 1), (4, 5, 7, 6), (0, 1, 5, 4), (2, 6, 7, 3), (0, 4, 6, 2), (1, 3, 7, 5))


def make_obj(folder: Path) -> None:
    """Write mesh.obj, a cube with normals. Half of its faces count points from the first, the others from the last."""
    lines = ["# a cube", "mtllib none.mtl", "o cube", *(f"v {x} {y} {z}" for x, y, z in CORNERS), "vn 0 0 1"]
    lines += ["f " + " ".join(f"{corner + 1}//1" for corner in side) for side in SIDES[:3]]
    lines += ["f " + " ".join(str(corner - 8) for corner in side) for side in SIDES[3:]]
    (folder / "mesh.obj").write_text("\n".join([*lines, ""]))


def make_usd_mesh(folder: Path, name: str) -> None:
    """Write the cube of `make_obj` as a USD stage, moved by a transform with values at two times."""
    from pxr import Gf, Usd, UsdGeom

    stage = Usd.Stage.CreateNew(str(folder / name))
    place = UsdGeom.Xform.Define(stage, "/Place")
    shift = place.AddTranslateOp()
    for time in (1, 5):
        shift.Set(Gf.Vec3d(time, 0, 0), time)
    mesh = UsdGeom.Mesh.Define(stage, "/Place/Cube")
    mesh.CreatePointsAttr(CORNERS)
    mesh.CreateFaceVertexCountsAttr([4] * 6)
    mesh.CreateFaceVertexIndicesAttr([corner for side in SIDES for corner in side])
    stage.GetRootLayer().Save()


def read_volume(path: Path) -> None:
    """Read a mesh like the volume of a matte, and test which points are inside it."""
    mesh = read_mesh(path)
    mesh.holds(np.random.default_rng(4).uniform(-2, 2, (20, 3)))
