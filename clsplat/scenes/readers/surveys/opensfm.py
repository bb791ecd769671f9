# SPDX-License-Identifier: Apache-2.0
"""Reading of reconstruction.json, the cameras and points of OpenSfM, which ODM and WebODM use too.

Format: https://opensfm.org/docs/dataset.html (reconstruction file) and geometry.html (coordinates, camera models).
Poses are `cam_from_world` in our axes, with the rotation as an axis times an angle. Lengths in pictures are fractions
of the longer side, from the middle. The world has x east, y north and z up, in metres from `reference_lla`.
"""

from __future__ import annotations

from pathlib import Path
from typing import Any

import numpy as np

from clsplat.arrays import Float32, Float64, numbers
from clsplat.errors import InputError, warn
from clsplat.files.documents import is_file, open_input, parse_json, read_document
from clsplat.scenes.camera_json import EXPORT_AGAIN_ADVICE, Keys, short
from clsplat.scenes.dataset import MAX_COORDINATE, DataSet, Lens, PosedImage
from clsplat.scenes.geography.georeference import Georeference, GpsResiduals, on_tangent_plane
from clsplat.scenes.readers.surveys.lenses import SurveyLens, model_of_kind, panorama
from clsplat.scenes.readers.surveys.values import centres_of, inner_name

RECONSTRUCTION_FILE = "reconstruction.json"
"""Name of the file in OpenSfM's folder."""
TOPOCENTRIC_FILE = "reconstruction.topocentric.json"
"""Name that ODM gives to OpenSfM's RECONSTRUCTION_FILE. ODM then writes a RECONSTRUCTION_FILE with cameras and points
in a UTM zone, less an offset, and still with `reference_lla`."""
OPENSFM_FOLDER = "opensfm"
"""Folder of an ODM or WebODM project with RECONSTRUCTION_FILE. The photographs are in images/ next to the folder."""
REFERENCE_FILE = "reference_lla.json"
"""File next to RECONSTRUCTION_FILE with the place of the world's origin, in older versions."""
MAX_RECONSTRUCTION_BYTES, MAX_RECONSTRUCTION_MEMORY_BYTES = 512 << 20, 2 << 30
"""Largest size of a reconstruction.json in bytes, and most memory in bytes that it may take (`parsed_bytes`). A million
points take 130 MB, or 350 MB with OpenSfM's indentation, and by the estimate up to 1.6 GB of memory."""
RECONSTRUCTION_HEAD_BYTES = 4096
"""Number of bytes at the beginning of a file by which a reconstruction.json with another name is recognised."""
NO_GPS_DOP = 1e5
"""`gps_dop` from which on a photograph counts as without GPS. OpenSfM writes 999999 for such photographs."""
MAX_PLANE_METRES = 1e5
"""Largest distance of the cameras from the place of the world's origin. The earth falls by 800 m over this distance."""
TWO_FOCAL_KINDS = ("brown", "radial", "simple_radial", "fisheye_opencv")
"""Values of `projection_type` with two focal lengths and a principal point.

All others have one focal length, and the principal point in the middle.
"""
EXPECTED_RECONSTRUCTION = "OpenSfM's or WebODM's reconstruction.json"


def find_reconstruction(folder: Path) -> Path | None:
    """Return the path of reconstruction.json in a folder or its sub-folder opensfm/; None if there is none.

    ODM's reconstruction.topocentric.json is preferred, as its cameras fit `reference_lla`.
    """
    names = (TOPOCENTRIC_FILE, RECONSTRUCTION_FILE)
    candidates = (parent / name for parent in (folder, folder / OPENSFM_FOLDER) for name in names)
    return next((path for path in candidates if is_file(path)), None)


def is_reconstruction(path: Path) -> bool:
    """Return True for a JSON list that begins with a reconstruction's cameras or photographs, as OpenSfM writes it."""
    if path.suffix.lower() != ".json":
        return False
    with open_input(path, EXPECTED_RECONSTRUCTION) as file:
        head = file.read(RECONSTRUCTION_HEAD_BYTES).lstrip(b"\xef\xbb\xbf \t\r\n")
    return head.startswith(b"[") and (b'"cameras"' in head or b'"shots"' in head)


def read_reconstruction(path: Path) -> DataSet:
    """Read the cameras and points of a reconstruction.json. The images have no paths.

    Of several reconstructions, the one with the most photographs is used, with a warning. Raises InputError that names
    the file and the camera or photograph for invalid JSON, missing or invalid values, and unsupported lenses.
    """
    parts = _parts(path)
    part = max(parts, key=lambda each: len(each["shots"]))
    if len(parts) > 1:
        others = sum(len(each["shots"]) for each in parts) - len(part["shots"])
        warn(
            f"{path}: holds {len(parts)} reconstructions with their own coordinate systems; the one with the most "
            f"photographs is used ({len(part['shots']):,}), without {others:,} photograph(s) of the others"
        )
    lenses = {
        key: _lens(Keys(path, f"camera {short(key)}", camera, {}))
        for key, camera in _objects(path, part, "cameras").items()
    }
    shots = {name: Keys(path, f"photograph {short(name)}", shot, {}) for name, shot in part["shots"].items()}
    images = [_image(name, shot, lenses) for name, shot in shots.items()]
    points, colors = _points(path, _objects(path, part, "points"))
    return DataSet(images, points, colors, georeference=_georeference(path, part, shots, images))


def _parts(path: Path) -> list[dict[str, Any]]:
    """Return the file's reconstructions that have photographs."""
    try:
        text = read_document(path, EXPECTED_RECONSTRUCTION, MAX_RECONSTRUCTION_BYTES, MAX_RECONSTRUCTION_MEMORY_BYTES)
        document = parse_json(text, once=True)
    except ValueError as error:
        raise InputError(f"{path}: is not JSON: {error}; expected {EXPECTED_RECONSTRUCTION}") from None
    if not isinstance(document, list) or not all(isinstance(part, dict) for part in document):
        raise InputError(f"{path}: is not a list of reconstructions, expected {EXPECTED_RECONSTRUCTION}")
    parts = [part for part in document if _objects(path, part, "shots")]
    if not parts:
        raise InputError(f"{path}: has no 'shots' (photographs with their poses); {EXPORT_AGAIN_ADVICE}")
    return parts


def _objects(path: Path, part: dict[str, Any], key: str) -> dict[str, dict[str, Any]]:
    """Return the JSON object of JSON objects under a key; empty if the reconstruction lacks the key."""
    given = part.get(key, {})
    if not isinstance(given, dict) or not all(isinstance(value, dict) for value in given.values()):
        raise InputError(f"{path}: '{key}' is {short(given)}, expected a JSON object of objects; {EXPORT_AGAIN_ADVICE}")
    return given


def _lens(keys: Keys) -> Lens:
    width, height = keys.side("width"), keys.side("height")
    kind = "" if keys.get("projection_type") is None else keys.text("projection_type")
    model = model_of_kind("opensfm", kind, keys.where)
    if model.wraps:
        return panorama(model, width, height, keys.where)
    longer = max(width, height)
    two = kind in TWO_FOCAL_KINDS
    focal = tuple(longer * keys.require(key) for key in (("focal_x", "focal_y") if two else ("focal", "focal")))
    centre = (keys.require("c_x", 0.0), keys.require("c_y", 0.0)) if two else (0.0, 0.0)
    k1, k2, k3, k4, p1, p2 = (keys.require(key, 0.0) for key in ("k1", "k2", "k3", "k4", "p1", "p2"))
    return SurveyLens(
        width,
        height,
        (focal[0], focal[1]),
        (longer * centre[0] + width / 2, longer * centre[1] + height / 2),
        (k1, k2, k3, k4),
        (p1, p2),
        is_fisheye=not model.flat,
    ).lens(keys.where)


def _image(name: str, shot: Keys, lenses: dict[str, Lens]) -> PosedImage:
    from scipy.spatial.transform import Rotation  # imported here, as the import takes 0.1 s and few commands need it

    camera = shot.text("camera")
    if camera not in lenses:
        raise InputError(f"{shot.where}: its camera {short(camera)} is not among the file's 'cameras'; export it again")
    turn, translation = shot.vector("rotation", 3), shot.vector("translation", 3)
    if not (np.abs([*turn, *translation]) < MAX_COORDINATE).all():
        raise shot.wrong("translation", "numbers of a possible size")
    rotation = np.asarray(Rotation.from_rotvec(turn).as_matrix(), np.float64)
    return PosedImage(inner_name(shot.where, name), lenses[camera], rotation, translation)


def _points(path: Path, points: dict[str, dict[str, Any]]) -> tuple[Float64, Float32]:
    rows = list(points.values())
    if not rows:
        return np.empty((0, 3)), np.empty((0, 3), np.float32)
    arrays = []
    for key in ("coordinates", "color"):
        values = numbers([row.get(key) for row in rows])
        if values.shape != (len(rows), 3) or not (np.abs(values) < MAX_COORDINATE).all():
            raise InputError(f"{path}: the points' '{key}' are not all three finite numbers; {EXPORT_AGAIN_ADVICE}")
        arrays.append(values)
    return arrays[0], np.clip(arrays[1] / 255, 0, 1).astype(np.float32)


def _georeference(
    path: Path, part: dict[str, Any], shots: dict[str, Keys], images: list[PosedImage]
) -> Georeference | None:
    """Return where the world's origin lies, from the reconstruction or the file beside it; None if it is unknown."""
    where, place = path, part.get("reference_lla")
    if place is None and is_file(path.parent / REFERENCE_FILE):
        where = path.parent / REFERENCE_FILE
        try:
            place = parse_json(read_document(where, "the place of the world's origin"))
        except ValueError as error:
            raise InputError(f"{where}: is not JSON: {error}; expected latitude, longitude and altitude") from None
    if place is None:
        return None
    if path.name == RECONSTRUCTION_FILE and is_file(path.with_name(TOPOCENTRIC_FILE)):
        warn(
            f"{path}: ODM brought its cameras to a map projection, which reference_lla does not fit; for their place "
            f"on the earth, give the folder or its {TOPOCENTRIC_FILE}"
        )
        return None
    if not isinstance(place, dict):
        raise InputError(f"{where}: 'reference_lla' is {short(place)}, expected latitude, longitude and altitude")
    keys = Keys(where, "reference_lla", place, {})
    latitude, longitude, altitude = (keys.require(key) for key in ("latitude", "longitude", "altitude"))
    if latitude == longitude == altitude == 0:  # OpenSfM's value for photographs without GPS
        return None
    if not (abs(latitude) <= 90 and abs(longitude) <= 360):
        raise keys.wrong("latitude" if abs(latitude) > 90 else "longitude", "degrees on the earth")
    centres = centres_of(images)
    away = float(np.linalg.norm(np.median(centres, axis=0)))
    if away > MAX_PLANE_METRES:
        warn(
            f"{path}: its cameras are {away / 1000:,.0f} km from its reference_lla, expected less than "
            f"{MAX_PLANE_METRES / 1000:g} km; they are in another coordinate system, and reference_lla is not used"
        )
        return None
    distances = {}
    for shot, image, centre in zip(shots.values(), images, centres, strict=True):
        if shot.get("gps_position") is not None and (shot.number("gps_dop") or 0.0) < NO_GPS_DOP:
            distances[image.name] = float(np.linalg.norm(shot.vector("gps_position", 3) - centre))
    note = "reference_lla of reconstruction.json: x east, y north, z up"
    return on_tangent_plane((latitude, longitude, altitude), note, GpsResiduals.of(path, distances))
