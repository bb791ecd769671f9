# SPDX-License-Identifier: Apache-2.0
"""Cameras of survey programs: the same scene in each format, far from the world's origin, and files that are wrong."""

from __future__ import annotations

import json
from collections.abc import Callable
from pathlib import Path
from typing import Any

import numpy as np
import pytest
import ring
import survey_files
from calls import refusal, refuses, warned

from clsplat.scenes.dataset import DataSet
from clsplat.scenes.folder_layouts import detect
from clsplat.scenes.geography.georeference import on_tangent_plane, place_of
from clsplat.scenes.loading import load_scene
from clsplat.scenes.readers.surveys.metashape import read_metashape
from clsplat.scenes.readers.surveys.opensfm import read_reconstruction
from clsplat.scenes.readers.surveys.realityscan import read_xmp
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


# OpenSfM


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


def test_a_project_of_webodm_is_read_from_its_folder(tmp_path: Path) -> None:
    survey_files.write_opensfm(tmp_path)
    (tmp_path / "opensfm").mkdir()
    (tmp_path / "reconstruction.json").rename(tmp_path / "opensfm" / "reconstruction.json")
    for path in (tmp_path, tmp_path / "opensfm", tmp_path / "opensfm" / "reconstruction.json"):
        assert len(load_scene(path).views) == ring.COUNT


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
        (lambda part: part["cameras"]["v2 0"].update(projection_type="dual"), "the lens is 'dual', expected persp"),
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


# Metashape


def metashape(folder: Path, calibration: str, kind: str = "frame") -> DataSet:
    calibration = f"<f>40</f><cx>1</cx><cy>-2</cy>{calibration}"
    return read_metashape(survey_files.write_metashape(folder, calibration=calibration, kind=kind))


@pytest.mark.parametrize(
    ("calibration", "kind", "model", "params"),
    [
        ("", "frame", "PINHOLE", (40, 40, 25, 14)),
        ("<b1>0.5</b1>", "frame", "PINHOLE", (40.5, 40, 25, 14)),
        ("<k1>.1</k1><k2>.2</k2><p1>.01</p1><p2>.02</p2>", "frame", "OPENCV", (40, 40, 25, 14, 0.1, 0.2, 0.02, 0.01)),
        ("<k3>.3</k3>", "frame", "FULL_OPENCV", (40, 40, 25, 14, 0, 0, 0, 0, 0.3, 0, 0, 0)),
        ("<k1>.1</k1><k4>.4</k4>", "fisheye", "OPENCV_FISHEYE", (40, 40, 25, 14, 0.1, 0, 0, 0.4)),
        (
            "<k3>.3</k3><p1>.01</p1>",
            "equidistant_fisheye",
            "THIN_PRISM_FISHEYE",
            (40, 40, 25, 14, 0, 0, 0, 0.01, 0.3, 0, 0, 0),
        ),
        ("", "spherical", "EQUIRECTANGULAR", (48, 32)),
    ],
)
def test_lenses_of_metashape(
    tmp_path: Path, calibration: str, kind: str, model: str, params: tuple[float, ...]
) -> None:
    lens = metashape(tmp_path, calibration, kind).images[0].lens
    assert lens.model == model
    assert lens.params == pytest.approx(params)


@pytest.mark.parametrize("kind", ["frame", "fisheye"])
def test_the_lens_follows_metashapes_formula(tmp_path: Path, kind: str) -> None:
    """The formula of the manual's appendix on camera models, written out."""
    k1, k2, k3, p1, p2, b1 = 0.1, -0.05, 0.02, 0.003, -0.004, 0.7
    text = f"<k1>{k1}</k1><k2>{k2}</k2><k3>{k3}</k3><p1>{p1}</p1><p2>{p2}</p2><b1>{b1}</b1>"
    x, y = 0.3 / 1.5, -0.2 / 1.5
    if kind == "fisheye":
        r0 = np.hypot(x, y)
        x, y = x * np.arctan(r0) / r0, y * np.arctan(r0) / r0
    r2 = x * x + y * y
    radial = 1 + k1 * r2 + k2 * r2**2 + k3 * r2**3
    x1 = x * radial + (p1 * (r2 + 2 * x * x) + 2 * p2 * x * y)
    y1 = y * radial + (p2 * (r2 + 2 * y * y) + 2 * p1 * x * y)
    wanted = [ring.WIDTH * 0.5 + 1 + x1 * 40 + x1 * b1, ring.HEIGHT * 0.5 - 2 + y1 * 40]
    lens = metashape(tmp_path, text, kind).images[0].lens
    np.testing.assert_allclose(lens.img_from_cam(np.array([[0.3, -0.2, 1.5]]))[0], wanted, rtol=1e-9)


def test_a_small_skew_is_told_and_a_large_one_refused(tmp_path: Path) -> None:
    # The top of the picture is at y = (16 + 2) / 40 = 0.45.
    warned("the skew b2 is left out, .* by up to 0.45 pixels .sensor '0'", metashape, tmp_path, "<b2>-1</b2>")
    refuses(
        "sensor '0': the skew b2 = 2 moves pixels by up to 0.9, expected at most 0.5", metashape, tmp_path, "<b2>2</b2>"
    )


def test_a_chunk_on_the_earth_is_brought_to_a_tangent_plane(tmp_path: Path) -> None:
    """Cameras in geocentric coordinates, whose plane is known: the ring's with z up instead of y down."""
    place = (48.12345, 11.56789, 523.0)
    plane = on_tangent_plane(place, "", None)
    turn = np.array([[1.0, 0, 0], [0, 0, 1], [0, -1, 0]])  # x east, y down and z north to x east, y north and z up
    there = [(r @ turn.T @ plane.transform.T, ring.centre_of((r, t))) for r, t in ring.poses()]
    posed = [(rotation, -rotation @ (plane.origin + plane.transform @ (turn @ centre))) for rotation, centre in there]
    wgs84 = 'GEOGCS["WGS 84",DATUM["World Geodetic System 1984"],AUTHORITY["EPSG","4326"]]'
    path = survey_files.write_metashape(
        tmp_path,
        posed,
        world_from_chunk=np.vstack([np.c_[plane.transform, plane.origin], [0, 0, 0, 1]]),
        reference=wgs84,
    )
    # A reference 0.00001 degrees too far north is 1.11 m off.
    latitude, longitude, altitude = place_of(-posed[3][0].T @ posed[3][1])
    at = f'<reference x="{longitude!r}" y="{latitude + 1e-5!r}" z="{altitude!r}" enabled="true"/></camera>'
    text = path.read_text()
    path.write_text(
        text.replace(f'label="{Path(ring.NAMES[3]).stem}">', f'label="{Path(ring.NAMES[3]).stem}">{at[:-9]}')
    )
    scene = load_scene(tmp_path)
    found = scene.georeference
    assert found is not None
    np.testing.assert_allclose(
        found.origin + found.transform @ np.array([0, 0, 1.0]), plane.origin + plane.transform[:, 2], atol=3
    )
    for view, pose in zip(scene.views, posed, strict=True):
        on_earth = found.origin + found.transform @ view.camera.position
        # geocentric coordinates of 6.4e6 m have steps of 1e-9 m
        np.testing.assert_allclose(on_earth, ring.centre_of(pose), rtol=0, atol=1e-6)
        np.testing.assert_allclose(view.camera.rotation @ found.transform.T, pose[0], rtol=0, atol=1e-9)
        assert np.abs(view.camera.position).max() < 20
    assert found.residuals is not None
    assert (found.residuals.count, found.residuals.rms) == (1, pytest.approx(1.11, abs=0.01))
    assert "EPSG:4326" in found.note


def test_cameras_without_a_pose_or_disabled_are_left_out(tmp_path: Path) -> None:
    path = survey_files.write_metashape(tmp_path)
    text = path.read_text().replace('label="view00">', 'label="view00" enabled="false">')
    path.write_text(text.replace("<cameras>", '<cameras><camera id="77" sensor_id="0" label="not aligned"/>'))
    scene = load_scene(tmp_path)
    assert len(scene.views) == ring.COUNT - 1
    assert any("does not list 1 image(s)" in text for text in scene.warnings)


CHUNK_END = "</chunk>"


@pytest.mark.parametrize(
    ("old", "new", "told"),
    [
        ("<f>40.0</f>", "", "sensor '0': <f> is missing, expected a number"),
        ("<f>40.0</f>", "<f>x</f>", "sensor '0': <f> is 'x', expected a number"),
        ("<f>40.0</f>", "<f>-3</f>", "focal lengths above 0"),
        ("<f>40.0</f>", "<f>40</f><k4>0.1</k4>", "k4 = 0.1 .*undistorted photographs"),
        ("<f>40.0</f>", "<f>40</f><p3>0.1</p3>", "p3 = 0.1, .*undistorted photographs"),
        ('type="frame"', 'type="rpc"', "the lens is 'rpc', expected frame"),
        ('sensor_id="0"', 'sensor_id="9"', "camera 'view00': its sensor '9' is not among"),
        ('label="view00"><transform>', 'label="view00"><transform>1 ', "camera 'view00': <transform> is .* 16 numbers"),
        ('width="48"', 'width="x"', "its <resolution> is 'x x 32'"),
        ("<scale>1", "<scale>x", "component 0: <scale> is 'x"),
        (
            'component_id="0" label="view07"',
            'component_id="1" label="view07"',
            "cameras in 2 components, and '1' has no",
        ),
        ('label="view07"', 'label="view08"', "lists view08 twice"),
        ("</document>", "", "is not readable XML: no element found"),
        ("<document", "<!DOCTYPE a [<!ENTITY b 'c'>]><document", "it has a document type"),
        ("<transform>", "<a>" * 200 + "</a>" * 200 + "<transform>", "nested more than 100 deep"),
        ("<cameras>", "<cameras>&a;", "undefined entity"),
    ],
)
def test_wrong_cameras_of_metashape_are_one_line(tmp_path: Path, old: str, new: str, told: str) -> None:
    path = survey_files.write_metashape(tmp_path, world_from_chunk=survey_files.chunk_at())
    text = path.read_text()
    assert old in text
    path.write_text(text.replace(old, new))
    refuses(f"cameras.xml.*{told}", load_scene, tmp_path)


def test_a_transform_that_is_no_similarity_is_refused(tmp_path: Path) -> None:
    sheared = np.eye(4)
    sheared[0, 1] = 0.1
    path = survey_files.write_metashape(tmp_path, world_from_chunk=sheared)
    refuses("component 0: <transform> contains no rotation", read_metashape, path)


def test_two_coordinate_systems_are_refused(tmp_path: Path) -> None:
    path = survey_files.write_metashape(tmp_path)
    text = path.read_text()
    chunk = text[text.index("<chunk") : text.index(CHUNK_END) + len(CHUNK_END)]
    path.write_text(text.replace(CHUNK_END, CHUNK_END + chunk))
    refuses(
        "cameras in 2 chunks with their own coordinate systems .'Chunk 1', 'Chunk 1'., expected one", load_scene, path
    )
    path.write_text(text)
    (tmp_path / "b.xml").write_text(text)
    refuses("holds b.xml, cameras.xml, which are all cameras of Metashape", load_scene, tmp_path)
    assert len(load_scene(path).views) == ring.COUNT


# RealityScan


def xmp(folder: Path, model: str, coefficients: str) -> DataSet:
    attributes = f'xcr:DistortionModel="{model}" xcr:DistortionCoeficients="{coefficients}"'
    return read_xmp(survey_files.write_xmp(folder, attributes=attributes), None)


@pytest.mark.parametrize(
    ("model", "coefficients", "name", "distortion"),
    [
        ("perspective", "0 0 0 0 0 0", "PINHOLE", ()),
        ("division", "0 0 0 0 0 0", "PINHOLE", ()),
        ("brown3", ".1 .2 0 0 0 0", "OPENCV", (0.1, 0.2, 0, 0)),
        ("brown4", ".1 .2 .3 0 0 0", "FULL_OPENCV", (0.1, 0.2, 0, 0, 0.3, 0, 0, 0)),
        ("brown3t2", ".1 .2 .3 0 .01 .02", "FULL_OPENCV", (0.1, 0.2, 0.02, 0.01, 0.3, 0, 0, 0)),
    ],
)
def test_lenses_of_realityscan(
    tmp_path: Path, model: str, coefficients: str, name: str, distortion: tuple[float, ...]
) -> None:
    lens = xmp(tmp_path, model, coefficients).images[0].lens
    assert lens.model == name
    assert lens.params == pytest.approx((40, 40, 24, 16, *distortion))


REAL_XMP = """<x:xmpmeta xmlns:x="adobe:ns:meta/">
  <rdf:RDF xmlns:rdf="http://www.w3.org/1999/02/22-rdf-syntax-ns#">
    <rdf:Description xcr:Version="3" xcr:PosePrior="initial" xcr:Coordinates="absolute" xcr:DistortionModel="brown3t2"
       xcr:Skew="0" xcr:AspectRatio="1.01" xcr:CalibrationPrior="initial" xcr:InTexturing="1"
       xmlns:xcr="http://www.capturingreality.com/ns/xcr/1.1#">
      <xcr:Rotation>1 0 0 0 0 -1 0 1 0</xcr:Rotation>
      <xcr:Position>3 4 5</xcr:Position>
      <xcr:FocalLength35mm>27</xcr:FocalLength35mm>
      <xcr:PrincipalPointU>0.01</xcr:PrincipalPointU>
      <xcr:PrincipalPointV>-0.02</xcr:PrincipalPointV>
      <xcr:DistortionCoeficients>0.1 -0.05 0.02 0 0.003 -0.004</xcr:DistortionCoeficients>
    </rdf:Description>
  </rdf:RDF>
</x:xmpmeta>
"""


def test_an_upright_photograph_of_version_3(tmp_path: Path) -> None:
    """Values as elements; lengths in pictures count in the longer side, here the height. The formula is written out."""
    ring.write_pictures(tmp_path, ["a.png"], (30, 40))
    (tmp_path / "a.xmp").write_text(REAL_XMP)
    image = read_xmp(tmp_path, None).images[0]
    np.testing.assert_allclose(image.rotation @ [3, 6, 5] + image.translation, [0, 0, 2], atol=1e-12)  # looks along y
    x, y = 0.2, -0.1
    r2 = x * x + y * y
    radial, t1, t2 = 1 + 0.1 * r2 - 0.05 * r2**2 + 0.02 * r2**3, 0.003, -0.004
    x1 = x * radial + t1 * (r2 + 2 * x * x) + 2 * t2 * x * y
    y1 = y * radial + t2 * (r2 + 2 * y * y) + 2 * t1 * x * y
    focal = 27 / 36 * 40
    wanted = [focal * x1 + 40 * 0.01 + 15, 1.01 * focal * y1 - 40 * 0.02 + 20]
    np.testing.assert_allclose(image.lens.img_from_cam(np.array([[0.2, -0.1, 1.0]]))[0], wanted, rtol=1e-9)


def test_photographs_without_a_position_are_left_out(tmp_path: Path) -> None:
    survey_files.write_xmp(tmp_path)
    (tmp_path / ring.NAMES[4]).with_suffix(".xmp").write_text(
        (tmp_path / ring.NAMES[4]).with_suffix(".xmp").read_text().replace("Position", "Elsewhere")
    )
    (tmp_path / ring.NAMES[5]).with_suffix(".xmp").unlink()
    scene = load_scene(tmp_path)
    assert len(scene.views) == ring.COUNT - 2
    assert any("does not list 2 image(s)" in text for text in scene.warnings)


def test_xmp_files_named_after_the_whole_file(tmp_path: Path) -> None:
    survey_files.write_xmp(tmp_path)
    for path in sorted(tmp_path.glob("*.xmp")):
        path.rename(path.with_suffix(".png.xmp"))
    assert [view.name for view in load_scene(tmp_path).views] == ring.NAMES


def test_a_mask_beside_a_photograph_is_not_the_photograph(tmp_path: Path) -> None:
    names = [f"{name[:-4]}.exr" for name in ring.NAMES]  # a file type that sorts before the masks
    survey_files.write_xmp(tmp_path, names=names)
    ring.write_pictures(tmp_path, ring.NAMES[:2], (ring.WIDTH // 2, ring.HEIGHT // 2))
    scene = load_scene(tmp_path)
    assert [view.path.suffix for view in scene.views] == [".exr"] * ring.COUNT
    assert {view.lens.width for view in scene.views} == {ring.WIDTH}


def test_xmp_files_of_editors_are_no_cameras(tmp_path: Path) -> None:
    """Lightroom's: the folder is one of photographs."""
    ring.write_pictures(tmp_path, ["a.png", "b.png"])
    (tmp_path / "a.xmp").write_text('<x:xmpmeta xmlns:x="adobe:ns:meta/"/>')
    assert detect(tmp_path) == "photos"


def test_xmp_files_apart_from_their_photographs(tmp_path: Path) -> None:
    folder = survey_files.write_xmp(tmp_path / "photos" / "..")
    (tmp_path / "poses").mkdir()
    for path in sorted(folder.glob("*.xmp")):
        path.rename(tmp_path / "poses" / path.name)
    told = refusal(lambda: load_scene(tmp_path / "poses"))
    assert "has no photograph of the 20 XMP files" in told
    assert "another project" in told
    assert len(load_scene(tmp_path / "poses", images="..").views) == ring.COUNT
    refuses("no such folder, expected the photographs of", load_scene, tmp_path / "poses", images="photos")


def test_xmp_files_of_another_project(tmp_path: Path) -> None:
    """A few more than there are photographs are left out, many are refused."""
    survey_files.write_xmp(tmp_path)
    text = (tmp_path / "view00.xmp").read_text()
    (tmp_path / "other00.xmp").write_text(text)
    scene = load_scene(tmp_path)
    assert any("lists 1 image(s) that are missing" in told for told in scene.warnings)
    for index in range(1, 6):
        (tmp_path / f"other{index:02}.xmp").write_text(text)
    refuses("lists 6 image.s. that are missing", load_scene, tmp_path)


def test_xmp_files_of_two_coordinate_systems_are_refused(tmp_path: Path) -> None:
    survey_files.write_xmp(tmp_path)
    path = tmp_path / "view07.xmp"
    path.write_text(path.read_text().replace('Type="3"', 'Type="1"'))
    told = refusal(lambda: load_scene(tmp_path))
    assert (
        "its XMP files have 2 coordinate systems (xcr:ExportCoordinateSystemType '3' of view00, '1' of view07)" in told
    )


@pytest.mark.parametrize(
    ("old", "new", "told"),
    [
        ("<xcr:Position>", "<xcr:Position>x ", "xcr:Position is 'x .* expected 3 numbers"),
        ("<xcr:Rotation>", "<xcr:Rotation>0 ", "xcr:Rotation is .* expected 9 numbers"),
        ("<xcr:Rotation>", "<xcr:Rotation>1 0 0 0 1 0 0 0 -1</xcr:Rotation><xcr:Rotation>", "is no rotation"),
        ("FocalLength35mm", "Other", "has no xcr:FocalLength35mm, expected a number"),
        ('"absolute"', '"relative"', "xcr:Coordinates is 'relative', expected absolute"),
        ('AspectRatio="1"', 'AspectRatio="1" xcr:Skew="0.1"', "xcr:Skew is 0.1, expected 0"),
        ('"0 0 0 0 0 0"', '".1 0 0 0 0 0"', ""),
        (
            '"perspective" xcr:DistortionCoeficients="0',
            '"division" xcr:DistortionCoeficients=".1',
            "'division', expected",
        ),
        (
            '"perspective" xcr:DistortionCoeficients="0 0 0 0',
            '"brown4" xcr:DistortionCoeficients="0 0 0 .4',
            "k4 = 0.4",
        ),
        ("</x:xmpmeta>", "", "is not readable XML"),
    ],
)
def test_a_wrong_xmp_file_is_one_line(tmp_path: Path, old: str, new: str, told: str) -> None:
    path = survey_files.write_xmp(tmp_path) / "view07.xmp"
    text = path.read_text()
    assert old in text
    path.write_text(text.replace(old, new))
    if told:
        refuses(f"view07.xmp: .*{told}", load_scene, tmp_path)
    else:
        assert load_scene(tmp_path).views[7].lens.is_pinhole  # coefficients without a distortion model do not count


# Any format


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
