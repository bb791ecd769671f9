# SPDX-License-Identifier: Apache-2.0
"""Cameras of Metashape: lenses, chunks on the earth, and files that are wrong."""

from __future__ import annotations

from pathlib import Path

import numpy as np
import pytest
import ring
import survey_files
from calls import refuses, warned

from clsplat.files.xml_documents import read_xml
from clsplat.scenes.dataset import DataSet
from clsplat.scenes.geography.georeference import on_tangent_plane, place_of
from clsplat.scenes.loading import load_scene
from clsplat.scenes.readers.surveys.metashape import read_metashape


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
        (
            'type="frame"',
            'type="rpc"',
            "the lens is 'rpc', expected frame, fisheye, equidistant_fisheye, spherical; export undistorted",
        ),
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


def test_elements_and_attributes_of_xml_are_bounded(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    """Attributes count too: a file of 256 MiB has room for 40 million."""
    path = tmp_path / "cameras.xml"
    monkeypatch.setattr("clsplat.files.xml_documents.MAX_XML_PARTS", 10)
    for elements, attributes in ((9, 0), (0, 9), (10, 0), (0, 10)):
        path.write_text(
            f"<document {' '.join(f'a{i}=' + repr('') for i in range(attributes))}>{'<b/>' * elements}</document>"
        )
        if elements + attributes < 10:
            assert len(read_xml(path, "cameras")) == elements
        else:
            refuses("is not readable XML: it has more than 10 elements and attributes", read_xml, path, "cameras")


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
