# SPDX-License-Identifier: Apache-2.0
"""Meshes as volumes, against closed forms of what is inside."""

from __future__ import annotations

from pathlib import Path

import numpy as np
import pytest
from calls import complaint, refuses

from clsplat.errors import InputError
from clsplat.models.mesh import Mesh, read_mesh

CUBE = """# a cube from -1 to 1
v -1 -1 -1
v 1 -1 -1
v 1 1 -1
v -1 1 -1
v -1 -1 1
v 1 -1 1
v 1 1 1
v -1 1 1
vn 0 0 1
f 4//1 3//1 2//1 1//1
f 5 6 7 8
f 1/1/1 2/1/1 6/1/1 5/1/1
f 2 3 7 6
f -6 -5 -1 -2
f 4 1 5 8
"""
POINTS = np.random.default_rng(5).uniform(-1.6, 1.6, (4000, 3))


def written(folder: Path, text: str = CUBE, name: str = "cube.obj") -> Path:
    path = folder / name
    path.write_text(text)
    return path


def test_a_cube(tmp_path: Path) -> None:
    mesh = read_mesh(written(tmp_path))
    assert mesh.corners.shape == (12, 3, 3)
    wanted = (np.abs(POINTS) < 1).all(axis=1)
    assert 500 < wanted.sum() < 2000
    np.testing.assert_array_equal(mesh.holds(POINTS), wanted)
    np.testing.assert_array_equal(Mesh(mesh.corners[:, ::-1]).holds(POINTS), wanted)  # the other way around
    assert mesh.holds(np.empty((0, 3))).shape == (0,)


def test_a_shape_that_is_not_convex(tmp_path: Path) -> None:
    """Two cubes of one file, which do not touch, and one without a triangle of its twelve."""
    cube = read_mesh(written(tmp_path)).corners / 4
    there = cube + np.array([1.0, 0.5, 0])
    wanted = (np.abs(POINTS) < 0.25).all(axis=1) | (np.abs(POINTS - [1.0, 0.5, 0]) < 0.25).all(axis=1)
    np.testing.assert_array_equal(Mesh(np.concatenate([cube, there])).holds(POINTS), wanted)
    holed = Mesh(cube[1:]).holds(POINTS)
    middle = (np.abs(POINTS) < 0.1).all(axis=1)  # there the missing triangle is a twelfth of what is around
    assert middle.sum() > 0
    assert holed[middle].all()
    assert not holed[~(np.abs(POINTS) < 0.25).all(axis=1)].any()


@pytest.mark.needs("pxr")
def test_meshes_of_a_stage(tmp_path: Path) -> None:
    text = """#usda 1.0
def Xform "a"
{
    double3 xformOp:translate = (0.5, 0, 0)
    double3 xformOp:scale = (0.5, 1, 1)
    uniform token[] xformOpOrder = ["xformOp:translate", "xformOp:scale"]
    def Mesh "cube"
    {
        int[] faceVertexCounts = [4, 4, 4, 4, 4, 4]
        int[] faceVertexIndices = [3, 2, 1, 0, 4, 5, 6, 7, 0, 1, 5, 4, 1, 2, 6, 5, 2, 3, 7, 6, 3, 0, 4, 7]
        point3f[] points = [(-1, -1, -1), (1, -1, -1), (1, 1, -1), (-1, 1, -1),
                            (-1, -1, 1), (1, -1, 1), (1, 1, 1), (-1, 1, 1)]
    }
}
"""
    mesh = read_mesh(written(tmp_path, text, "cube.usda"))
    wanted = (np.abs((POINTS - [0.5, 0, 0]) / [0.5, 1, 1]) < 1).all(axis=1)
    np.testing.assert_array_equal(mesh.holds(POINTS), wanted)
    with pytest.raises(InputError, match=r"bad.usda: /a/cube has 24 faceVertexIndices, expected 25"):
        read_mesh(written(tmp_path, text.replace("[4, 4, 4, 4, 4, 4]", "[4, 4, 4, 4, 4, 5]"), "bad.usda"))


@pytest.mark.parametrize(
    ("text", "name", "message"),
    [
        ("", "a.obj", "has 0 triangles, expected 1 to 100,000"),
        ("v 0 0\n", "a.obj", "line 1 is 'v 0 0"),
        ("v 0 0 0\nf 1 a 2\n", "a.obj", "line 2 is 'f 1 a 2"),
        ("v 0 0 0\nv 1 0 0\nv 0 1 0\nf 1 2 4\n", "a.obj", "has faces with indices beyond its 3 points"),
        ("v 0 0 0\nv 1 0 0\nv 0 1 nan\nf 1 2 3\n", "a.obj", "has points that are not finite"),
        ("f " + "1 " * 40000, "a.obj", "line 1 is 'f 1 1"),
        (f"v 0 0 0\nf 1 1 {10**40}\n", "a.obj", "has faces with indices beyond its 1 points"),
        (CUBE, "a.stl", "is not a mesh, expected an .obj file or a USD stage"),
    ],
)
def test_wrong_meshes_are_one_line(text: str, name: str, message: str, tmp_path: Path) -> None:
    assert message in complaint(tmp_path / name, read_mesh, written(tmp_path, text, name))
    refuses(r"none.obj: no such file", read_mesh, tmp_path / "none.obj")


def test_a_file_of_holes(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    """8 GiB without an end of a line were read as one (`tools/stress/run files`); and other files too large."""
    with open(tmp_path / "a.obj", "wb") as file:
        file.truncate(1 << 33)
    refuses(r"a.obj: has 8,589,934,592 bytes, expected a mesh of at most 268,435,456", read_mesh, tmp_path / "a.obj")
    monkeypatch.setattr("clsplat.models.mesh.MAX_MESH_TRIANGLES", 6)
    for text, count in ((CUBE, 8), ("v 0 0 0\nf" + " 1" * 1002, 1000)):
        with pytest.raises(InputError, match=rf"t.obj: has {count:,} triangles or more, expected 1 to 6"):
            read_mesh(written(tmp_path, text, "t.obj"))
    monkeypatch.setattr("clsplat.models.mesh.MAX_MESH_POINTS", 3)
    refuses(r"b.obj: has 4 points or more, expected at most 3", read_mesh, written(tmp_path, CUBE, "b.obj"))
