# SPDX-License-Identifier: Apache-2.0
"""Position and gravity of a photograph from its metadata: EXIF's GPS tags, Apple's maker note, and drones' XMP.

Sources: Exif 2.32 (GPS IFD); ExifTool's tables of Apple's AccelerationVector and DJI's gimbal angles.
"""

from __future__ import annotations

import re
import struct
from dataclasses import dataclass
from math import cos, isfinite, radians, sin
from pathlib import Path
from typing import Any

import numpy as np

from clsplat.arrays import Float64
from clsplat.images.decoders.decoded_photo import EXIF_ORIENTATION_ATTRIBUTE
from clsplat.images.exif import header_of

MAX_METADATA_BYTES = 1 << 18
"""Number of bytes at the beginning of a file that are searched for a maker note and XMP."""
_APPLE_NOTE = b"Apple iOS\0\0\1MM"
_APPLE_ACCELERATION_TAG, _SIGNED_RATIONAL = 8, 10
_GIMBAL_ANGLE = re.compile(rb'Gimbal(Pitch|Roll)Degree\s*(?:=\s*"|>)\s*([-+]?\d{1,4}(?:\.\d{1,9})?)')
# Rotation from CoreMotion's axes of an iPhone (x right, y up, z out of the screen) to the axes of the upright picture
# (x right, y down, z forward), by EXIF orientation. Orientation 1 is landscape with the top of the phone at the left.
_PICTURE_FROM_PHONE = {
    1: ((0, -1, 0), (-1, 0, 0), (0, 0, -1)),
    3: ((0, 1, 0), (1, 0, 0), (0, 0, -1)),
    6: ((1, 0, 0), (0, -1, 0), (0, 0, -1)),
    8: ((-1, 0, 0), (0, 1, 0), (0, 0, -1)),
}


@dataclass(frozen=True)
class GpsPosition:
    """Position on the WGS 84 ellipsoid.

    latitude, longitude: in degrees, north and east positive.
    altitude: in metres above sea level, as the device gives it; None if the file has none.
    """

    latitude: float
    longitude: float
    altitude: float | None


def gps_of(path: Path) -> GpsPosition | None:
    """Return the position in a photograph's EXIF; None if EXIF has no valid one, or the file cannot be read."""
    spec = header_of(path)
    if spec is None or spec.get_string_attribute("GPS:Status") == "V":  # the device had no position ("void")
        return None
    latitude = _degrees(spec, "Latitude", "S", 90.0)
    longitude = _degrees(spec, "Longitude", "W", 180.0)
    if latitude is None or longitude is None or (latitude, longitude) == (0.0, 0.0):
        return None
    altitude = spec.get_float_attribute("GPS:Altitude", float("nan"))
    if spec.get_int_attribute("GPS:AltitudeRef", 0) == 1:
        altitude = -altitude
    return GpsPosition(latitude, longitude, altitude if isfinite(altitude) and abs(altitude) < 1e5 else None)


def _degrees(spec: Any, name: str, negative: str, most: float) -> float | None:
    """Return the angle of a GPS tag in degrees; None if it is missing or over `most`.

    name: "Latitude" or "Longitude". negative: letter of the hemisphere with negative angles.
    """
    value = spec.getattribute(f"GPS:{name}")
    parts = value if isinstance(value, tuple) else (value,)
    if not 1 <= len(parts) <= 3 or not all(isinstance(part, int | float) and isfinite(part) for part in parts):
        return None
    degrees: float = sum(float(part) / 60**place for place, part in enumerate(parts))
    if not abs(degrees) <= most:
        return None
    reference = str(spec.get_string_attribute(f"GPS:{name}Ref"))
    return -degrees if reference.upper().startswith(negative) else degrees


def gravity_of(path: Path, *, upright: bool) -> Float64 | None:
    """Return the direction of gravity, a unit vector (3,) in the picture's axes: x right, y down, z forward.

    The direction comes from an iPhone's accelerometer or a DJI drone's gimbal angles; None if the file has neither.

    upright: True for the axes of the picture after its EXIF orientation, False for those of the pixels as stored.
    """
    try:
        with open(path, "rb") as file:
            data = file.read(MAX_METADATA_BYTES)
    except OSError:
        return None
    angles = {name: float(degrees) for name, degrees in _GIMBAL_ANGLE.findall(data)}
    if b"Pitch" in angles:  # the pitch is -90 where the camera looks straight down
        pitch, roll = radians(angles[b"Pitch"]), radians(angles.get(b"Roll", 0.0))
        level = np.array([0.0, cos(pitch), -sin(pitch)])
        return np.array([level[1] * sin(roll), level[1] * cos(roll), level[2]])
    acceleration = _apple_acceleration(data)
    if acceleration is None:
        return None
    orientation = _orientation(path, upright=upright)
    if orientation not in _PICTURE_FROM_PHONE:
        return None
    axes = np.array(_PICTURE_FROM_PHONE[orientation], np.float64)
    gravity = axes @ acceleration
    return np.asarray(gravity / np.linalg.norm(gravity))


def _orientation(path: Path, *, upright: bool) -> int:
    """Return the EXIF orientation that turns the sensor's picture to the picture whose axes are wanted; 0 if unknown.

    upright: as for `gravity_of`. The decoded pixels of HEIF and AVIF, as stored, are upright already.
    """
    spec = header_of(path)
    if spec is None:
        return 0
    if orientation := int(spec.get_int_attribute("Orientation", 0)):
        return orientation if upright or orientation not in _PICTURE_FROM_PHONE else 1
    return int(spec.get_int_attribute(EXIF_ORIENTATION_ATTRIBUTE, 1))


def _apple_acceleration(data: bytes) -> Float64 | None:
    """Return the accelerometer's vector (3,), in multiples of g, from Apple's maker note.

    None if the data has no such vector, or if its length is not near 1.
    """
    at = data.find(_APPLE_NOTE)
    if at < 0:
        return None
    note = data[at:]
    try:
        (count,) = struct.unpack_from(">H", note, 14)
        for entry in range(min(count, 200)):
            tag, kind, length, offset = struct.unpack_from(">HHII", note, 16 + 12 * entry)
            if (tag, kind, length) == (_APPLE_ACCELERATION_TAG, _SIGNED_RATIONAL, 3):
                numbers = struct.unpack_from(">6i", note, offset)
                vector = np.array([a / b for a, b in zip(numbers[::2], numbers[1::2], strict=True)])
                # while the phone is shaken, its accelerometer does not show gravity
                return vector if 0.8 < np.linalg.norm(vector) < 1.2 else None
    except (struct.error, ZeroDivisionError):
        pass
    return None
