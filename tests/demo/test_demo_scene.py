# SPDX-License-Identifier: Apache-2.0
from __future__ import annotations

import numpy as np
import OpenImageIO as oiio
import pytest
from calls import refuses
from demo_photographs import baked_still_life

from clsplat.camera import Camera
from clsplat.capture.folder import CaptureFolder
from clsplat.demo import measured_view, ray_caster
from clsplat.demo import run as demo
from clsplat.shots.viewpoints import look_at


@pytest.fixture(scope="module")
def surfaces():
    return baked_still_life()


@pytest.mark.parametrize("name", ["photos", "scene", "run", "turntable"])
def test_a_folder_of_somebody_else_is_no_demos(tmp_path, name):
    (tmp_path / name).mkdir()
    (tmp_path / name / "mine.txt").write_text("mine")
    refuses(f"holds {name}, which the demo did not create .* choose another folder", demo.run_demo, tmp_path)
    assert [path.name for path in tmp_path.iterdir()] == [name]


def test_a_demos_folder_is_known_again(tmp_path):
    folder = CaptureFolder(tmp_path, "photos")
    demo.claim(folder, 30)
    (tmp_path / "run").mkdir()
    demo.claim(folder, 30)
    demo.claim(folder, 60)
    assert folder.asked()["iterations"] == 60


def test_a_capture_of_somebody_is_no_demos(tmp_path):
    folder = CaptureFolder(tmp_path, "photos")
    asked = {"input": ["/a/photos"], "iterations": 30}
    folder.claim(asked, "capture")
    (tmp_path / "run").mkdir()
    refuses("was made with input /a/photos, not with demo 40; choose another folder$", demo.claim, folder, 30)
    assert folder.asked() == asked


@pytest.mark.slow
def test_photos_are_whole_repeatable_and_hold_no_pose(tmp_path):
    heard = []
    for folder in ("one", "two"):
        ray_caster.write_photos(
            tmp_path / folder, count=2, width=64, height=48, progress=lambda text, part: heard.append((text, part))
        )
    names = sorted(path.name for path in (tmp_path / "one").iterdir())
    assert names == ["photo_000.jpg", "photo_001.jpg"]
    for name in names:
        assert (tmp_path / "one" / name).read_bytes() == (tmp_path / "two" / name).read_bytes()
    assert heard[-1] == ("taking photos", 1.0)
    spec = oiio.ImageInput.open(str(tmp_path / "one" / names[0])).spec()
    assert (spec.width, spec.height, spec.nchannels) == (64, 48, 3)
    assert not [attribute.name for attribute in spec.extra_attribs if attribute.name.startswith(("Exif", "GPS"))]


@pytest.mark.slow
def test_every_object_is_textured(surfaces):
    for surface in surfaces:
        rows, columns = surface.rows, surface.columns
        assert surface.texture.shape == (rows, columns, 3)
        assert np.isfinite(surface.texture).all() and surface.texture.min() >= 0
        # contrast within patches of 16 texels, not only from one end of the object to the other
        luma = surface.texture.mean(axis=2)[: rows // 16 * 16, : columns // 16 * 16]
        patches = luma.reshape(rows // 16, 16, columns // 16, 16)
        assert np.median(patches.std(axis=(1, 3))) > 0.01, type(surface).__name__


@pytest.mark.slow
@pytest.mark.parametrize("index", range(6))
def test_rays_meet_the_surface_where_its_texture_says(surfaces, index):
    surface = surfaces[index]
    points, normals = surface.grid(12, 30)
    np.testing.assert_allclose(np.linalg.norm(normals, axis=1), 1, atol=1e-5)
    # from a short way out along the normal, straight back at the point
    distance = surface.distance(points + np.float32(0.05) * normals, -normals)
    np.testing.assert_allclose(distance, 0.05, atol=2e-3)
    row, column = surface.texture_coordinates(points)
    again, _ = surface.point(np.clip(row, 0, 1), np.clip(column, 0, 0.99999))
    if not isinstance(surface, ray_caster.Ball):  # around a pole the columns of a ball meet
        np.testing.assert_allclose(again, points, atol=2e-2)


@pytest.mark.slow
def test_camera_sees_what_lies_on_its_axis(surfaces):
    marble = surfaces[2]
    rotation, translation = look_at(np.array([2.0, 0.5, 1.0]), np.array(marble.centre), np.array([0.0, 0.0, 1.0]))
    camera = Camera(32, 24, 200.0, 200.0, 16.0, 12.0, rotation, translation)
    alone = ray_caster.render([marble], camera, samples=1)
    together = ray_caster.render(surfaces, camera, samples=1)
    np.testing.assert_array_equal(alone[12, 16], together[12, 16])
    assert together.min() >= 0 and together.max() <= 1


def test_cameras_stand_inside_the_wall_and_look_at_the_middle():
    views = ray_caster.cameras(40, 320, 240, seed=0)
    assert len(views) == 40
    for view in views:
        assert np.hypot(*view.position[:2]) < ray_caster.WALL_RADIUS_METRES - 0.5
        x, y, z = view.rotation @ ray_caster.SCENE_CENTRE + view.translation
        assert z > 0
        assert abs(view.fx * x / z) < 40 and abs(view.fy * y / z) < 40


@pytest.mark.slow
def test_the_view_to_time_a_step_on(surfaces, monkeypatch):
    """The Gaussians lie on surfaces that the photograph shows: rays to those in front hit nothing before them."""
    monkeypatch.setattr(measured_view, "still_life", lambda: surfaces)
    monkeypatch.setattr(measured_view, "bake", lambda *_, **__: None)
    (gaussians, camera, photograph), (again, _, same) = (measured_view.measured_view(300) for _ in range(2))
    np.testing.assert_array_equal(gaussians.means, again.means)
    np.testing.assert_array_equal(photograph, same)
    assert (gaussians.sh.shape, photograph.shape) == ((300, 16, 3), (camera.height, camera.width, 3))
    origin = camera.position.astype(np.float32)
    rays = gaussians.means - origin
    distances = np.linalg.norm(rays, axis=1)
    nearest = np.min([each.distance(origin, rays / distances[:, None]) for each in surfaces], axis=0)
    assert np.all(nearest < distances + 1e-3), "each is on a surface"  # of metres; float32 has 1e-6
    assert 0.3 < np.mean(nearest > distances - 1e-3) < 1, "and some are hidden by others"
