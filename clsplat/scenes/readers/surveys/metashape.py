# SPDX-License-Identifier: Apache-2.0
"""Reading of the cameras that Metashape exports as XML (File, Export, Export Cameras, Agisoft XML).

Lenses: Agisoft Metashape User Manual, Professional Edition, appendix "Camera models". `cx cy` count from the picture's
middle, b1 is added to the focal length along x, and p1 and p2 are in the reverse of OpenCV's order. The layout of the
file has no specification; it is that of versions 1.5 to 2.2.

A camera's `transform` is `chunk_from_camera` in our axes. The `transform` of the camera's component, or else of the
chunk, goes from the chunk's coordinates to geocentric ones, or to the chunk's local system if it has one. Geocentric
cameras are moved to the plane that touches the ellipsoid near the cameras' middle: x east, y north, z up.
"""

from __future__ import annotations

import re
from collections.abc import Iterator, Sequence
from dataclasses import dataclass, replace
from pathlib import Path
from xml.etree.ElementTree import Element

import numpy as np

from clsplat.arrays import Float64
from clsplat.errors import InputError, examples, warn
from clsplat.files.documents import open_input
from clsplat.files.xml_documents import read_xml
from clsplat.models.edit import decompose
from clsplat.scenes.camera_json import short
from clsplat.scenes.dataset import MAX_COORDINATE, DataSet, Lens, PosedImage
from clsplat.scenes.geography.georeference import (
    Georeference,
    GpsResiduals,
    geocentric_of,
    on_tangent_plane,
    place_of,
)
from clsplat.scenes.readers.surveys.lenses import UNDISTORTED_ADVICE, SurveyLens, model_of_kind, panorama
from clsplat.scenes.readers.surveys.values import centres_of, inner_name, numbers_in

METASHAPE_HEAD_BYTES = 4096
"""Number of bytes at the beginning of an XML file by which Metashape's cameras are recognised."""
EXPECTED_METASHAPE = "Metashape's cameras (.xml)"
MAX_SKEW_SHIFT_PX = 0.5
"""Largest shift of a pixel, in pixels, by the skew b2 that is left out."""
EARTH_RADII = 6.2e6, 6.5e6
"""Least and largest distance from the earth's centre, in metres, of cameras in geocentric coordinates."""
ROTATION_SLACK = 1e-4
"""Largest deviation of a transform from a similarity. Metashape may write 8 decimals of a scaled rotation."""


def find_metashape(folder: Path) -> Path | None:
    """Return the path of Metashape's cameras in a folder; None if there are none. Raises InputError for several."""
    found = [path for path in sorted(folder.glob("*.[xX][mM][lL]")) if path.is_file() and is_metashape(path)]
    if len(found) > 1:
        raise InputError(
            f"{folder}: holds {examples(path.name for path in found)}, which are all cameras of Metashape, each with "
            "its own coordinate system, expected one; give the path of the file instead of the folder"
        )
    return found[0] if found else None


def is_metashape(path: Path) -> bool:
    """Return True for an XML file that begins with the document and chunk of Metashape's cameras."""
    if path.suffix.lower() != ".xml":
        return False
    with open_input(path, EXPECTED_METASHAPE) as file:
        head = file.read(METASHAPE_HEAD_BYTES)
    return b"<document" in head and b"<chunk" in head


def read_metashape(path: Path) -> DataSet:
    """Read the aligned and enabled cameras of an XML file. The images have no paths, and there are no points.

    Raises InputError that names the file and the camera or sensor for invalid XML, missing or invalid values, several
    coordinate systems, and unsupported lenses.
    """
    root = read_xml(path, EXPECTED_METASHAPE)
    chunks = [chunk for chunk in root.iterfind("chunk") if any(_aligned(chunk))]
    if not chunks:
        raise InputError(f"{path}: has no aligned cameras (a <camera> with a <transform>); align the photographs first")
    if len(chunks) > 1:
        labels = examples(short(chunk.get("label", "")) for chunk in chunks)
        raise InputError(
            f"{path}: has cameras in {len(chunks)} chunks with their own coordinate systems ({labels}), expected one; "
            "export the cameras of one chunk"
        )
    (chunk,) = chunks
    lenses = _Sensors(path, chunk)
    cameras = [_Camera(path, element) for element in _aligned(chunk)]
    moves = _transforms(path, chunk, cameras)
    images = [camera.image(lenses, move) for camera, move in zip(cameras, moves, strict=True)]
    lenses.warn_of_skew()
    images, georeference = _on_earth(chunk, cameras, images)
    return DataSet(images, georeference=georeference)


def _aligned(chunk: Element) -> Iterator[Element]:
    """Yield the camera elements that have a pose and are not disabled, also those in groups."""
    for camera in chunk.iterfind("cameras//camera"):
        if camera.find("transform") is not None and camera.get("enabled", "true") not in ("false", "0"):
            yield camera


@dataclass(frozen=True)
class _Camera:
    """A camera element of a file."""

    path: Path
    element: Element

    @property
    def label(self) -> str:
        return self.element.get("label", "")

    @property
    def where(self) -> str:
        return f"{self.path}: camera {short(self.label)}"

    @property
    def component(self) -> str | None:
        return self.element.get("component_id")

    def image(self, lenses: _Sensors, move: Float64) -> PosedImage:
        """Return the image. move: (4, 4), similarity from the chunk to the world."""
        pose = _numbers(self.element.find("transform"), f"{self.where}: <transform>", 16).reshape(4, 4)
        _, turn, shift = _similarity(move @ pose, f"{self.where}: <transform>")
        name = inner_name(self.where, self.label)
        return PosedImage(name, lenses.lens(self.where, self.element.get("sensor_id", "")), turn.T, -turn.T @ shift)

    def reference(self) -> Float64 | None:
        """Return the reference coordinates (3,), from GPS or a file; None if there are none or they are not used."""
        given = self.element.find("reference")
        if given is None or given.get("enabled", "true") in ("false", "0"):
            return None
        try:
            place = np.array([float(given.get(axis, "")) for axis in "xyz"])
        except ValueError:
            return None
        return place if (np.abs(place) < MAX_COORDINATE).all() else None


class _Sensors:
    """The lenses of a chunk, read when a camera needs them."""

    def __init__(self, path: Path, chunk: Element) -> None:
        self._path = path
        self._sensors = {sensor.get("id", ""): sensor for sensor in chunk.iterfind("sensors/sensor")}
        self._lenses: dict[str, Lens] = {}
        self._skews: list[str] = []

    def lens(self, where: str, key: str) -> Lens:
        """Return the lens of a sensor. where: the camera, for messages. key: the sensor's id."""
        if key not in self._sensors:
            raise InputError(f"{where}: its sensor {short(key)} is not among the file's <sensors>; export it again")
        if key not in self._lenses:
            self._lenses[key] = self._read(self._sensors[key], f"{self._path}: sensor {short(key)}")
        return self._lenses[key]

    def warn_of_skew(self) -> None:
        """Warn of skews that were left out."""
        if self._skews:
            warn(f"{self._path}: the skew b2 is left out, which moves pixels by up to {examples(self._skews)}")

    def _read(self, sensor: Element, where: str) -> Lens:
        found = sensor.findall("calibration")
        adjusted = [each for each in found if each.get("class") == "adjusted"]
        calibration = next(iter([*adjusted, *found]), None)
        kind = (sensor if calibration is None else calibration).get("type", "") or sensor.get("type", "frame")
        sizes = [None if calibration is None else calibration.find("resolution"), sensor.find("resolution")]
        width, height = _size(next((each for each in sizes if each is not None), None), where)
        model = model_of_kind("metashape", kind, where)
        if model.wraps:
            return panorama(model, width, height, where)
        if calibration is None:
            raise InputError(f"{where}: has no <calibration>; align the photographs and export the cameras again")
        values = _Calibration(calibration, where)
        for term in ("p3", "p4"):
            if values.get(term):
                raise InputError(
                    f"{where}: its distortion has {term} = {values.get(term):g}, expected 0, as no lens model here has "
                    f"this term; {UNDISTORTED_ADVICE}, or calibrate without {term}"
                )
        focal, cx, cy = values.require("f"), values.get("cx"), values.get("cy")
        lens = SurveyLens(
            width,
            height,
            (focal + values.get("b1"), focal),
            (width / 2 + cx, height / 2 + cy),
            (values.get("k1"), values.get("k2"), values.get("k3"), values.get("k4")),
            (values.get("p2"), values.get("p1")),
            is_fisheye=not model.flat,
        ).lens(where)
        self._check_skew(values.get("b2"), (height / 2 + abs(cy)) / focal, where)
        return lens

    def _check_skew(self, skew: float, highest: float, where: str) -> None:
        """Note a skew, or raise InputError for a large one.

        skew: b2, the shift along x in pixels per unit of the coordinate y of the distorted ray.
        highest: largest coordinate y of a distorted ray in the picture.
        """
        shift = abs(skew) * highest
        if shift > MAX_SKEW_SHIFT_PX:
            raise InputError(
                f"{where}: the skew b2 = {skew:g} moves pixels by up to {shift:.2g}, expected at most "
                f"{MAX_SKEW_SHIFT_PX:g}, as no lens model here has a skew; {UNDISTORTED_ADVICE}, or do not fit b2"
            )
        if shift:
            self._skews.append(f"{shift:.2g} pixels ({where.rpartition(': ')[2]})")


class _Calibration:
    """The values of a calibration element. where: beginning of error messages."""

    def __init__(self, element: Element, where: str) -> None:
        self._element, self._where = element, where

    def get(self, name: str) -> float:
        """Return a value, or 0 if there is none."""
        element = self._element.find(name)
        return 0.0 if element is None else float(_numbers(element, f"{self._where}: <{name}>", 1)[0])

    def require(self, name: str) -> float:
        return float(_numbers(self._element.find(name), f"{self._where}: <{name}>", 1)[0])


def _numbers(element: Element | None, where: str, count: int) -> Float64:
    """Return the numbers (count,) in an element's text. Raises InputError for a missing element, and other text.

    where: file, part and element, for messages.
    """
    text = "" if element is None else element.text or ""
    values = numbers_in(text, count)
    if values is None:
        found = "is missing" if element is None else f"is {short(text.strip())}"
        numbers = "a number" if count == 1 else f"{count} numbers"
        raise InputError(f"{where} {found}, expected {numbers}; export the cameras again")
    return values


def _size(resolution: Element | None, where: str) -> tuple[int, int]:
    sides = ("", "") if resolution is None else (resolution.get("width", ""), resolution.get("height", ""))
    try:
        width, height = (int(side) for side in sides)
    except ValueError:
        raise InputError(
            f"{where}: its <resolution> is {short(' x '.join(sides))}, expected width and height in pixels"
        ) from None
    return width, height


def _similarity(matrix: Float64, where: str) -> tuple[float, Float64, Float64]:
    """Return scale, rotation (3, 3) and translation (3,) of a matrix (4, 4). Raises InputError for other matrices."""
    try:
        scale, turn, shift = decompose(matrix, ROTATION_SLACK)
    except InputError:
        raise InputError(f"{where} contains no rotation, expected a pose; export the cameras again") from None
    if np.linalg.det(turn) < 0:
        raise InputError(f"{where} mirrors, expected a rotation; export the cameras again")
    return scale, turn, shift


def _transforms(path: Path, chunk: Element, cameras: Sequence[_Camera]) -> list[Float64]:
    """Return the similarity (4, 4) from the chunk to the world, for each camera.

    Raises InputError for cameras in several components that have no common coordinate system.
    """
    own = {
        component.get("id", ""): _matrix(component.find("transform"), f"{path}: component {component.get('id', '')}")
        for component in chunk.iterfind("components/component")
    }
    whole = _matrix(chunk.find("transform"), f"{path}: chunk")
    used = dict.fromkeys(camera.component for camera in cameras)
    loose = [key for key in used if own.get(key or "") is None]
    if len(used) > 1 and loose:
        raise InputError(
            f"{path}: has cameras in {len(used)} components, and {examples(map(short, loose))} has no <transform> to a "
            "common coordinate system; align all photographs together, or export one component"
        )
    usual = np.eye(4) if whole is None else whole
    found = {key: own.get(key or "") for key in used}
    matrices = {key: usual if matrix is None else matrix for key, matrix in found.items()}
    return [matrices[camera.component] for camera in cameras]


def _matrix(element: Element | None, where: str) -> Float64 | None:
    """Return a transform element as a matrix (4, 4): 16 numbers, or elements of rotation, translation and scale."""
    if element is None:
        return None
    if not len(element):
        matrix = _numbers(element, f"{where}: <transform>", 16).reshape(4, 4)
    else:
        rotation, translation, scale = (element.find(name) for name in ("rotation", "translation", "scale"))
        matrix = np.eye(4)
        factor = 1.0 if scale is None else float(_numbers(scale, f"{where}: <scale>", 1)[0])
        if rotation is not None:
            matrix[:3, :3] = _numbers(rotation, f"{where}: <rotation>", 9).reshape(3, 3)
        matrix[:3, :3] *= factor
        if translation is not None:
            matrix[:3, 3] = _numbers(translation, f"{where}: <translation>", 3)
    scale_of, turn, shift = _similarity(matrix, f"{where}: <transform>")
    matrix = np.eye(4)
    matrix[:3, :3], matrix[:3, 3] = scale_of * turn, shift
    return matrix


def _on_earth(
    chunk: Element, cameras: Sequence[_Camera], images: list[PosedImage]
) -> tuple[list[PosedImage], Georeference | None]:
    """Return the images and their georeference. Geocentric images are brought to a tangent plane; others stay."""
    system = (chunk.findtext("reference") or "").strip()
    centres = centres_of(images)
    middle = np.median(centres, axis=0)
    is_local = system.upper().startswith(("LOCAL", "ENGCRS", "ENGINEERING"))
    if is_local or not EARTH_RADII[0] < np.linalg.norm(middle) < EARTH_RADII[1]:
        return images, None
    latitude, longitude, altitude = place_of(middle)
    place = (round(latitude, 5), round(longitude, 5), float(round(altitude)))
    codes = re.findall(r'"EPSG"\s*,\s*"?(\d{1,9})"?', system)
    named = f" in EPSG:{codes[-1]}" if codes else ""
    note = f"the chunk{named} of Metashape's cameras: x east, y north, z up, metres"
    distances = {}
    if system.upper().startswith(("GEOGCS", "GEOGCRS", "GEODCRS")):
        for camera, image, centre in zip(cameras, images, centres, strict=True):
            at = camera.reference()
            if at is not None and abs(at[1]) <= 90 and abs(at[0]) <= 360:
                distances[image.name] = float(np.linalg.norm(geocentric_of((at[1], at[0], at[2])) - centre))
    found = on_tangent_plane(place, note, GpsResiduals.of(cameras[0].path, distances))
    moved = []
    for image, centre in zip(images, centres, strict=True):
        rotation = image.rotation @ found.transform
        moved.append(
            replace(image, rotation=rotation, translation=-rotation @ (found.transform.T @ (centre - found.origin)))
        )
    return moved, found
