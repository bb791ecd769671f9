# SPDX-License-Identifier: Apache-2.0
"""Reading of COLMAP models: cameras, images and points3D, binary or text (https://colmap.github.io/format.html).

`pycolmap.Reconstruction` is not used, because version 4.2.1 does not handle damaged files. It fails without naming the
file, allocates all memory, or accepts a truncated cameras.bin and goes on with uninitialised data. This reader rejects
files with missing or additional bytes.

Camera models: `colmap_camera_models` in `scenes/dataset.py`.
"""

from __future__ import annotations

import codecs
import io
import math
import os
import re
import struct
from array import array
from collections.abc import Iterator, Sequence
from contextlib import contextmanager
from dataclasses import dataclass, replace
from itertools import islice
from pathlib import Path, PurePosixPath, PureWindowsPath
from typing import BinaryIO

import numpy as np
from numpy.typing import NDArray

from clsplat.arrays import Float32, Float64
from clsplat.camera import Camera
from clsplat.config.training import Lenses
from clsplat.errors import InputError, warn
from clsplat.files.documents import is_file, open_input
from clsplat.models.codec.values import full_scale
from clsplat.rotations import rotation_from_quaternion
from clsplat.scenes.camera_checks import cameras_of
from clsplat.scenes.dataset import (
    MAX_COORDINATE,
    DataSet,
    Lens,
    PosedImage,
    check_lens,
    colmap_camera_models,
    given_in_parts,
    in_pixels,
)
from clsplat.scenes.orientation.frame_record import read_frame
from clsplat.scenes.photo_names import is_legible, legible, match, slashed

COLMAP_FILE_STEMS = ("cameras", "images", "points3D")
COLMAP_COUNT = struct.Struct("<Q")
OBSERVATION_BYTES = 24  # x, y, id of the point
TRACK_BYTES = 8  # id of the image, index of the observation in it
MAX_NAME_BYTES = 4096
MAX_LINE_CHARACTERS = 1 << 26
"""Maximum length of a text line. The observations of a picture and the track of a point are one line each."""
EDITED_AFTER_SECONDS = 60.0
"""A text file that is newer than its binary file by more seconds than this counts as edited.

Tools that write or copy both files finish within less time.
"""
RECORD_COUNT_COMMENT = re.compile(r"# *Number of (?:cameras|images|points): *(\d{1,18})\b")
IMAGE_LINE_FIELDS = "IMAGE_ID QW QX QY QZ TX TY TZ CAMERA_ID NAME"
POINT_LINE_FIELDS = "POINT3D_ID X Y Z R G B ERROR TRACK"
COLMAP_FILE_KIND = "a file of a COLMAP model"


def find_model(folder: Path) -> Path | None:
    """Find the folder of the COLMAP model that belongs to `folder`, or None.

    The folder itself, sparse/ and colmap/sparse/ are searched, and in each, numbered sub-folders such as sparse/0 come
    first. Of several numbered models, the one with the most images is used, as COLMAP's first model may be a fragment.
    """
    for candidate in (folder, folder / "sparse", folder / "colmap" / "sparse"):
        numbered = [path for path in candidate.glob("[0-9]*") if _is_model(path)]
        if len(numbered) > 1:
            return max(sorted(numbered), key=_claimed_images)
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
    images = _read_posed_images(folder)
    data = DataSet(images, *_read_points(folder)) if _file(folder, "points3D") else DataSet(images)
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


@dataclass(frozen=True, eq=False)
class Tracks:
    """Observations of points in images.

    points: (N, 3) float64, world coordinates.
    errors: (N,), mean reprojection errors in pixels.
    by_image: for each image name, the indices (k,) of its points in both arrays, ascending and unique.
    """

    points: Float64
    errors: Float64
    by_image: dict[str, NDArray[np.int64]]

    def shown_in(self, names: Sequence[str]) -> dict[str, NDArray[np.int64]]:
        """Return the indices (k,) of the points observed in each photograph, by the photograph's name.

        Photographs without observed points are left out.

        names: names of the photographs. `photo_names.match` finds the image of each.
        """
        tracked = {name: rows for name, rows in self.by_image.items() if len(rows)}
        return {name: tracked[theirs] for name, theirs in match(names, tracked).names.items()}


def read_tracks(folder: Path) -> Tracks:
    """Read the tracks of the model in `folder`, without observations in images that the model lacks.

    Raises InputError like `read_model`.
    """
    path = _require(folder, "images")
    rows = _binary_images(path) if path.suffix == ".bin" else _text_images(path)
    names = {key: _named(path, name) for key, name, *_ in rows}
    path = _require(folder, "points3D")
    places, errors, images, lengths = array("d"), array("d"), array("q"), array("q")
    for place, error, seen in _binary_tracks(path) if path.suffix == ".bin" else _text_tracks(path):
        places.extend(place)
        errors.append(error)
        images.extend(seen)
        lengths.append(len(seen))
    points = np.repeat(np.arange(len(lengths)), np.array(lengths, np.int64))
    of = np.array(images, np.int64)
    order = np.argsort(of, kind="stable")
    keys, begins = np.unique(of[order], return_index=True)
    parts = np.split(points[order], begins[1:])
    by_image = {names[key]: np.unique(part) for key, part in zip(keys.tolist(), parts, strict=False) if key in names}
    return Tracks(np.array(places, np.float64).reshape(-1, 3), np.array(errors, np.float64), by_image)


def safe_name(name: str) -> bool:
    """Return True if a name from a file is legible and stays inside the folder that it is relative to."""
    path, windows = PurePosixPath(name), PureWindowsPath(name)
    inside = not path.is_absolute() and not windows.anchor and ".." not in windows.parts
    return bool(path.parts) and inside and is_legible(name)


def _named(path: Path, name: str) -> str:
    """Return the name of a picture without a drive, root or "..", so that it is a path inside the images' folder.

    `photo_names.match` then finds the picture by the last parts of its path. Raises InputError if this is impossible.
    """
    inner = name if safe_name(name) else "/".join(part for part in slashed(name).split("/") if part != "..")
    if not safe_name(inner):
        raise corrupt(path, f"an image has the name {name[:80]!r}, expected a path inside the images' folder")
    return inner


class _Binary:
    """Reader of little-endian records. Raises InputError if the file ends before the end of a record."""

    def __init__(self, path: Path, file: BinaryIO) -> None:
        self.path, self.file = path, file
        self.size = self.left = os.fstat(file.fileno()).st_size
        self.doing = "its header"

    def read(self, layout: struct.Struct) -> tuple[float, ...]:
        self._take(layout.size)
        return layout.unpack(self.file.read(layout.size))

    def need(self, size: int) -> None:
        """Raise InputError if the file has fewer than `size` bytes left."""
        if size > self.left:
            self._take(size)

    def skip(self, size: int) -> None:
        self._take(size)
        self.file.seek(size, os.SEEK_CUR)

    def _take(self, size: int) -> None:
        if size > self.left:
            raise corrupt(self.path, f"its {self.size} bytes end inside {self.doing}")
        self.left -= size

    def name(self) -> str:
        raw = b"".join(islice(iter(lambda: self.file.read(1), b"\0"), min(MAX_NAME_BYTES, self.left)))
        if len(raw) == min(MAX_NAME_BYTES, self.left):
            raise corrupt(self.path, f"{self.doing} has a name without a zero byte at its end")
        self.left -= len(raw) + 1
        # Names are not always UTF-8: COLMAP on Windows writes them in the system's code page, see `photo_names`.
        return raw.decode("utf-8", "surrogateescape")


def _records(path: Path, what: str, least: int) -> Iterator[_Binary]:
    """Yield a reader at the beginning of each record that the file's header announces.

    what: the kind of record, for messages.
    least: minimum number of bytes of a record.
    """
    with open_input(path, COLMAP_FILE_KIND) as opened:
        file = _Binary(path, opened)
        (number,) = map(int, file.read(COLMAP_COUNT))
        if number * least > file.size:
            file.doing = f"the {number} {what}s that its header announces"
            file.skip(number * least)
        for index in range(number):
            file.doing = f"{what} {index + 1} of {number}"
            yield file
        if file.left:
            raise corrupt(path, f"{file.left} bytes follow the last of its {number} {what}s")


def corrupt(path: Path, trouble: str) -> InputError:
    """Return the error for invalid contents of a model's file."""
    return InputError(f"{path}: truncated or corrupt: {trouble}; copy the file again or export the model again")


def _is_model(folder: Path) -> bool:
    return any(_file(folder, stem) for stem in ("cameras", "images"))


def _file(folder: Path, stem: str) -> Path | None:
    for extension in (".bin", ".txt"):
        path = folder / (stem + extension)
        if is_file(path):
            return path
    if not os.path.isdir(folder):  # noqa: PTH112  # Path.is_dir raises for a long name
        return None
    # hierarchical-3d-gaussians writes points3d in lower case
    lower = {f"{stem}{extension}".lower() for extension in (".bin", ".txt")}
    return next((path for path in sorted(folder.iterdir()) if path.name.lower() in lower and is_file(path)), None)


def _require(folder: Path, stem: str) -> Path:
    if (path := _file(folder, stem)) is None:
        raise InputError(f"{folder}: has no {stem}.bin or {stem}.txt, expected a COLMAP model with cameras and images")
    return path


def _claimed_images(folder: Path) -> int:
    """Return the number of images in a model, by images.bin's header or images.txt's lines; -1 without such a file."""
    path = _file(folder, "images")
    if path is None:
        return -1
    if path.suffix == ".bin":
        with open_input(path, COLMAP_FILE_KIND) as file:
            return int.from_bytes(file.read(8), "little")
    return sum(1 for _ in _image_lines(path))


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


def _check_count(path: Path, count: int) -> None:
    """Warn of a text file with fewer records than announced. No other check detects truncation at the end of a line."""
    if path.suffix != ".txt":
        return
    announced = 0
    with open_input(path, COLMAP_FILE_KIND) as file:
        while (line := file.readline(MAX_NAME_BYTES)).lstrip(b"\xef\xbb\xbf").startswith(b"#"):
            if match := RECORD_COUNT_COMMENT.match(line.lstrip(b"\xef\xbb\xbf").decode("utf-8", "replace")):
                announced = int(match[1])
    if count < announced:
        warn(f"{path}: its header announces {announced:,} records, only {count:,} are read; was it cut off or edited?")


def _read_cameras(folder: Path) -> dict[int, Lens]:
    path = _require(folder, "cameras")
    lenses: dict[int, Lens] = {}
    in_parts = []
    for key, lens in _binary_cameras(path) if path.suffix == ".bin" else _text_cameras(path):
        if key in lenses:
            raise corrupt(path, f"camera {key} occurs twice")
        lenses[key], parts = in_pixels(check_lens(lens, f"{path}: camera {key}"))
        in_parts += [key] if parts else []
    if in_parts:
        warn(f"{path}: {given_in_parts(f'camera {key}' for key in in_parts)}")
    _check_count(path, len(lenses))
    return lenses


def _binary_cameras(path: Path) -> Iterator[tuple[int, Lens]]:
    layout, known = struct.Struct("<IiQQ"), colmap_camera_models()
    for file in _records(path, "camera", layout.size):
        key, model, width, height = (int(value) for value in file.read(layout))
        if model not in known:
            raise InputError(
                f"{path}: camera {key} has the unknown camera model id {model}, expected one of "
                f"0 to {max(known)}; is the file damaged, or from a newer COLMAP?"
            )
        name, parameters = known[model]
        yield key, Lens(name, width, height, file.read(struct.Struct(f"<{parameters}d")))


def _text_cameras(path: Path) -> Iterator[tuple[int, Lens]]:
    for number, line in _lines(path):
        with _parsing(path, number, "CAMERA_ID MODEL WIDTH HEIGHT PARAMS"):
            key, model, width, height, *params = line.split()
            yield int(key), Lens(model, int(width), int(height), tuple(map(float, params)))


def _read_images(folder: Path, lenses: dict[int, Lens]) -> list[PosedImage]:
    path = _require(folder, "images")
    images: dict[str, PosedImage] = {}
    for _, given, camera, pose in _binary_images(path) if path.suffix == ".bin" else _text_images(path):
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
    _check_count(path, len(images))
    return [images[name] for name in sorted(images)]


def _binary_images(path: Path) -> Iterator[tuple[int, str, int, tuple[float, ...]]]:
    head = struct.Struct("<I7dI")
    for file in _records(path, "image", head.size + 1 + COLMAP_COUNT.size):
        key, *pose, camera = file.read(head)
        name = file.name()
        (observations,) = file.read(COLMAP_COUNT)
        file.skip(int(observations) * OBSERVATION_BYTES)
        yield int(key), name, int(camera), tuple(pose)


def _image_lines(path: Path) -> Iterator[tuple[int, str, str]]:
    """Yield number and text of the first line of each image, and the fields expected in it, for error messages.

    An image's second line, with its observations, may be empty, and some tools omit it.
    """
    after_pose = False
    for number, line in _lines(path, keep_empty=True):
        if after_pose and (not line or _are_observations(line)):
            after_pose = False
        elif line:
            yield (
                number,
                line,
                f"repeated X Y POINT3D_ID, or as {IMAGE_LINE_FIELDS}" if after_pose else IMAGE_LINE_FIELDS,
            )
            after_pose = True


def _are_observations(line: str) -> bool:
    """Return True for a line of observations (X Y POINT3D_ID ...): its number of words is a multiple of three, and the
    last word is a number."""
    words = line.split()
    try:
        float(words[-1])
    except ValueError:
        return False
    return len(words) % 3 == 0


def _text_images(path: Path) -> Iterator[tuple[int, str, int, tuple[float, ...]]]:
    for number, line, expected in _image_lines(path):
        with _parsing(path, number, expected):
            words = line.split(maxsplit=9)  # the name is the rest of the line, spaces included
            yield int(words[0]), words[9], int(words[8]), tuple(map(float, words[1:8]))


def _read_points(folder: Path) -> tuple[Float64, Float32]:
    path = _require(folder, "points3D")
    values = array("d")  # needs a sixth of the memory of a list of tuples
    for row in _binary_points(path) if path.suffix == ".bin" else _text_points(path):
        values.extend(row)
    table = np.frombuffer(values, np.float64).reshape(-1, 6) if values else np.empty((0, 6))
    _check_count(path, len(table))
    known = ~np.isnan(table).any(axis=1)
    if not known.all() and known.any():
        warn(f"{path}: {np.count_nonzero(~known):,} of {len(table):,} points have NaN values and are left out")
        table = table[known]
    near = (np.abs(table[:, :3]) < MAX_COORDINATE).all(axis=1)
    good = near & ((table[:, 3:] >= 0) & (table[:, 3:] <= 65535)).all(axis=1)
    if not good.all():
        index = int(np.argmin(good))
        trouble = f"point {index + 1} of {len(table)} has the position and colour {table[index].tolist()}"
        raise corrupt(path, f"{trouble}, expected finite numbers and colours 0 to 255")
    levels = table[:, 3:]
    whole = bool((levels == np.rint(levels)).all())  # text files may have colours from 0 to 1, or 0 to 65535
    white = full_scale(levels.astype(np.int64) if whole else levels)
    return np.ascontiguousarray(table[:, :3]), np.ascontiguousarray(levels / white, np.float32)


def _binary_points(path: Path) -> Iterator[tuple[float, ...]]:
    layout = struct.Struct("<Q3d3BdQ")
    for file in _records(path, "point", layout.size):
        _, *values, _, track = file.read(layout)
        file.skip(int(track) * TRACK_BYTES)
        yield tuple(values)


def _text_points(path: Path) -> Iterator[tuple[float, ...]]:
    for number, line in _lines(path):
        with _parsing(path, number, POINT_LINE_FIELDS):
            _, x, y, z, red, green, blue, *others = _with_colours(line)  # some tools omit error and track
            if len(others) == 2 and len(others[1].split()) % 2:
                raise ValueError("a track consists of pairs")
            yield float(x), float(y), float(z), float(red), float(green), float(blue)


def _with_colours(line: str) -> list[str]:
    """Split a point's line into fields; its track is one field. A line without a colour gets grey."""
    words = line.split(maxsplit=8)
    return [*words, "128", "128", "128"] if len(words) == 4 else words


def _binary_tracks(path: Path) -> Iterator[tuple[tuple[float, ...], float, tuple[int, ...]]]:
    """Yield each point's position, reprojection error, and the ids of the images that show it."""
    layout = struct.Struct("<Q3d3BdQ")
    for file in _records(path, "point", layout.size):
        _, *values, error, length = file.read(layout)
        file.need(int(length) * TRACK_BYTES)
        track = file.read(struct.Struct(f"<{2 * int(length)}I"))
        yield tuple(values[:3]), error, tuple(int(key) for key in track[::2])


def _text_tracks(path: Path) -> Iterator[tuple[tuple[float, ...], float, tuple[int, ...]]]:
    for number, line in _lines(path):
        with _parsing(path, number, POINT_LINE_FIELDS):
            _, x, y, z, _, _, _, *others = [*line.split(), *[""] * 3] if len(line.split()) == 4 else line.split()
            error = float(others[0]) if others else 0.0
            yield (float(x), float(y), float(z)), error, tuple(map(int, others[1::2]))


def _lines(path: Path, *, keep_empty: bool = False) -> Iterator[tuple[int, str]]:
    """Yield numbers and text of a file's lines, without comments."""
    with open_input(path, COLMAP_FILE_KIND) as opened:
        wide = opened.read(2) in (codecs.BOM_UTF16_LE, codecs.BOM_UTF16_BE)  # PowerShell writes text in UTF-16
        opened.seek(0)
        encoding, errors = ("utf-16", "strict") if wide else ("utf-8-sig", "surrogateescape")
        file, number = io.TextIOWrapper(opened, encoding=encoding, errors=errors), 0
        try:
            while line := file.readline(MAX_LINE_CHARACTERS):
                number += 1
                if len(line) == MAX_LINE_CHARACTERS:
                    raise corrupt(path, f"line {number} has over {MAX_LINE_CHARACTERS:,} characters")
                text = line.strip()
                if not text.startswith("#") and (text or keep_empty):
                    yield number, text
        except UnicodeDecodeError:
            raise corrupt(path, "is not text in UTF-8 or UTF-16") from None


@contextmanager
def _parsing(path: Path, number: int, expected: str) -> Iterator[None]:
    try:
        yield
    except (ValueError, IndexError, OverflowError):
        raise InputError(f"{path}: line {number} does not read as {expected}; is the file damaged?") from None
