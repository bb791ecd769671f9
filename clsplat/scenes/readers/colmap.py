# SPDX-License-Identifier: Apache-2.0
"""Reading of COLMAP models: cameras, images and points3D, binary or text (https://colmap.github.io/format.html).

`pycolmap.Reconstruction` is not used, because version 4.2.1 does not handle damaged files. It fails without naming the
file, allocates all memory, or accepts a truncated cameras.bin and goes on with uninitialised data. This reader rejects
files with missing or additional bytes.

Camera models: `colmap_camera_models` in `scenes/dataset.py`.
"""

from __future__ import annotations

import math
import struct
from collections.abc import Iterator
from dataclasses import replace
from pathlib import Path, PurePosixPath, PureWindowsPath

import numpy as np

from clsplat.camera import Camera
from clsplat.config.training import Lenses
from clsplat.errors import InputError, warn
from clsplat.files.documents import is_file, open_input
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
from clsplat.scenes.photo_names import is_legible, legible, slashed
from clsplat.scenes.readers.colmap_files import (
    COLMAP_COUNT,
    COLMAP_FILE_KIND,
    check_count,
    corrupt,
    file_of,
    lines_of,
    parsing,
    records,
    require_file,
)
from clsplat.scenes.readers.colmap_points import Tracks, read_points, read_tracks_of

COLMAP_FILE_STEMS = ("cameras", "images", "points3D")
OBSERVATION_BYTES = 24  # x, y, id of the point
EDITED_AFTER_SECONDS = 60.0
"""A text file that is newer than its binary file by more seconds than this counts as edited.

Tools that write or copy both files finish within less time.
"""
IMAGE_LINE_FIELDS = "IMAGE_ID QW QX QY QZ TX TY TZ CAMERA_ID NAME"


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
    images, points = _read_posed_images(folder), file_of(folder, "points3D")
    data = DataSet(images, *read_points(points)) if points else DataSet(images)
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
    rows = _binary_images(path) if path.suffix == ".bin" else _text_images(path)
    names = {key: _named(path, name) for key, name, *_ in rows}
    return read_tracks_of(require_file(folder, "points3D"), names)


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


def _is_model(folder: Path) -> bool:
    return any(file_of(folder, stem) for stem in ("cameras", "images"))


def _claimed_images(folder: Path) -> int:
    """Return the number of images in a model, by images.bin's header or images.txt's lines; -1 without such a file."""
    path = file_of(folder, "images")
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


def _read_cameras(folder: Path) -> dict[int, Lens]:
    path = require_file(folder, "cameras")
    lenses: dict[int, Lens] = {}
    in_parts = []
    for key, lens in _binary_cameras(path) if path.suffix == ".bin" else _text_cameras(path):
        if key in lenses:
            raise corrupt(path, f"camera {key} occurs twice")
        lenses[key], parts = in_pixels(check_lens(lens, f"{path}: camera {key}"))
        in_parts += [key] if parts else []
    if in_parts:
        warn(f"{path}: {given_in_parts(f'camera {key}' for key in in_parts)}")
    check_count(path, len(lenses))
    return lenses


def _binary_cameras(path: Path) -> Iterator[tuple[int, Lens]]:
    layout, known = struct.Struct("<IiQQ"), colmap_camera_models()
    for file in records(path, "camera", layout.size):
        key, model, width, height = (int(value) for value in file.read(layout))
        if model not in known:
            raise InputError(
                f"{path}: camera {key} has the unknown camera model id {model}, expected one of "
                f"0 to {max(known)}; is the file damaged, or from a newer COLMAP?"
            )
        name, parameters = known[model]
        yield key, Lens(name, width, height, file.read(struct.Struct(f"<{parameters}d")))


def _text_cameras(path: Path) -> Iterator[tuple[int, Lens]]:
    for number, line in lines_of(path):
        with parsing(path, number, "CAMERA_ID MODEL WIDTH HEIGHT PARAMS"):
            key, model, width, height, *params = line.split()
            yield int(key), Lens(model, int(width), int(height), tuple(map(float, params)))


def _read_images(folder: Path, lenses: dict[int, Lens]) -> list[PosedImage]:
    path = require_file(folder, "images")
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
    check_count(path, len(images))
    return [images[name] for name in sorted(images)]


def _binary_images(path: Path) -> Iterator[tuple[int, str, int, tuple[float, ...]]]:
    head = struct.Struct("<I7dI")
    for file in records(path, "image", head.size + 1 + COLMAP_COUNT.size):
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
    for number, line in lines_of(path, keep_empty=True):
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
    try:
        float(line.rsplit(None, 1)[-1])
    except ValueError:
        return False
    return _number_of_words(line) % 3 == 0


def _number_of_words(line: str) -> int:
    """Return the number of words in a line without blanks at its ends. Lines of observations have tens of thousands."""
    if line.isascii():
        codes = np.frombuffer(line.encode(), np.uint8)
        if not (codes < ord(" ")).any():  # no tabs or the like
            blank = codes == ord(" ")
            return 1 + int(np.count_nonzero(blank[:-1] & ~blank[1:]))
    return len(line.split())


def _text_images(path: Path) -> Iterator[tuple[int, str, int, tuple[float, ...]]]:
    for number, line, expected in _image_lines(path):
        with parsing(path, number, expected):
            words = line.split(maxsplit=9)  # the name is the rest of the line, spaces included
            yield int(words[0]), words[9], int(words[8]), tuple(map(float, words[1:8]))
