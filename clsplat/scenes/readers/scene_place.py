# SPDX-License-Identifier: Apache-2.0
"""Place of a scene's files on the earth: georeference.json beside its cameras, or the origin of its frame."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import replace
from pathlib import Path

import numpy as np

from clsplat.errors import InputError
from clsplat.scenes.dataset import DataSet, SceneFrame
from clsplat.scenes.geography.georeference import GEOREFERENCE_FILE, Georeference, on_tangent_plane, read_georeference

ENU_FROM_UPRIGHT = np.array([[1.0, 0.0, 0.0], [0.0, 0.0, 1.0], [0.0, -1.0, 0.0]])
"""Rotation from an upright world with x east, y down and z north to x east, y north and z up."""


def georeferenced(data: DataSet, where: Path, folders: Sequence[Path]) -> DataSet:
    """Return a data set with its place on the earth, if one of the folders has georeference.json.

    where: the scene, for messages.
    Raises InputError for a damaged file, and if the data set has a place on the earth of its own too.
    """
    found = [(folder, place) for folder in folders if (place := read_georeference(folder / GEOREFERENCE_FILE))]
    if not found:
        return data
    folder, place = found[0]
    if data.georeference is not None:
        raise InputError(
            f"{folder / GEOREFERENCE_FILE}: gives EPSG:{place.epsg}, but the cameras of {where} have a coordinate "
            f"system of their own ({data.georeference.note}), expected one of the two; remove {GEOREFERENCE_FILE}"
        )
    return replace(data, georeference=place)


def georeference_by_gps(frame: SceneFrame) -> Georeference | None:
    """Return the place on the earth of a frame whose axes and scale are from GPS; None for other frames."""
    if not (frame.origin and frame.upright and frame.metres):
        return None
    latitude, longitude, altitude = frame.origin
    plane = on_tangent_plane((latitude, longitude, altitude), frame.scale_note, None)
    return replace(plane, transform=plane.transform @ ENU_FROM_UPRIGHT)
