# SPDX-License-Identifier: Apache-2.0
"""Cameras of survey programs: the same scene in each format, far from the world's origin, and files that are wrong."""

from __future__ import annotations

from collections.abc import Callable
from pathlib import Path

import numpy as np
import pytest
import ring
import survey_files
from calls import refusal

from clsplat.scenes.loading import load_scene
from clsplat.scenes.scene import Scene
from clsplat.shots.read import photographed, read_shot

WRITERS: dict[str, Callable[[Path], object]] = {
    "opensfm": lambda folder: survey_files.write_opensfm(folder, survey_files.at(), offset=survey_files.UTM_OFFSET),
    "metashape": lambda folder: survey_files.write_metashape(
        folder, survey_files.at(), world_from_chunk=survey_files.chunk_at()
    ),
    "xmp": lambda folder: survey_files.write_xmp(folder, survey_files.at()),
}
POINTLESS = ("metashape", "xmp")
"""Formats without points."""


def colmap_scene(folder: Path) -> Scene:
    xyz, rgb = ring.points()
    ring.write_colmap(folder, posed=survey_files.at(), cloud=(xyz + survey_files.UTM_OFFSET, rgb))
    return load_scene(folder)


@pytest.mark.parametrize("kind", WRITERS)
def test_cameras_at_a_utm_origin_equal_colmaps(tmp_path: Path, kind: str) -> None:
    wanted = colmap_scene(tmp_path / "colmap")
    WRITERS[kind](tmp_path / kind)
    found = load_scene(tmp_path / kind)
    assert [view.name for view in found.views] == [view.name for view in wanted.views]
    assert [view.split for view in found.views] == [view.split for view in wanted.views]
    for view, other in zip(found.views, wanted.views, strict=True):
        # 1e-6 m of 5.4e6 m: float64 keeps 1e-9 there, float32 half a metre
        np.testing.assert_allclose(view.camera.position, other.camera.position, rtol=0, atol=1e-6)
        np.testing.assert_allclose(view.camera.rotation, other.camera.rotation, rtol=0, atol=1e-12)
        lens = [view.camera.fx, view.camera.fy, view.camera.cx, view.camera.cy]
        np.testing.assert_allclose(
            lens, [other.camera.fx, other.camera.fy, other.camera.cx, other.camera.cy], rtol=0, atol=1e-6
        )
    np.testing.assert_array_equal(found.origin, wanted.origin)
    if kind not in POINTLESS:
        np.testing.assert_allclose(found.points, wanted.points, rtol=0, atol=1e-9)
        np.testing.assert_allclose(found.point_colors, wanted.point_colors, rtol=0, atol=1e-6)


def test_a_missing_photograph_is_named(tmp_path: Path) -> None:
    survey_files.write_opensfm(tmp_path)
    (tmp_path / "images" / ring.NAMES[3]).unlink()
    scene = load_scene(tmp_path)
    assert scene.missing == (ring.NAMES[3],)
    assert any("lists 1 image(s) that are missing" in text for text in scene.warnings)


@pytest.mark.parametrize("axis", [0, 2])
def test_cameras_above_each_other_or_in_one_place_are_no_degrees(tmp_path: Path, axis: int) -> None:
    centres = np.zeros((ring.COUNT, 3))
    centres[:, axis] = np.linspace(0, 1, ring.COUNT) * (axis > 0)
    posed = [ring.moved(pose, centre) for pose, centre in zip(ring.poses(), centres, strict=True)]
    survey_files.write_opensfm(tmp_path, posed)
    assert len(load_scene(tmp_path).views) == ring.COUNT


def test_positions_in_degrees_are_refused(tmp_path: Path) -> None:
    centres = [
        np.array([11.5 + 1e-4 * x, 48.1 + 1e-4 * z, 500 - 10 * y]) for x, y, z in map(ring.centre_of, ring.poses())
    ]
    posed = [ring.moved(pose, centre) for pose, centre in zip(ring.poses(), centres, strict=True)]
    survey_files.write_opensfm(tmp_path, posed)
    told = refusal(lambda: load_scene(tmp_path))
    assert "look like degrees with heights in metres" in told
    assert "UTM" in told


def test_the_cameras_are_a_shot(tmp_path: Path) -> None:
    """For `render --cameras` and its lenses; without the photographs."""
    path = survey_files.write_opensfm(tmp_path, camera={"focal": 0.8, "k1": 0.1})
    for name in ring.NAMES:
        (tmp_path / "images" / name).unlink()
    for source in (path, tmp_path):
        shot = read_shot(source)
        assert [frame.name for frame in shot.frames] == ring.NAMES
        np.testing.assert_allclose(shot.frames[3].camera.rotation, ring.poses()[3][0], atol=1e-12)
        assert photographed(source)[0].lens.model == "OPENCV"
