# SPDX-License-Identifier: Apache-2.0
"""georeference.json: read beside the cameras, moved with the scene, kept with the run and with converted models."""

from __future__ import annotations

import json
from pathlib import Path
from typing import Any

import numpy as np
import pytest
import ring
import survey_files
from calls import Capture, printed, refuses, rejected
from models import random_gaussians
from scipy.spatial.transform import Rotation

from clsplat.config.orientation import FrameUse
from clsplat.config.training import TrainConfig
from clsplat.models.edit import moved
from clsplat.runs.run import Run
from clsplat.scenes.dataset import SceneFrame
from clsplat.scenes.geography.georeference import (
    GEOREFERENCE_FILE,
    Georeference,
    GpsResiduals,
    beside_model,
    geocentric_of,
    on_tangent_plane,
    place_of,
    read_georeference,
    read_of_model,
)
from clsplat.scenes.loading import load_scene
from clsplat.scenes.readers.scene_place import georeference_by_gps
from clsplat.scenes.sfm.framing import MODEL_FOLDER, set_frame


def on_earth(place: Georeference, points: Any) -> Any:
    return place.origin + np.asarray(points) @ place.transform.T


def similarity() -> np.ndarray:
    change = np.eye(4)
    change[:3, :3] = 0.3 * Rotation.from_euler("xyz", [10, -20, 130], degrees=True).as_matrix()
    change[:3, 3] = [5, -6, 7]
    return change


def test_the_tangent_plane_at_a_place() -> None:
    """One metre along each axis from Munich, by pycolmap's own east, north and up."""
    import pycolmap

    place = (48.137, 11.575, 519.0)
    plane = on_tangent_plane(place, "a note", None)
    np.testing.assert_allclose(plane.transform.T @ plane.transform, np.eye(3), atol=1e-12)
    transform = pycolmap.GPSTransform(pycolmap.GPSTransformEllipsoid.WGS84)
    enu = np.array([[100.0, 0, 0], [0, 100, 0], [0, 0, 100]])
    # geocentric coordinates of 6.4e6 m have steps of 1e-9 m
    np.testing.assert_allclose(on_earth(plane, enu), transform.enu_to_ecef(enu, *place), atol=1e-7)
    np.testing.assert_allclose(place_of(geocentric_of(place)), place, atol=1e-6)


@pytest.mark.parametrize("code", [32632, 4647, 4978])  # UTM zone 32N, the same with its number before x, geocentric
def test_a_record_comes_back(tmp_path: Path, code: int) -> None:
    path = tmp_path / GEOREFERENCE_FILE
    assert read_georeference(path) is None
    change = similarity()
    wanted = Georeference(code, survey_files.UTM_OFFSET, change[:3, :3], GpsResiduals(3, 0.5, 0.75), "from here")
    path.write_bytes(wanted.content())
    found = read_georeference(path)
    assert found is not None
    np.testing.assert_array_equal(found.origin, wanted.origin)
    np.testing.assert_array_equal(found.transform, wanted.transform)
    assert (found.epsg, found.residuals, found.note) == (code, wanted.residuals, "from here")


@pytest.mark.parametrize("code", [4491, 4549, 4554, 4647, 4839, 4978, 32632])
def test_systems_in_metres_are_read_whatever_their_code(tmp_path: Path, code: int) -> None:
    """The codes of Gauss-Kruger zones of CGCS2000, and of UTM zone 32 of ETRS89, lie among those in degrees."""
    path = tmp_path / GEOREFERENCE_FILE
    path.write_text(json.dumps({"epsg": code}))
    found = read_georeference(path)
    assert found is not None
    assert found.epsg == code


@pytest.mark.parametrize("code", [4001, 4258, 4326, 4490, 4555, 4979])
def test_systems_in_degrees_are_refused(tmp_path: Path, code: int) -> None:
    path = tmp_path / GEOREFERENCE_FILE
    path.write_text(json.dumps({"epsg": code}))
    refuses(f"EPSG:{code} counts in degrees", read_georeference, path)


def test_a_change_of_the_scene_changes_no_place_on_the_earth() -> None:
    place = Georeference(32632, survey_files.UTM_OFFSET, 2 * np.eye(3))
    points = np.random.default_rng(1).normal(size=(20, 3))
    after = place.moved(similarity())
    # float64 keeps 1e-9 of 5.4e6
    np.testing.assert_allclose(on_earth(after, moved(points, similarity())), on_earth(place, points), atol=1e-7)


@pytest.mark.parametrize(
    ("text", "told"),
    [
        ("{", "is not JSON"),
        ("[]", "is not a JSON object, expected one with 'epsg'"),
        ("{}", "has no 'epsg', expected the number of an EPSG code"),
        ('{"epsg": "32632"}', "'epsg' is 32632, expected"),
        ('{"epsg": 4326}', "EPSG:4326 counts in degrees, expected a coordinate reference system in metres"),
        ('{"epsg": 32632, "origin": [1, 2]}', "'origin' is .*, expected three numbers"),
        ('{"epsg": 32632, "origin": [1, 2, NaN]}', "'origin' is .*, expected three numbers"),
        ('{"epsg": 32632, "transform": [[1,0,0],[0,1,0],[0,0,2]]}', "'transform' is .*, expected a rotation times a"),
        (
            '{"epsg": 32632, "transform": [[1e200,0,0],[0,1e200,0],[0,0,1e200]]}',
            "'transform' is .*, expected a rotation",
        ),
        ('{"epsg": 32632, "transform": [[1,0,0],[0,1,0],[0,0,-1]]}', "'transform' is .*, expected a rotation times a"),
    ],
)
def test_a_wrong_record_is_one_line(tmp_path: Path, text: str, told: str) -> None:
    path = tmp_path / GEOREFERENCE_FILE
    path.write_text(text)
    refuses(f"{GEOREFERENCE_FILE}: {told}", read_georeference, path)


@pytest.mark.parametrize("beside", ["sparse/0", "."])
def test_a_record_beside_the_cameras_is_the_scenes(tmp_path: Path, beside: str) -> None:
    """A hand-written one, for cameras in a UTM zone; also of a scene that is turned upright."""
    folder = ring.write_colmap(tmp_path / "scene", posed=survey_files.at())
    (folder / beside / GEOREFERENCE_FILE).write_text('{"epsg": 32632}')
    for use in (FrameUse(), FrameUse("up", "view00.png,view05.png=12.5")):
        scene = load_scene(folder, frame=use)
        assert scene.georeference is not None
        assert scene.georeference.epsg == 32632
        for view, pose in zip(scene.views, survey_files.at(), strict=True):
            # 5.4e6 m turned and turned back in float64
            np.testing.assert_allclose(
                on_earth(scene.georeference, view.camera.position), ring.centre_of(pose), rtol=0, atol=1e-6
            )


def test_sfm_moves_it_with_the_cameras(tmp_path: Path) -> None:
    folder = ring.write_colmap(tmp_path / "scene", posed=survey_files.at())
    points = folder / MODEL_FOLDER / "points3D.txt"
    points.write_text(points.read_text().replace(" 0.5 1 0 2 0\n", " 0.5\n"))  # no image has observations
    (folder / MODEL_FOLDER / GEOREFERENCE_FILE).write_text('{"epsg": 32632}')
    for name in ("up", "none"):
        set_frame(folder, folder / "images", FrameUse(name), "scene")  # type: ignore[arg-type]
        scene = load_scene(folder)
        assert scene.georeference is not None
        places = [on_earth(scene.georeference, view.camera.position) for view in scene.views]
        wanted = [ring.centre_of(pose) for pose in survey_files.at()]
        np.testing.assert_allclose(places, wanted, rtol=0, atol=1e-6)
    assert np.abs(scene.georeference.transform - np.eye(3)).max() < 1e-9


def test_two_coordinate_systems_are_refused(tmp_path: Path) -> None:
    survey_files.write_opensfm(tmp_path, reference_lla={"latitude": 48.0, "longitude": 11.0, "altitude": 500.0})
    (tmp_path / GEOREFERENCE_FILE).write_text('{"epsg": 32632}')
    refuses("gives EPSG:32632, but the cameras of .* of their own .reference_lla", load_scene, tmp_path)


def test_a_scale_by_gps_is_a_place_on_the_earth() -> None:
    assert georeference_by_gps(SceneFrame(upright=True, metres=True)) is None
    place = georeference_by_gps(SceneFrame(upright=True, metres=True, origin=(0.0, 0.0, 0.0), scale_note="by GPS"))
    assert place is not None
    # On the equator at longitude 0: up is x, east is y, north is z. In the world x is east, -y up and z north.
    np.testing.assert_allclose(place.transform, [[0, -1, 0], [1, 0, 0], [0, 0, 1]], atol=1e-12)
    np.testing.assert_allclose(place.origin, [6378137.0, 0, 0], atol=1e-6)


def test_converted_models_get_it(tmp_path: Path, capsys: Capture) -> None:
    run = Run.create(tmp_path / "run", TrainConfig(), scene=tmp_path)
    place = Georeference(32632, survey_files.UTM_OFFSET)
    (run.path / GEOREFERENCE_FILE).write_bytes(place.content())
    random_gaussians(20, 0).save(run.model_path)
    target, further, plain = tmp_path / "moved.splat", tmp_path / "further.ply", tmp_path / "plain.ply"
    printed(capsys, ["convert", run.path, target, "--scale", "2", "--translate", "1,2,3"])
    found = read_of_model(target)
    assert found is not None
    point = np.array([0.5, 0.25, -1.0])
    np.testing.assert_allclose(on_earth(found, 2 * point + [1, 2, 3]), on_earth(place, point), atol=1e-6)
    printed(capsys, ["convert", target, further])
    assert json.loads(beside_model(further).read_text())["epsg"] == 32632
    further.unlink()
    assert "further.georeference.json: exists already" in rejected(capsys, ["convert", target, further])
    # A model without a place does not get the place of the model that it replaces.
    random_gaussians(20, 0).save(plain)
    printed(capsys, ["convert", plain, further, "--overwrite"])
    assert read_of_model(further) is None


def test_info_says_where_a_model_lies(tmp_path: Path, capsys: Capture) -> None:
    """The record as JSON, and in text the place in degrees with the distances from GPS positions."""
    model = tmp_path / "model.ply"
    random_gaussians(3).save(model)
    assert json.loads(printed(capsys, ["info", model, "--json"]).out)["georeference"] is None
    place = on_tangent_plane((48.137, 11.575, 519.0), "a note", GpsResiduals(7, 1.25, 3.5))
    (tmp_path / GEOREFERENCE_FILE).write_bytes(place.content())
    assert json.loads(printed(capsys, ["info", model, "--json"]).out)["georeference"] == place.document()
    (line,) = (line for line in printed(capsys, ["info", model]).out.splitlines() if line.startswith("on the earth"))
    assert "EPSG:4978, origin 4177" in line
    assert "(latitude 48.1370000, longitude 11.5750000, altitude 519.00 m)" in line
    assert line.endswith("GPS of 7 photographs: rms 1.25 m, at most 3.5 m")


def test_a_mirrored_model_gets_no_place(tmp_path: Path, capsys: Capture) -> None:
    """A record with a mirror would be refused when it is read."""
    source, target = tmp_path / "model.ply", tmp_path / "mirrored.ply"
    random_gaussians(20, 0).save(source)
    beside_model(source).write_bytes(Georeference(32632, survey_files.UTM_OFFSET).content())
    mirror = ",".join(map(str, np.diag([-1, 1, 1, 1]).ravel().tolist()))
    told = printed(capsys, ["convert", source, target, f"--transform={mirror}"]).err
    assert "mirrored.ply: gets no mirrored.georeference.json, as the model is mirrored" in told
    assert read_of_model(target) is None
