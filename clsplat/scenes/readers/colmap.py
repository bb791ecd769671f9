# SPDX-License-Identifier: Apache-2.0
"""COLMAP models: where they are, their images, points and tracks, and checks of them. `colmap_files` reads the files.

`pycolmap.Reconstruction` is not used, because version 4.2.1 does not handle damaged files. It fails without naming the
file, allocates all memory, or accepts a truncated cameras.bin and goes on with uninitialised data. This reader rejects
files with missing or additional bytes.

Camera models: `colmap_camera_models` in `scenes/dataset.py`.
"""

from __future__ import annotations

import math
from array import array
from collections.abc import Mapping, Sequence
from dataclasses import dataclass, replace
from functools import cached_property
from pathlib import Path, PurePosixPath, PureWindowsPath
from typing import Any

import numpy as np
from numpy.typing import NDArray

from clsplat.arrays import Float32, Float64
from clsplat.camera import Camera
from clsplat.config.training import Lenses
from clsplat.errors import InputError, warn
from clsplat.files.documents import is_file
from clsplat.models.codec.values import full_scale
from clsplat.rotations import rotation_from_quaternion
from clsplat.scenes.camera_checks import cameras_of
from clsplat.scenes.dataset import (
    MAX_COORDINATE,
    DataSet,
    Lens,
    PosedImage,
    check_lens,
    given_in_parts,
    in_pixels,
)
from clsplat.scenes.orientation.frame_record import read_frame
from clsplat.scenes.photo_names import is_legible, legible, match, slashed
from clsplat.scenes.readers.colmap_files import (
    camera_rows,
    check_count,
    claimed_images,
    corrupt,
    file_of,
    image_rows,
    point_blocks,
    require_file,
    rows_of,
    track_blocks,
    values_of,
)

COLMAP_FILE_STEMS = ("cameras", "images", "points3D")
EDITED_AFTER_SECONDS = 60.0
"""A text file that is newer than its binary file by more seconds than this counts as edited.

Tools that write or copy both files finish within less time.
"""
COLOUR_ROWS = 1 << 20
"""Number of points whose colours are converted at once."""
OBSERVATION_ROWS = 1 << 22
"""Number of observations that are searched at once."""


def find_model(folder: Path) -> Path | None:
    """Find the folder of the COLMAP model that belongs to `folder`, or None.

    The folder itself, sparse/ and colmap/sparse/ are searched, and in each, numbered sub-folders such as sparse/0 come
    first. Of several numbered models, the one with the most images is used, as COLMAP's first model may be a fragment.
    """
    for candidate in (folder, folder / "sparse", folder / "colmap" / "sparse"):
        numbered = [path for path in candidate.glob("[0-9]*") if _is_model(path)]
        if len(numbered) > 1:
            return max(sorted(numbered), key=claimed_images)
        if numbered:
            return numbered[0]
        if _is_model(candidate):
            return candidate
    return None


def read_model(folder: Path) -> DataSet:
    """Read the COLMAP model in `folder`: cameras, images and points3D, each from .bin if it exists, else from .txt.

    Without points3D there are no points. frame.json gives the frame. Raises InputError that names the file if a file is
    missing, truncated, longer than its contents, damaged, or has an unknown camera model. Warns of text files with
    fewer records than their headers announce, and of text files newer than the binary file that is read.
    """
    images, points = _read_posed_images(folder), file_of(folder, "points3D")
    data = DataSet(images, *_read_points(points)) if points else DataSet(images)
    return replace(data, frame=read_frame(folder))


def _read_posed_images(folder: Path) -> list[PosedImage]:
    _warn_of_newer_text(folder)
    return _read_images(folder, _read_cameras(folder))


def read_cameras(folder: Path, lenses: Lenses = "undistort") -> dict[str, Camera]:
    """Read the cameras of a model, keyed and sorted by image name. Points and pictures are not read.

    folder: the folder of the model or of the scene, as for `find_model`.
    lenses: treatment of distorted cameras, as for training (`Lens.camera`). By default they become full-size pinhole
        cameras.
    Raises InputError and warns like `read_model`. Also warns of implausible lenses.
    """
    return cameras_of(read_images(folder), lenses)


def read_images(folder: Path) -> list[PosedImage]:
    """Read the images of a model, sorted by name. Raises InputError and warns like `read_model`.

    folder: the folder of the model or of the scene.
    """
    model = find_model(Path(folder))
    if model is None:
        raise InputError(f"{folder}: no COLMAP model, expected cameras and images (.bin or .txt) in it or in sparse/0")
    return [replace(image, name=legible(image.name)) for image in _read_posed_images(model)]


def read_tracks(folder: Path) -> Tracks:
    """Read the tracks of the model in `folder`, without observations in images that the model lacks.

    Raises InputError like `read_model`.
    """
    path = require_file(folder, "images")
    names = {key: _named(path, name) for key, name, *_ in image_rows(path)}
    return _tracks_of(require_file(folder, "points3D"), names)


def safe_name(name: str) -> bool:
    """Return True if a name from a file is legible and stays inside the folder that it is relative to."""
    path, windows = PurePosixPath(name), PureWindowsPath(name)
    inside = not path.is_absolute() and not windows.anchor and ".." not in windows.parts
    return bool(path.parts) and inside and is_legible(name)


def name_inside(name: str) -> str | None:
    """Return the name of a picture without a drive, root or "..", so that it is a path inside the images' folder.

    `photo_names.match` then finds the picture by the last parts of its path. Returns None if nothing legible is left.
    """
    inner = name if safe_name(name) else "/".join(part for part in slashed(name).split("/") if part != "..")
    return inner if safe_name(inner) else None


def _named(path: Path, name: str) -> str:
    """Return a picture's name as by `name_inside`. Raises InputError if nothing legible is left."""
    if (inner := name_inside(name)) is None:
        raise corrupt(path, f"an image has the name {name[:80]!r}, expected a path inside the images' folder")
    return inner


def _is_model(folder: Path) -> bool:
    return any(file_of(folder, stem) for stem in ("cameras", "images"))


def _warn_of_newer_text(folder: Path) -> None:
    """Warn of edited text files, which are not read because binary files take precedence."""
    edited = []
    for stem in COLMAP_FILE_STEMS:
        binary, text = folder / f"{stem}.bin", folder / f"{stem}.txt"
        if is_file(binary) and is_file(text) and text.stat().st_mtime > binary.stat().st_mtime + EDITED_AFTER_SECONDS:
            edited.append(stem)
    if edited:
        read, not_read = (", ".join(stem + extension for stem in edited) for extension in (".bin", ".txt"))
        warn(f"{folder}: {read} is read, and the newer {not_read} is not; remove the outdated one")


def _read_cameras(folder: Path) -> dict[int, Lens]:
    path = require_file(folder, "cameras")
    lenses: dict[int, Lens] = {}
    in_parts = []
    for key, lens in camera_rows(path):
        if key in lenses:
            raise corrupt(path, f"camera {key} occurs twice")
        lenses[key], parts = in_pixels(check_lens(lens, f"{path}: camera {key}"))
        in_parts += [key] if parts else []
    if in_parts:
        warn(f"{path}: {given_in_parts(f'camera {key}' for key in in_parts)}")
    check_count(path, len(lenses))
    return lenses


def _read_images(folder: Path, lenses: dict[int, Lens]) -> list[PosedImage]:
    path = require_file(folder, "images")
    images: dict[str, PosedImage] = {}
    for _, given, camera, pose in image_rows(path):
        if camera not in lenses:
            raise corrupt(path, f"image {given[:80]!r} has the camera {camera}, which is not in the model")
        name = _named(path, given)
        if name in images:
            raise corrupt(path, f"image {name} occurs twice")
        quaternion, translation = np.array(pose[:4], np.float64), np.array(pose[4:], np.float64)
        norm = math.hypot(*pose[:4])
        if not (0.5 < norm < 2 and (np.abs(translation) < MAX_COORDINATE).all()):
            raise corrupt(
                path, f"image {name} has the pose {list(pose)}, expected a unit quaternion and a finite translation"
            )
        images[name] = PosedImage(name, lenses[camera], rotation_from_quaternion(quaternion / norm), translation)
    if not images:
        raise InputError(f"{path}: holds no images, expected at least one")
    check_count(path, len(images))
    return [images[name] for name in sorted(images)]


def _read_points(path: Path) -> tuple[Float64, Float32]:
    """Read positions (N, 3) and colours (N, 3) in [0, 1] of the points of points3D.bin or points3D.txt, without tracks.

    Warns of points with NaN values, which are left out, and of a text file with fewer points than announced. Raises
    InputError for a damaged file, and for positions and colours that are not possible.
    """
    values, parts = array("d"), [np.empty((0, 3), np.uint8)]
    for places, colours in point_blocks(path):
        values.frombytes(places.tobytes())
        parts.append(colours)
    points, levels = rows_of(values), np.concatenate(parts)
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


def _tracks_of(path: Path, names: Mapping[int, str]) -> Tracks:
    """Read the points of points3D.bin or points3D.txt with their tracks. Raises InputError for a damaged file.

    names: the images' names, by their ids.
    """
    keys = np.array(sorted(key for key in names if abs(key) < 1 << 63), np.int64)
    places, errors, lengths = array("d"), array("d"), array("q")
    images = array("i")
    for points, reprojection, counts, of in track_blocks(path):
        places.frombytes(points.tobytes())
        errors.frombytes(reprojection.tobytes())
        lengths.frombytes(counts.tobytes())
        images.frombytes(_indices(keys, of).tobytes())
    listed = [names[key] for key in keys.tolist()]
    return Tracks(rows_of(places), values_of(errors), listed, values_of(images), np.cumsum(values_of(lengths)))


def _indices(keys: NDArray[np.int64], ids: NDArray[np.int64]) -> NDArray[np.int32]:
    """Return the index of each of `ids` in the sorted `keys`, -1 for ids that are not among them."""
    if not len(keys):
        return np.full(len(ids), -1, np.int32)
    at = np.minimum(np.searchsorted(keys, ids), len(keys) - 1)
    return np.where(keys[at] == ids, at, -1).astype(np.int32)
