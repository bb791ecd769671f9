# SPDX-License-Identifier: Apache-2.0
"""Clouds of points to start from, and the sky: reading, places that cannot be, thinning, colours."""

from __future__ import annotations

from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest
from calls import refuses
from needs import NEEDS
from tiny import DISTANCE, hidden_model, write_scene

from clsplat.config.points import StartPoints
from clsplat.errors import InputError
from clsplat.scenes.loading import load_scene
from clsplat.scenes.scene import Scene
from clsplat.scenes.start.initialise import from_scene
from clsplat.scenes.start.point_cloud import (
    Cloud,
    check_place,
    half_sphere,
    is_colourless,
    photographed,
    read_cloud,
    sky_points,
    thinned,
    with_points,
)

RNG = np.random.default_rng(5)


def write_ply(path: Path, points: np.ndarray, colors: np.ndarray | None = None, *, ascii_: bool = False) -> Path:
    """A PLY as COLMAP's fused.ply has them: normals too, colours of 8 bits."""
    kinds = [(name, "<f4") for name in ("x", "y", "z", "nx", "ny", "nz")]
    kinds += [(name, "u1") for name in ("red", "green", "blue")] if colors is not None else []
    rows = np.zeros(len(points), kinds)
    for axis, name in enumerate("xyz"):
        rows[name] = points[:, axis]
    if colors is not None:
        for channel, name in enumerate(("red", "green", "blue")):
            rows[name] = np.rint(255 * colors[:, channel])
    properties = [f"property {'uchar' if kind == 'u1' else 'float'} {name}" for name, kind in kinds]
    form = "ascii" if ascii_ else "binary_little_endian"
    header = ["ply", f"format {form} 1.0", f"element vertex {len(rows)}", *properties, "end_header"]
    body = rows.tobytes()
    if ascii_:
        body = "".join(" ".join(f"{value:.9g}" for value in row) + "\n" for row in rows.tolist()).encode()
    path.write_bytes(("\n".join(header) + "\n").encode() + body)
    return path


@pytest.fixture(scope="module")
def scene(tmp_path_factory: pytest.TempPathFactory) -> Scene:
    return load_scene(write_scene(tmp_path_factory.mktemp("cloud") / "tiny"))


@pytest.mark.parametrize("ascii_", [False, True])
@pytest.mark.parametrize("coloured", [False, True])
def test_a_ply_replaces_the_points(scene: Scene, tmp_path: Path, ascii_: bool, coloured: bool) -> None:
    points = RNG.normal(0, 0.5, (50, 3)).astype(np.float32)
    colors = RNG.integers(0, 256, (50, 3)) / 255
    path = write_ply(tmp_path / "fused.ply", points, colors if coloured else None, ascii_=ascii_)
    got = with_points(scene, StartPoints(str(path), limit=1000))
    np.testing.assert_allclose(got.points, points, rtol=1e-6)
    assert is_colourless(got) == (not coloured)
    if coloured:
        np.testing.assert_allclose(got.point_colors, colors, atol=1e-6)
    assert with_points(got, got.start) is got
    assert len(from_scene(got, 10, RNG)) == 50


def test_points_that_join_keep_their_colours(scene: Scene, tmp_path: Path) -> None:
    path = write_ply(tmp_path / "bare.ply", RNG.normal(0, 0.5, (30, 3)))
    got = with_points(scene, StartPoints(str(path), "join", 1000))
    own = len(scene.points)
    assert len(got.points) == own + 30
    assert got.colourless.tolist() == [False] * own + [True] * 30
    shaded = photographed(got, (0.0, 0.0, 0.0))
    np.testing.assert_array_equal(shaded[:own], scene.point_colors)
    assert np.ptp(shaded[own:], axis=0).max() > 0.05


def test_thinning_keeps_the_limit_and_the_means() -> None:
    points, colors = RNG.normal(0, 1, (5000, 3)), RNG.random((5000, 3)).astype(np.float32)
    cloud = Cloud(points, colors)
    for limit in (1, 7, 400, 4999):
        got = thinned(cloud, limit)
        assert 0.6 * limit <= len(got.points) <= limit
        again = thinned(cloud, limit)
        np.testing.assert_array_equal(got.points, again.points)
        np.testing.assert_array_equal(got.colors, again.colors)
    one = thinned(cloud, 1)
    np.testing.assert_allclose(one.points[0], points.mean(axis=0), atol=1e-9)
    np.testing.assert_allclose(one.colors[0], colors.mean(axis=0), atol=1e-6)
    assert thinned(cloud, 5000) is cloud
    same = Cloud(np.ones((9, 3)), None)
    assert len(thinned(same, 3).points) == 1
    flat = Cloud(points * [1, 1, 0] + [5e6, -4e6, 200], None)  # of a survey, in a plane
    assert 300 <= len(thinned(flat, 400).points) <= 400


@pytest.mark.parametrize(
    ("move", "said"),
    [
        (lambda points: points + np.array([500.0, 0, 0]), "% of its points lie in a training photograph"),
        (lambda points: points * [1, 1, -1] - [0, 0, 3 * DISTANCE], "% of its points"),
        (lambda points: 1000 * points, "from the cameras that see them"),
    ],
)
def test_a_cloud_elsewhere_is_one_error(scene: Scene, move: object, said: str) -> None:
    points = np.random.default_rng(2).normal(0, 0.5, (400, 3))
    check_place(points, scene, Path("fused.ply"))
    found = refuses(said, check_place, move(points), scene, Path("fused.ply"))
    assert "fused.ply" in found and "axes, scale and origin of the scene's cameras" in found


def test_files_that_are_none(tmp_path: Path) -> None:
    for name, content, said in (
        ("gone.ply", None, "no such file"),
        ("text.ply", b"hello", "is not a PLY, LAS or LAZ"),
        ("text.las", b"hello", "is not a LAS"),
        ("empty.ply", None, "holds no points"),
        ("cut.las", b"LASF" + bytes(40), "laspy" if not NEEDS["laspy"].is_there() else "does not read as LAS"),
    ):
        path = tmp_path / name
        if name == "empty.ply":
            write_ply(path, np.empty((0, 3)))
        elif content is not None:
            path.write_bytes(content)
        refuses(said, read_cloud, path)


def test_las_without_laspy_names_the_extra(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setitem(__import__("sys").modules, "laspy", None)
    path = tmp_path / "survey.laz"
    path.write_bytes(b"LASF" + bytes(400))
    refuses(r"pip install 'clsplat\[las\]'", read_cloud, path)


@pytest.mark.needs("laspy")
@pytest.mark.parametrize("name", ["survey.las", "survey.laz"])
@pytest.mark.parametrize("most", [255, 65535])
def test_las_and_laz(tmp_path: Path, name: str, most: int) -> None:
    import laspy

    points, levels = RNG.normal(4e5, 3, (200, 3)), RNG.integers(0, most + 1, (200, 3))
    levels[0] = most
    header = laspy.LasHeader(point_format=2, version="1.2")
    header.scales, header.offsets = np.full(3, 1e-4), np.full(3, 4e5)
    las = laspy.LasData(header)
    las.x, las.y, las.z = points.T
    las.red, las.green, las.blue = levels.T.astype(np.uint16)
    las.write(tmp_path / name)
    got = read_cloud(tmp_path / name)
    np.testing.assert_allclose(got.points, points, atol=1e-4)
    np.testing.assert_allclose(got.colors, levels / most, atol=1e-6)


def test_directions_of_the_sky_are_even() -> None:
    up = np.array([0.0, -0.6, 0.8])
    directions = half_sphere(2000, up)
    np.testing.assert_allclose(np.linalg.norm(directions, axis=1), 1)
    assert (directions @ up > 0).all()
    np.testing.assert_allclose(directions.mean(axis=0), up / 2, atol=0.01)


def test_the_sky_is_above_the_points(scene: Scene) -> None:
    low = np.abs(hidden_model(400).means) * [1, 0.5, 1] * RNG.choice([-1, 1], (400, 3)) + [0, 0.8, 0]  # y is down
    bare = replace(scene, points=low, point_colors=np.full((400, 3), 0.5, np.float32))
    points, colors = sky_points(bare, 300)
    assert 0 < len(points) <= 300
    assert colors.shape == points.shape
    middle = np.stack([view.camera.position for view in bare.train_views]).mean(axis=0)
    assert ((points - middle)[:, 1] < 0.1 * np.linalg.norm(points - middle, axis=1)).all()
    assert (np.linalg.norm(points - middle, axis=1) > 5 * scene.extent).all()
    joined = with_points(bare, StartPoints(sky=300))
    np.testing.assert_array_equal(joined.points[400:], points)
    with pytest.raises(InputError, match="--sky needs points to find the sky above them"):
        sky_points(replace(scene, points=np.empty((0, 3)), point_colors=np.empty((0, 3), np.float32)), 10)
