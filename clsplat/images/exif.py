# SPDX-License-Identifier: Apache-2.0
"""Exposure of a photograph (exposure time, ISO speed, f-number) from its EXIF data.

Orientation: `images/reading.py`.
"""

from __future__ import annotations

import math
from pathlib import Path

from clsplat.errors import InputError
from clsplat.images.reading import open_image

_EXIF_ISO_TAGS = ("Exif:PhotographicSensitivity", "Exif:ISOSpeedRatings", "Exif:ISOSpeed")


def exposure_of(path: Path) -> float | None:
    """Return log2(exposure time * ISO speed / f-number^2) of a photograph, with the time in seconds.

    Returns None if the file lacks one of these values or cannot be read.
    """
    try:
        source = open_image(path)
    except InputError:
        return None
    spec = source.spec()
    source.close()
    time, stop = spec.get_float_attribute("ExposureTime", 0.0), spec.get_float_attribute("FNumber", 0.0)
    speed = next((value for name in _EXIF_ISO_TAGS if (value := spec.get_int_attribute(name, 0)) > 0), 0)
    known = all(0 < value < math.inf for value in (time, stop, speed))
    return math.log2(time * speed / stop**2) if known else None
