# SPDX-License-Identifier: Apache-2.0
"""Valid cameras of survey programs for `hostile`: reconstruction.json, Metashape's XML, RealityScan's XMP."""

from __future__ import annotations

import json
from collections.abc import Callable
from pathlib import Path

import ring
from survey_files import chunk_at, write_metashape, write_opensfm, write_xmp

from clsplat.scenes.geography.georeference import GEOREFERENCE_FILE, read_georeference

SURVEY_NAMES = ring.NAMES[:3]
"""Names of the pictures of a survey."""


def make_opensfm(folder: Path) -> None:
    """Write a reconstruction.json with few points, a place on the earth and GPS positions."""
    place = {"latitude": 48.1, "longitude": 11.5, "altitude": 500.0}
    path = write_opensfm(folder, ring.poses()[:3], SURVEY_NAMES, reference_lla=place)
    (part,) = json.loads(path.read_text())
    part["points"] = dict(list(part["points"].items())[:5])
    for shot in part["shots"].values():
        shot |= {"gps_position": [1.0, 2.0, 3.0], "gps_dop": 5.0}
    path.write_text(json.dumps([part]))


def make_metashape(folder: Path) -> None:
    """Write cameras.xml with a distorted lens."""
    calibration = "<f>40</f><cx>1</cx><cy>-1</cy><b1>0.5</b1><k1>0.01</k1><k2>0.002</k2><p1>0.001</p1>"
    write_metashape(folder, ring.poses()[:3], SURVEY_NAMES, world_from_chunk=chunk_at(), calibration=calibration)


def make_xmp(folder: Path) -> None:
    """Write XMP files beside pictures."""
    attributes = 'xcr:DistortionModel="brown3t2" xcr:DistortionCoeficients=".01 .002 0 0 .001 0"'
    write_xmp(folder, ring.poses()[:3], SURVEY_NAMES, attributes=attributes)


def make_georeference(folder: Path) -> None:
    """Write a georeference.json."""
    document = {"epsg": 32632, "origin": [5e5, 5e6, 100.0], "gps_residuals": {"photographs": 3, "rms": 1, "max": 2}}
    (folder / GEOREFERENCE_FILE).write_text(json.dumps(document))


SURVEYS: tuple[tuple[str, Callable[[Path], None], str], ...] = (
    ("opensfm", make_opensfm, "reconstruction.json"),
    ("metashape", make_metashape, "cameras.xml"),
)
"""Name of the reader, its maker, and the file that is given as the scene."""
XMP_NAMES = tuple(str(Path(name).with_suffix(".xmp")) for name in SURVEY_NAMES[:2])
"""XMP files that are spoilt. The last one stays, as a folder without XMP files is one of photographs."""


def read_place(folder: Path) -> None:
    """Read georeference.json as a scene does."""
    read_georeference(folder / GEOREFERENCE_FILE)
