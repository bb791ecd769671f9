# SPDX-License-Identifier: Apache-2.0
"""Exposure of a photograph (exposure time, ISO speed, f-number), its camera and its lens, from its EXIF data.

Orientation: `images/reading.py`. Of raw photographs, focal length and lens are those that LibRaw finds, which reads
cameras' MakerNotes too.
"""

from __future__ import annotations

import math
from pathlib import Path
from typing import Any

from clsplat.errors import InputError
from clsplat.images.reading import open_photograph

_EXIF_ISO_TAGS = ("Exif:PhotographicSensitivity", "Exif:ISOSpeedRatings", "Exif:ISOSpeed")


def header_of(path: Path) -> Any | None:
    """Return OpenImageIO's specification of a photograph, with its EXIF data; None if the file cannot be read."""
    try:
        source = open_photograph(path)
    except InputError:
        return None
    spec = source.spec()
    source.close()
    return spec


def exposure_of(path: Path) -> float | None:
    """Return log2(exposure time * ISO speed / f-number^2) of a photograph, with the time in seconds.

    Returns None if the file lacks one of these values or cannot be read.
    """
    spec = header_of(path)
    if spec is None:
        return None
    time, stop = spec.get_float_attribute("ExposureTime", 0.0), spec.get_float_attribute("FNumber", 0.0)
    speed = next((value for name in _EXIF_ISO_TAGS if (value := spec.get_int_attribute(name, 0)) > 0), 0)
    known = all(0 < value < math.inf for value in (time, stop, speed))
    return math.log2(time * speed / stop**2) if known else None


def lens_of(spec: Any) -> tuple[str, ...]:
    """Return a photograph's camera and lens as texts, "" for missing ones, from OpenImageIO's specification.

    They are the camera's make and model, the lens's model, the focal length in millimetres and its 35 mm equivalent,
    which tells digital zoom.
    """
    focal = spec.get_float_attribute("Exif:FocalLength", 0.0)
    equivalent = spec.get_int_attribute("Exif:FocalLengthIn35mmFilm", 0)
    names = (spec.get_string_attribute(name) for name in ("Make", "Model", "Exif:LensModel"))
    return (*names, f"{focal:.3f}" if focal else "", str(equivalent) if equivalent else "")
