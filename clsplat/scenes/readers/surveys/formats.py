# SPDX-License-Identifier: Apache-2.0
"""The table of survey formats: how the file of cameras is found, and which reader reads it."""

from __future__ import annotations

from collections import Counter
from collections.abc import Callable, Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import NamedTuple

import numpy as np

from clsplat.errors import InputError, examples
from clsplat.files.documents import is_file
from clsplat.scenes.dataset import DataSet, PosedImage
from clsplat.scenes.readers.surveys.metashape import EXPECTED_METASHAPE, find_metashape, is_metashape, read_metashape
from clsplat.scenes.readers.surveys.opensfm import (
    EXPECTED_RECONSTRUCTION,
    OPENSFM_FOLDER,
    find_reconstruction,
    is_reconstruction,
    read_reconstruction,
)
from clsplat.scenes.readers.surveys.realityscan import XMP_FILES, find_xmp, read_xmp
from clsplat.scenes.readers.surveys.values import centres_of

MIN_SPREAD_DEGREES, MAX_SPREAD_DEGREES = 1e-5, 0.5
"""Least and largest extent, along x and y, of positions that may be degrees of longitude and latitude."""
MIN_HEIGHT_PER_DEGREE = 300.0
"""Ratio of the extent in z to the larger one in x and y, above which positions count as metres over degrees.

A flight of 1 km whose heights differ by 1 m has a ratio of 111 in degrees.
"""


@dataclass(frozen=True)
class SurveyFormat:
    """A format of survey cameras.

    name: the file in words, for messages.
    find: function that returns the path of the file in a scene's folder; None if there is none.
    is_one: function that returns True for a file of this format.
    read: function that reads the file. Its second argument is the folder of photographs that the user gave, or None.
        The images have no paths.
    is_folder: True if the cameras are in files beside the photographs.
    """

    name: str
    find: Callable[[Path], Path | None]
    is_one: Callable[[Path], bool]
    read: Callable[[Path, Path | None], DataSet]
    is_folder: bool = False


SURVEY_FORMATS = (
    SurveyFormat(
        EXPECTED_RECONSTRUCTION, find_reconstruction, is_reconstruction, lambda path, _: read_reconstruction(path)
    ),
    SurveyFormat(EXPECTED_METASHAPE, find_metashape, is_metashape, lambda path, _: read_metashape(path)),
    SurveyFormat(XMP_FILES, find_xmp, lambda _: False, read_xmp, is_folder=True),
)
"""Every survey format, in the order in which a folder is searched."""
SURVEY_FILES = ", ".join(row.name for row in SURVEY_FORMATS)
"""The files in words, for a list in messages."""


class Survey(NamedTuple):
    """The cameras of a survey.

    cameras: the file, or the folder of files beside the photographs.
    format: the format of the cameras.
    top: folder of the scene, in which the photographs are searched.
    """

    cameras: Path
    format: SurveyFormat
    top: Path

    def read(self, photographs: Path | None = None) -> DataSet:
        """Read and check the cameras. photographs: the folder of photographs, if the user gave one."""
        data = self.format.read(self.cameras, photographs)
        check_names(self.cameras, data.images)
        check_units(self.cameras, data.images)
        return data

    def images(self) -> list[PosedImage]:
        """Read the images, sorted by name. Photographs need not exist, unless their sizes are not in the file."""
        return sorted(self.read().images, key=lambda image: image.name)


def survey_of(path: Path) -> Survey | None:
    """Return the survey's cameras in a folder, or the given file of cameras; None if there are none."""
    for row in SURVEY_FORMATS:
        cameras = (path if row.is_one(path) else None) if is_file(path) else row.find(path)
        if cameras is not None:
            folder = cameras.parent if is_file(cameras) else cameras
            whole = folder.absolute()  # its name may not be in the path: "." and reconstruction.json
            of_project = whole.name == OPENSFM_FOLDER and not (folder / "images").is_dir()
            return Survey(cameras, row, whole.parent if of_project else folder)
    return None


def check_names(path: Path, images: Sequence[PosedImage]) -> None:
    """Raise InputError if two cameras have the same photograph. path: the file of cameras, for the message."""
    twice = [name for name, count in Counter(image.name for image in images).items() if count > 1]
    if twice:
        raise InputError(
            f"{path}: lists {examples(twice)} twice, expected each photograph once; give the photographs different "
            "names and export the cameras again"
        )


def check_units(path: Path, images: Sequence[PosedImage]) -> None:
    """Raise InputError if the cameras' positions are longitudes and latitudes in degrees, with heights in metres.

    path: the file of cameras, for the message.
    """
    centres = centres_of(images)
    extent, middle = np.ptp(centres, axis=0), np.abs(np.median(centres, axis=0))
    across = float(extent[:2].max())
    on_globe = bool((np.abs(centres[:, 0]) <= 360).all() and (np.abs(centres[:, 1]) <= 90).all())
    is_off_origin = max(middle[:2]) > MAX_SPREAD_DEGREES  # local coordinates have their origin near the cameras
    is_wide = MIN_SPREAD_DEGREES < across < MAX_SPREAD_DEGREES
    if on_globe and is_off_origin and is_wide and extent[2] > MIN_HEIGHT_PER_DEGREE * across:
        x, y, z = centres[0].tolist()
        raise InputError(
            f"{path}: the positions look like degrees with heights in metres (the first is {x:.6g} {y:.6g} {z:.6g}), "
            "expected metres; export the cameras in a local or projected coordinate system, such as a UTM zone"
        )
