# SPDX-License-Identifier: Apache-2.0
"""georeference.json, the record of where a scene lies on the earth: a coordinate reference system and a similarity.

The file applies to the coordinates of the files that it lies beside: the cameras of a scene, where users may write it,
or the model of a run. The record of a model file such as NAME.splat is NAME.georeference.json.
"""

from __future__ import annotations

import json
from collections.abc import Mapping
from dataclasses import dataclass, field, replace
from pathlib import Path
from typing import Any

import numpy as np

from clsplat.arrays import Float64, numbers
from clsplat.errors import InputError, examples, warn
from clsplat.files.documents import is_file, load_document

GEOREFERENCE_FILE = "georeference.json"
"""Name of the record's file."""
MAX_GEOREFERENCE_BYTES = 1 << 20
"""Size limit of georeference.json in bytes."""
GEOCENTRIC_EPSG = 4978
"""EPSG code of WGS 84 geocentric coordinates (x, y, z in metres from the earth's centre)."""
GEOGRAPHIC_EPSG_CODES = range(4000, 5000)
"""EPSG codes of systems with latitude and longitude in degrees. METRIC_EPSG_RANGES has the exceptions."""
OTHER_GEOGRAPHIC_EPSG_CODES = (6318, 6668, 7844)
"""EPSG codes of further widely used systems in degrees: NAD83(2011), JGD2011 and GDA2020."""
METRIC_EPSG_RANGES = (
    (4026, 4026), (4037, 4038), (4048, 4051), (4056, 4071), (4082, 4100), (4217, 4217), (4390, 4462), (4467, 4467),
    (4471, 4471), (4474, 4474), (4484, 4489), (4491, 4554), (4559, 4589), (4647, 4656), (4766, 4800), (4812, 4812),
    (4822, 4822), (4826, 4880), (4936, 4936), (GEOCENTRIC_EPSG, GEOCENTRIC_EPSG),
)  # fmt: skip
"""First and last codes of projected and geocentric systems among GEOGRAPHIC_EPSG_CODES, such as China's Gauss-Kruger
zones (4491 to 4554) and UTM zone 32 with its number before the easting (4647). From version 11.022 of the data set."""
MAX_EPSG_CODE = 1_000_000
"""EPSG codes are less than this number."""
SIMILARITY_SLACK = 1e-6
"""Largest relative deviation of a transform from a rotation times a scale. Numbers with 7 digits deviate by less."""
MAX_TRANSFORM_VALUE = 1e12
"""Limit of the values of a transform. Squares of much larger values may overflow."""
DOUBTED_MEDIANS, MIN_DOUBTED_METRES = 6.0, 30.0
"""A GPS position is not used if its distance from its camera is over DOUBTED_MEDIANS times the median distance and over
MIN_DOUBTED_METRES."""
_EXPECTED_GEOREFERENCE = "the record of where a scene lies on the earth"


@dataclass(frozen=True)
class GpsResiduals:
    """Distances in metres between the cameras and the GPS positions of their photographs.

    count: number of photographs whose GPS position is used.
    rms, largest: root mean square and maximum of the distances.
    """

    count: int
    rms: float
    largest: float

    @classmethod
    def of(cls, where: object, distances: Mapping[str, float]) -> GpsResiduals | None:
        """Summarise distances in metres, by the photographs' names. Leaves out positions that are far off.

        where: the file, for the warning that names photographs whose position is far off.
        Returns None if there are no distances.
        """
        if not distances:
            return None
        limit = max(DOUBTED_MEDIANS * float(np.median([*distances.values()])), MIN_DOUBTED_METRES)
        if far := [f"{name} by {metres:,.0f} m" for name, metres in distances.items() if metres > limit]:
            warn(f"{where}: GPS of {len(far):,} photograph(s) is far from the cameras and not used: {examples(far)}")
        near = np.array([metres for metres in distances.values() if metres <= limit])
        return cls(len(near), float(np.sqrt(np.mean(near**2))), float(near.max()))


@dataclass(frozen=True, eq=False)
class Georeference:
    """Position of a scene or model on the earth: crs = origin + transform @ p, for points p of the scene or model.

    epsg: code of the coordinate reference system, whose coordinates are in metres. 4978 is geocentric.
    origin: (3,), coordinates of the world's origin in the reference system.
    transform: (3, 3), rotation times scale from the world to the reference system.
    residuals: distances of the cameras from GPS positions; None if these are unknown.
    note: source of the georeference, for the user.
    """

    epsg: int
    origin: Float64 = field(default_factory=lambda: np.zeros(3))
    transform: Float64 = field(default_factory=lambda: np.eye(3))
    residuals: GpsResiduals | None = None
    note: str = ""

    def moved(self, change: Float64) -> Georeference:
        """Return the georeference of the scene or model after a change by a similarity (4, 4)."""
        back = np.linalg.inv(change)
        transform = self.transform @ back[:3, :3]
        return replace(self, origin=self.origin + self.transform @ back[:3, 3], transform=transform)

    @property
    def summary(self) -> str:
        """The reference system, the origin and the distances from GPS positions, as text on one line."""
        place = ", ".join(f"{value:.12g}" for value in self.origin)
        text = f"EPSG:{self.epsg}, origin {place}"
        if self.epsg == GEOCENTRIC_EPSG:
            latitude, longitude, altitude = place_of(self.origin)
            text += f" (latitude {latitude:.7f}, longitude {longitude:.7f}, altitude {altitude:.2f} m)"
        if (known := self.residuals) is not None:
            text += f"; GPS of {known.count:,} photographs: rms {known.rms:.3g} m, at most {known.largest:.3g} m"
        return text

    def document(self) -> dict[str, Any]:
        """Return the content of georeference.json."""
        known = self.residuals
        residuals = None if known is None else {"photographs": known.count, "rms": known.rms, "max": known.largest}
        return {
            "epsg": self.epsg,
            "origin": self.origin.tolist(),
            "transform": self.transform.tolist(),
            "gps_residuals": residuals,
            "note": self.note,
        }

    def content(self) -> bytes:
        """Return the content of georeference.json."""
        return (json.dumps(self.document(), indent=2) + "\n").encode()


def on_tangent_plane(place: tuple[float, float, float], note: str, residuals: GpsResiduals | None) -> Georeference:
    """Return the georeference of a frame with x east, y north and z up, in metres, from a place on WGS 84.

    place: latitude and longitude in degrees, and altitude in metres.
    """
    latitude, longitude = np.deg2rad(place[:2])
    east = [-np.sin(longitude), np.cos(longitude), 0.0]
    north = [-np.sin(latitude) * np.cos(longitude), -np.sin(latitude) * np.sin(longitude), np.cos(latitude)]
    up = [np.cos(latitude) * np.cos(longitude), np.cos(latitude) * np.sin(longitude), np.sin(latitude)]
    return Georeference(GEOCENTRIC_EPSG, geocentric_of(place), np.array([east, north, up]).T, residuals, note)


def geocentric_of(place: tuple[float, float, float]) -> Float64:
    """Return geocentric coordinates (3,) of latitude and longitude in degrees and altitude in metres, on WGS 84."""
    import pycolmap

    transform = pycolmap.GPSTransform(pycolmap.GPSTransformEllipsoid.WGS84)
    return np.asarray(transform.ellipsoid_to_ecef(np.array([place], np.float64))[0], np.float64)


def place_of(geocentric: Float64) -> tuple[float, float, float]:
    """Return latitude and longitude in degrees and altitude in metres on WGS 84, of geocentric coordinates (3,)."""
    import pycolmap

    transform = pycolmap.GPSTransform(pycolmap.GPSTransformEllipsoid.WGS84)
    latitude, longitude, altitude = transform.ecef_to_ellipsoid(np.asarray(geocentric, np.float64)[None])[0].tolist()
    return latitude, longitude, altitude


def beside_model(path: Path) -> Path:
    """Return the path of the record of a model file."""
    return path.with_name(f"{path.stem}.{GEOREFERENCE_FILE}")


def read_of_model(path: Path) -> Georeference | None:
    """Read the record of a model file: the file's own, or for model.ply the folder's; None if there is none.

    Raises InputError for a damaged file.
    """
    own = read_georeference(beside_model(path))
    return own if own is not None or path.name != "model.ply" else read_georeference(path.parent / GEOREFERENCE_FILE)


def read_georeference(path: Path) -> Georeference | None:
    """Read the record in the file `path`; None if there is no such file.

    Only `epsg` is required. If the file has no `origin` and no `transform`, the scene uses the reference system itself.
    Raises InputError for a damaged file, and for a reference system in degrees.
    """
    if not is_file(path):
        return None
    document = load_document(path, _EXPECTED_GEOREFERENCE, "'epsg'", MAX_GEOREFERENCE_BYTES)
    origin, transform = (document.get(key) for key in ("origin", "transform"))
    place = np.zeros(3) if origin is None else numbers(origin)
    if place.shape != (3,) or not np.isfinite(place).all():
        raise InputError(f"{path}: 'origin' is {str(origin)[:60]}, expected three numbers")
    axes = np.eye(3) if transform is None else numbers(transform)
    if not _is_similarity(axes):
        raise InputError(f"{path}: 'transform' is {str(transform)[:60]}, expected a rotation times a scale (3 x 3)")
    note = document.get("note")
    residuals = _residuals(document.get("gps_residuals"))
    return Georeference(
        _epsg(path, document.get("epsg")), place, axes, residuals, note if isinstance(note, str) else ""
    )


def _epsg(path: Path, code: Any) -> int:
    if isinstance(code, bool) or not isinstance(code, int) or not 0 < code < MAX_EPSG_CODE:
        found = "has no 'epsg'" if code is None else f"'epsg' is {str(code)[:60]}"
        raise InputError(f"{path}: {found}, expected the number of an EPSG code, such as 32632")
    is_metric = any(first <= code <= last for first, last in METRIC_EPSG_RANGES)
    if code in OTHER_GEOGRAPHIC_EPSG_CODES or (code in GEOGRAPHIC_EPSG_CODES and not is_metric):
        raise InputError(
            f"{path}: EPSG:{code} counts in degrees, expected a coordinate reference system in metres, such as a UTM "
            "zone (32632); export the cameras again in such a system"
        )
    return code


def _residuals(given: Any) -> GpsResiduals | None:
    values = numbers([given.get(key) for key in ("photographs", "rms", "max")] if isinstance(given, dict) else None)
    if values.shape != (3,) or not np.isfinite(values).all():
        return None
    return GpsResiduals(int(values[0]), float(values[1]), float(values[2]))


def _is_similarity(axes: Float64) -> bool:
    if axes.shape != (3, 3) or not (np.abs(axes) < MAX_TRANSFORM_VALUE).all():
        return False
    squares = axes.T @ axes
    size = float(np.trace(squares)) / 3
    return bool(
        size > 0 and np.linalg.det(axes) > 0 and np.abs(squares - size * np.eye(3)).max() <= SIMILARITY_SLACK * size
    )
