# SPDX-License-Identifier: Apache-2.0
"""Cameras of OpenSfM, ODM and WebODM: lenses, projects, places on the earth, and files that are wrong."""

from __future__ import annotations

import json
from collections.abc import Callable
from pathlib import Path
from typing import Any

import numpy as np
import pytest
import ring
import survey_files
from calls import refuses, warned

from clsplat.files.documents import parsed_bytes
from clsplat.scenes.loading import load_scene
from clsplat.scenes.readers.surveys.opensfm import (
    MAX_RECONSTRUCTION_BYTES,
    MAX_RECONSTRUCTION_MEMORY_BYTES,
    read_reconstruction,
)

LENGTH = max(ring.WIDTH, ring.HEIGHT)
BROWN = {"projection_type": "brown", "focal_x": 0.8, "focal_y": 0.9, "c_x": 0.01, "c_y": -0.02}


@pytest.mark.parametrize(
    ("camera", "model", "params"),
    [
        ({"focal": 0.8}, "PINHOLE", (38.4, 38.4, 24, 16)),
        ({"focal": 0.8, "k1": 0.1, "k2": -0.02}, "OPENCV", (38.4, 38.4, 24, 16, 0.1, -0.02, 0, 0)),
        ({**BROWN, "k1": 0.1, "p1": 0.01, "p2": 0.02}, "OPENCV", (38.4, 43.2, 24.48, 15.04, 0.1, 0, 0.01, 0.02)),
        ({**BROWN, "k3": 0.3}, "FULL_OPENCV", (38.4, 43.2, 24.48, 15.04, 0, 0, 0, 0, 0.3, 0, 0, 0)),
        (
            {"projection_type": "fisheye", "focal": 0.5, "k1": 0.1, "k2": 0.2},
            "OPENCV_FISHEYE",
            (24, 24, 24, 16, 0.1, 0.2, 0, 0),
        ),
        (
            {**BROWN, "projection_type": "fisheye_opencv", "k4": 0.4},
            "OPENCV_FISHEYE",
            (38.4, 43.2, 24.48, 15.04, 0, 0, 0, 0.4),
        ),
        ({"projection_type": "spherical", "width": 64, "height": 32}, "EQUIRECTANGULAR", (64, 32)),
    ],
)
def test_lenses_of_opensfm(tmp_path: Path, camera: dict[str, Any], model: str, params: tuple[float, ...]) -> None:
    lens = read_reconstruction(survey_files.write_opensfm(tmp_path, camera=camera)).images[0].lens
    assert lens.model == model
    assert lens.params == pytest.approx(params)


def test_the_lens_follows_opensfms_formula(tmp_path: Path) -> None:
    """The formula of its documentation, u = f (1 + k1 r^2 + k2 r^4) x / z, as a fraction of the longer side."""
    path = survey_files.write_opensfm(tmp_path, camera={"focal": 0.8, "k1": 0.1, "k2": -0.05})
    x, y, z = 0.3, -0.2, 1.5
    square = (x * x + y * y) / z**2
    factor = 0.8 * (1 + 0.1 * square - 0.05 * square**2) / z
    wanted = [LENGTH * factor * x + ring.WIDTH / 2, LENGTH * factor * y + ring.HEIGHT / 2]
    lens = read_reconstruction(path).images[0].lens
    np.testing.assert_allclose(lens.img_from_cam(np.array([[x, y, z]]))[0], wanted, rtol=1e-12)


def test_a_project_of_webodm_is_read_from_its_folder(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    survey_files.write_opensfm(tmp_path)
    (tmp_path / "opensfm").mkdir()
    (tmp_path / "reconstruction.json").rename(tmp_path / "opensfm" / "reconstruction.json")
    for path in (tmp_path, tmp_path / "opensfm", tmp_path / "opensfm" / "reconstruction.json"):
        assert len(load_scene(path).views) == ring.COUNT
    monkeypatch.chdir(tmp_path / "opensfm")  # so that the folder's name is not in the path
    for name in (".", "reconstruction.json"):
        assert len(load_scene(name).views) == ring.COUNT


def test_the_largest_of_several_reconstructions_is_used(tmp_path: Path) -> None:
    path = survey_files.write_opensfm(tmp_path)
    (part,) = json.loads(path.read_text())
    few = {**part, "shots": dict(list(part["shots"].items())[:3])}
    path.write_text(json.dumps([few, part, {"shots": {}}]))
    data = warned("holds 2 reconstructions .* most photographs is used .20., without 3", read_reconstruction, path)
    assert len(data.images) == ring.COUNT


def test_the_place_of_a_reconstruction_is_its_georeference(tmp_path: Path) -> None:
    place = {"latitude": 0.0, "longitude": 90.0, "altitude": 100.0}
    path = survey_files.write_opensfm(tmp_path, reference_lla=place)
    (part,) = json.loads(path.read_text())
    for index, pose in enumerate(ring.poses()):
        shot = part["shots"][ring.NAMES[index]]
        shot["gps_position"] = np.add(ring.centre_of(pose), [3.0, 0, 4.0]).tolist()
        shot["gps_dop"] = 999999.0 if index >= 10 else 5.0
    path.write_text(json.dumps([part]))
    found = read_reconstruction(path).georeference
    assert found is not None
    assert found.epsg == 4978
    # At longitude 90 on the equator, up is y, east is -x and north is z of the geocentric system.
    np.testing.assert_allclose(found.origin, [0, 6378137.0 + 100, 0], atol=1e-6)
    np.testing.assert_allclose(found.transform, [[-1, 0, 0], [0, 0, 1], [0, 1, 0]], atol=1e-12)
    assert found.residuals is not None
    assert (found.residuals.count, found.residuals.rms) == (10, pytest.approx(5.0))
    path.write_text(json.dumps([{key: value for key, value in part.items() if key != "reference_lla"}]))
    assert read_reconstruction(path).georeference is None
    (tmp_path / "reference_lla.json").write_text(json.dumps(place))
    beside = read_reconstruction(path).georeference
    assert beside is not None
    np.testing.assert_array_equal(beside.origin, found.origin)


def test_a_place_of_zeros_is_unknown(tmp_path: Path) -> None:
    """As OpenSfM writes it for photographs without GPS."""
    nowhere = {"latitude": 0.0, "longitude": 0.0, "altitude": 0.0}
    assert read_reconstruction(survey_files.write_opensfm(tmp_path, reference_lla=nowhere)).georeference is None


def test_gps_positions_that_are_far_off_are_named(tmp_path: Path) -> None:
    path = survey_files.write_opensfm(tmp_path, reference_lla={"latitude": 48.0, "longitude": 11.0, "altitude": 500.0})
    (part,) = json.loads(path.read_text())
    for index, pose in enumerate(ring.poses()):
        off = [1000.0, 0, 0] if index in (3, 7, 9) else [0, 2.0, 0]
        part["shots"][ring.NAMES[index]]["gps_position"] = np.add(ring.centre_of(pose), off).tolist()
    path.write_text(json.dumps([part]))
    told = (
        "GPS of 3 photograph.s. is far .* not used: view03.png by 1,000 m, view07.png by 1,000 m, view09.png by 1,000 m"
    )
    found = warned(told, read_reconstruction, path).georeference
    assert found is not None
    assert found.residuals is not None
    assert (found.residuals.count, found.residuals.largest) == (17, pytest.approx(2.0))


def test_a_reference_that_is_not_of_these_cameras_is_not_used(tmp_path: Path) -> None:
    """As in ODM's reconstruction.geocoords.json: cameras in UTM, and still reference_lla."""
    place = {"latitude": 48.0, "longitude": 11.0, "altitude": 500.0}
    path = survey_files.write_opensfm(tmp_path, survey_files.at(), reference_lla=place)
    data = warned(
        "its cameras are 5,4.. km from its reference_lla, expected less than 100 km", read_reconstruction, path
    )
    assert data.georeference is None


def test_odms_cameras_before_its_map_projection_are_read(tmp_path: Path) -> None:
    """ODM renames OpenSfM's file, and writes cameras in a UTM zone to reconstruction.json. Both have reference_lla."""
    place = {"latitude": 48.0, "longitude": 11.0, "altitude": 0.0}
    (tmp_path / "opensfm").mkdir()
    path = survey_files.write_opensfm(tmp_path, reference_lla=place)
    topocentric = path.rename(tmp_path / "opensfm" / "reconstruction.topocentric.json")
    turned = survey_files.at(np.array([5.0, 0, 0]))
    projected = survey_files.write_opensfm(tmp_path, turned, reference_lla=place).rename(
        tmp_path / "opensfm" / "reconstruction.json"
    )
    for given in (tmp_path, tmp_path / "opensfm", topocentric):
        scene = load_scene(given)
        assert scene.georeference is not None
        np.testing.assert_allclose(scene.views[0].camera.position, ring.centre_of(ring.poses()[0]), atol=1e-9)
    data = warned("map projection, which reference_lla does not fit", read_reconstruction, projected)
    assert data.georeference is None
    np.testing.assert_allclose(data.images[0].translation, turned[0][1], atol=1e-9)


@pytest.mark.parametrize("indent", [None, 4])
def test_a_million_points_are_within_the_limits(tmp_path: Path, indent: int | None) -> None:
    """Without indentation, and with that of OpenSfM."""
    count = 500
    path = survey_files.write_opensfm(tmp_path, optics=[survey_files.RING] * ring.COUNT, cloud=ring.points(count))
    data = json.dumps(json.loads(path.read_text()), indent=indent).encode()
    assert len(data) * 1_000_000 / count < MAX_RECONSTRUCTION_BYTES
    assert parsed_bytes(data) * 1_000_000 / count < MAX_RECONSTRUCTION_MEMORY_BYTES


def test_two_names_of_one_photograph_are_one_line(tmp_path: Path) -> None:
    """Both names are that of the same file below the folder of photographs."""
    path = survey_files.write_opensfm(tmp_path, reference_lla={"latitude": 48.0, "longitude": 11.0, "altitude": 500.0})
    (part,) = json.loads(path.read_text())
    part["shots"][f"../{ring.NAMES[0]}"] = part["shots"][ring.NAMES[0]]
    path.write_text(json.dumps([part]))
    refuses("lists view00.png twice, expected each photograph once", load_scene, tmp_path)


def change_shot(part: dict[str, Any], **keys: Any) -> None:
    part["shots"][ring.NAMES[1]].update(keys)


@pytest.mark.parametrize(
    ("change", "told"),
    [
        (lambda part: change_shot(part, camera="v2 b"), "photograph 'view01.png': its camera 'v2 b' is not among"),
        (
            lambda part: change_shot(part, rotation=[1, 2]),
            "photograph 'view01.png': 'rotation' is .* list of 3 numbers",
        ),
        (lambda part: change_shot(part, translation=None), "photograph 'view01.png': has no 'translation'"),
        (lambda part: change_shot(part, translation=[1e31, 0, 0]), "'translation' is .* possible size"),
        (
            lambda part: part["cameras"]["v2 0"].update(projection_type="dual"),
            "expected perspective, brown, radial, simple_radial, fisheye, fisheye_opencv, spherical, equirectangular;",
        ),
        (lambda part: part["cameras"]["v2 0"].update(width=0), "'width' is 0, expected a whole number"),
        (lambda part: part["cameras"]["v2 0"].update(focal=-1), "focal lengths above 0"),
        (
            lambda part: part["cameras"]["v2 0"].update(projection_type="brown", focal_x=1, focal_y=1, k4=0.5),
            "k4 = 0.5 .* undistorted",
        ),
        (lambda part: part["points"]["0"].update(coordinates=[1, "x", 2]), "the points' 'coordinates' are not all"),
        (lambda part: part.update(points=[]), "'points' is .*, expected a JSON object"),
        (lambda part: part.update(shots={}), "has no 'shots'"),
        (lambda part: part.update(reference_lla={"latitude": 95, "longitude": 0, "altitude": 0}), "'latitude' is 95"),
        (lambda part: part.update(reference_lla=[1, 2, 3]), "expected latitude, longitude and altitude"),
    ],
)
def test_a_wrong_reconstruction_is_one_line(tmp_path: Path, change: Callable[[Any], object], told: str) -> None:
    path = survey_files.write_opensfm(tmp_path)
    (part,) = json.loads(path.read_text())
    change(part)
    path.write_text(json.dumps([part]))
    refuses(f"reconstruction.json.*{told}", read_reconstruction, path)


@pytest.mark.parametrize(("text", "told"), [("[", "is not JSON"), ("{}", "not a list"), ("[1]", "not a list")])
def test_a_file_that_is_no_reconstruction_is_one_line(tmp_path: Path, text: str, told: str) -> None:
    path = survey_files.write_opensfm(tmp_path)
    path.write_text(text)
    refuses(told, read_reconstruction, path)
