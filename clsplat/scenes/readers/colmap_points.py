# SPDX-License-Identifier: Apache-2.0
"""Reading of the points of COLMAP models, and of their tracks, in blocks: models have millions of points."""

from __future__ import annotations

from array import array
from collections.abc import Iterator, Mapping, Sequence
from dataclasses import dataclass
from functools import cached_property
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import NDArray

from clsplat.arrays import Float32, Float64
from clsplat.errors import warn
from clsplat.models.codec.values import full_scale
from clsplat.scenes.dataset import MAX_COORDINATE
from clsplat.scenes.photo_names import match
from clsplat.scenes.readers.colmap_files import at_each, check_count, corrupt, line_blocks, record_blocks, unreadable

POINT_RECORD = np.dtype([("id", "<u8"), ("place", "<f8", 3), ("levels", "u1", 3), ("error", "<f8"), ("length", "<u8")])
"""Fixed part of a point in points3D.bin. `length` is the number of observations that follow, its track."""
TRACK_BYTES = 8  # id of the image, index of the observation in it
POINT_LINE_FIELDS = "POINT3D_ID X Y Z R G B ERROR TRACK"
GREY_LEVELS = ["128", "128", "128"]
"""Colour of points that have none in a text file."""
COLOUR_ROWS = 1 << 20
"""Number of points whose colours are converted at once."""
OBSERVATION_ROWS = 1 << 22
"""Number of observations that are searched at once."""


def read_points(path: Path) -> tuple[Float64, Float32]:
    """Read positions (N, 3) and colours (N, 3) in [0, 1] of the points of points3D.bin or points3D.txt, without tracks.

    Warns of points with NaN values, which are left out, and of a text file with fewer points than announced. Raises
    InputError for a damaged file, and for positions and colours that are not possible.
    """
    values, parts = array("d"), [np.empty((0, 3), np.uint8)]
    for places, colours in _binary_points(path) if path.suffix == ".bin" else _text_points(path):
        values.frombytes(places.tobytes())
        parts.append(colours)
    points, levels = _rows_of(values), np.concatenate(parts)
    del parts
    check_count(path, len(points))
    known = ~(np.isnan(points).any(axis=1) | np.isnan(levels).any(axis=1))
    if not known.all() and known.any():
        warn(f"{path}: {np.count_nonzero(~known):,} of {len(points):,} points have NaN values and are left out")
        points, levels = points[known], levels[known]
    near = ((points > -MAX_COORDINATE) & (points < MAX_COORDINATE)).all(axis=1)
    good = near & ((levels >= 0) & (levels <= 65535)).all(axis=1)
    if not good.all():
        index = int(np.argmin(good))
        found = [*points[index].tolist(), *map(float, levels[index])]
        trouble = f"point {index + 1} of {len(points)} has the position and colour {found}"
        raise corrupt(path, f"{trouble}, expected finite numbers and colours 0 to 255")
    return points, _colours(levels)


def _rows_of(values: array[float]) -> Float64:
    """Return numbers in rows of three (N, 3), in the memory of `values`."""
    rows: Float64 = _values_of(values).reshape(-1, 3)
    return rows


def _colours(levels: NDArray[Any]) -> Float32:
    """Return colours (N, 3) in [0, 1]. levels: (N, 3), from 0 to 255; in text files also from 0 to 1 or 65535."""
    if levels.dtype != np.uint8 and (levels == np.rint(levels)).all():
        white = full_scale(levels.astype(np.int64))
    else:
        white = full_scale(levels)
    colours = np.empty(levels.shape, np.float32)
    for first in range(0, len(levels), COLOUR_ROWS):  # divided in float64, which takes much memory
        rows = slice(first, first + COLOUR_ROWS)
        colours[rows] = levels[rows] / np.float64(white)
    return colours


def _binary_points(path: Path) -> Iterator[tuple[Float64, NDArray[np.uint8]]]:
    """Yield the points in blocks: positions (k, 3), and colours (k, 3) from 0 to 255."""
    for data, begins in record_blocks(path, "point", POINT_RECORD, TRACK_BYTES, whole=False):
        points = at_each(data, begins, POINT_RECORD)
        yield points["place"], points["levels"].copy()  # a copy, as a view keeps all fields


def _text_points(path: Path) -> Iterator[tuple[Float64, NDArray[Any]]]:
    """Yield the points in blocks: positions (k, 3), and colours (k, 3), as uint8 if they are such numbers."""
    for first, lines in line_blocks(path):
        values, number = array("d"), first
        try:
            for number, line in enumerate(lines, first):  # noqa: B007  # for the error
                if not line or line[0] == "#":
                    continue
                words = line.split(None, 8)
                if len(words) == 4:
                    words += GREY_LEVELS
                if len(words) < 7:  # some tools omit error and track
                    raise ValueError("a point has a position and a colour")
                if len(words) == 9 and len(words[8].split()) % 2:
                    raise ValueError("a track consists of pairs")
                values.extend(map(float, words[1:7]))
        except (ValueError, OverflowError):
            raise unreadable(path, number, POINT_LINE_FIELDS) from None
        table = _values_of(values).reshape(-1, 6)
        with np.errstate(invalid="ignore"):
            levels = table[:, 3:].astype(np.uint8)
        yield table[:, :3], levels if (levels == table[:, 3:]).all() else table[:, 3:].copy()


@dataclass(frozen=True, eq=False)
class Tracks:
    """Observations of points in images.

    points: (N, 3) float64, world coordinates.
    errors: (N,), mean reprojection errors in pixels.
    names: the images' names.
    images: (M,) int32, for each observation the index of its image in `names`; -1 for an image that the model lacks.
    ends: (N,), for each point the number of observations of this point and of all points before it.
    """

    points: Float64
    errors: Float64
    names: Sequence[str]
    images: NDArray[np.int32]
    ends: NDArray[np.int64]

    @cached_property
    def tracked(self) -> dict[str, int]:
        """Index in `names` of each image in which points are observed. The keys are names."""
        counts = np.zeros(len(self.names) + 1, np.int64)
        for first in range(0, len(self.images), OBSERVATION_ROWS):
            counts += np.bincount(self.images[first : first + OBSERVATION_ROWS] + 1, minlength=len(counts))
        return {name: index for index, name in enumerate(self.names) if counts[index + 1]}

    @property
    def by_image(self) -> dict[str, NDArray[np.int64]]:
        """For each image with observed points, the indices (k,) of these points, ascending and unique."""
        return self._rows(self.tracked)

    def shown_in(self, names: Sequence[str]) -> dict[str, NDArray[np.int64]]:
        """Return the indices (k,) of the points observed in each photograph, by the photograph's name.

        Photographs without observed points are left out.

        names: names of the photographs. `photo_names.match` finds the image of each.
        """
        theirs = match(names, self.tracked).names
        return self._rows({name: self.tracked[other] for name, other in theirs.items()})

    def _rows(self, chosen: Mapping[str, int]) -> dict[str, NDArray[np.int64]]:
        """Return the indices (k,) of the points in the chosen images, by the names in `chosen`.

        chosen: maps names to indices in `names`.
        """
        place = np.full(len(self.names) + 1, -1, np.int32)  # the last is that of images that the model lacks
        wanted = sorted(set(chosen.values()))
        place[wanted] = np.arange(len(wanted))
        places, points = [np.empty(0, np.int32)], [np.empty(0, np.int64)]
        for first in range(0, len(self.images), OBSERVATION_ROWS):
            here = place[self.images[first : first + OBSERVATION_ROWS]]
            found = np.flatnonzero(here >= 0)
            places.append(here[found])
            points.append(np.searchsorted(self.ends, first + found, side="right"))
        of = np.concatenate(places)
        rows = np.concatenate(points)[np.argsort(of, kind="stable")]
        parts = np.split(rows, np.cumsum(np.bincount(of, minlength=len(wanted)))[:-1])
        unique = dict(zip(wanted, map(np.unique, parts), strict=True)) if wanted else {}
        return {name: unique[index] for name, index in chosen.items()}


def read_tracks_of(path: Path, names: Mapping[int, str]) -> Tracks:
    """Read the points of points3D.bin or points3D.txt with their tracks. Raises InputError for a damaged file.

    names: the images' names, by their ids.
    """
    keys = np.array(sorted(key for key in names if abs(key) < 1 << 63), np.int64)
    places, errors, lengths = array("d"), array("d"), array("q")
    images = array("i")
    for points, reprojection, counts, of in _binary_tracks(path) if path.suffix == ".bin" else _text_tracks(path):
        places.frombytes(points.tobytes())
        errors.frombytes(reprojection.tobytes())
        lengths.frombytes(counts.tobytes())
        images.frombytes(_indices(keys, of).tobytes())
    listed = [names[key] for key in keys.tolist()]
    return Tracks(_rows_of(places), _values_of(errors), listed, _values_of(images), np.cumsum(_values_of(lengths)))


def _indices(keys: NDArray[np.int64], ids: NDArray[np.int64]) -> NDArray[np.int32]:
    """Return the index of each of `ids` in the sorted `keys`, -1 for ids that are not among them."""
    if not len(keys):
        return np.full(len(ids), -1, np.int32)
    at = np.minimum(np.searchsorted(keys, ids), len(keys) - 1)
    return np.where(keys[at] == ids, at, -1).astype(np.int32)


TrackBlock = tuple[Float64, Float64, NDArray[np.int64], NDArray[np.int64]]
"""Some points: positions (k, 3), reprojection errors (k,), lengths (k,) of the tracks, and image ids of all tracks."""


def _binary_tracks(path: Path) -> Iterator[TrackBlock]:
    for data, begins in record_blocks(path, "point", POINT_RECORD, TRACK_BYTES, whole=True):
        points = at_each(data, begins, POINT_RECORD)
        lengths = points["length"].astype(np.int64)
        firsts = begins + POINT_RECORD.itemsize - TRACK_BYTES * (np.cumsum(lengths) - lengths)
        each = np.repeat(firsts, lengths) + TRACK_BYTES * np.arange(lengths.sum())
        yield points["place"], points["error"], lengths, at_each(data, each, np.dtype("<u4")).astype(np.int64)


def _text_tracks(path: Path) -> Iterator[TrackBlock]:
    for first, lines in line_blocks(path):
        places, errors, lengths, images, number = array("d"), array("d"), array("q"), array("q"), first
        try:
            for number, line in enumerate(lines, first):  # noqa: B007  # for the error
                if not line or line[0] == "#":
                    continue
                words = line.split(None, 8)
                if len(words) < 7 and len(words) != 4:
                    raise ValueError("a point has a position and a colour")
                track = words[8].split()[::2] if len(words) == 9 else []
                places.extend(map(float, words[1:4]))
                errors.append(float(words[7]) if len(words) > 7 else 0.0)
                lengths.append(len(track))
                images.extend(map(int, track))
        except (ValueError, OverflowError):
            raise unreadable(path, number, POINT_LINE_FIELDS) from None
        yield _rows_of(places), _values_of(errors), _values_of(lengths), _values_of(images)


def _values_of(values: array[Any]) -> NDArray[Any]:
    """Return numbers (N,) in the memory of `values`."""
    return np.frombuffer(values, values.typecode) if values else np.empty(0, values.typecode)
