# SPDX-License-Identifier: Apache-2.0
"""Files of a COLMAP model, binary or text: records, lines, and the cameras, images, points and tracks in them.

The formats are at https://colmap.github.io/format.html. Points and tracks are read in blocks: models have millions.
"""

from __future__ import annotations

import codecs
import io
import os
import re
import struct
from array import array
from collections.abc import Iterator
from contextlib import contextmanager
from itertools import islice
from pathlib import Path
from typing import Any, BinaryIO

import numpy as np
from numpy.typing import NDArray

from clsplat.arrays import Float64
from clsplat.errors import InputError, warn
from clsplat.files.documents import is_file, open_input
from clsplat.scenes.dataset import Lens, colmap_camera_models

COLMAP_COUNT = struct.Struct("<Q")
MAX_NAME_BYTES = 4096
MAX_LINE_CHARACTERS = 1 << 26
"""Maximum length of a text line. The observations of a picture and the track of a point are one line each."""
TEXT_BLOCK_BYTES = 1 << 22
"""Bytes of a text file that are decoded at once."""
RECORD_BLOCK_BYTES = 1 << 22
"""Bytes of a binary file whose records are read at once; more if a record is longer."""
RECORD_COUNT_COMMENT = re.compile(r"# *Number of (?:cameras|images|points): *(\d{1,18})\b")
COLMAP_FILE_KIND = "a file of a COLMAP model"
OBSERVATION_BYTES = 24  # x, y, id of the point
IMAGE_LINE_FIELDS = "IMAGE_ID QW QX QY QZ TX TY TZ CAMERA_ID NAME"
POINT_RECORD = np.dtype([("id", "<u8"), ("place", "<f8", 3), ("levels", "u1", 3), ("error", "<f8"), ("length", "<u8")])
"""Fixed part of a point in points3D.bin. `length` is the number of observations that follow, its track."""
TRACK_BYTES = 8  # id of the image, index of the observation in it
POINT_LINE_FIELDS = "POINT3D_ID X Y Z R G B ERROR TRACK"
GREY_LEVELS = ["128", "128", "128"]
"""Colour of points that have none in a text file."""
ImageRow = tuple[int, str, int, tuple[float, ...]]
"""An image: its id, name and camera's id, and its pose: QW QX QY QZ TX TY TZ."""
PointBlock = tuple[Float64, NDArray[Any]]
"""Some points: positions (k, 3), and colours (k, 3) as in the file: uint8 if that holds them all, else float64."""
TrackBlock = tuple[Float64, Float64, NDArray[np.int64], NDArray[np.int64]]
"""Some points: positions (k, 3), reprojection errors (k,), lengths (k,) of tracks, image ids of all observations."""


class Records:
    """Reader of little-endian records. Raises InputError if the file ends before the end of a record.

    doing: the part that is being read, for error messages.
    """

    def __init__(self, path: Path, file: BinaryIO) -> None:
        self.path, self.file = path, file
        self.size = self.left = os.fstat(file.fileno()).st_size
        self.doing = "its header"

    def read(self, layout: struct.Struct) -> tuple[float, ...]:
        return layout.unpack(self.take(layout.size))

    def take(self, size: int) -> bytes:
        """Return the next `size` bytes."""
        self.need(size)
        self.left -= size
        return self.file.read(size)

    def skip(self, size: int) -> None:
        self.need(size)
        self.left -= size
        self.file.seek(size, os.SEEK_CUR)

    def need(self, size: int) -> None:
        """Raise InputError if the file has fewer than `size` bytes left."""
        if size > self.left:
            raise corrupt(self.path, f"its {self.size} bytes end inside {self.doing}")

    def name(self) -> str:
        most = min(MAX_NAME_BYTES, self.left)
        raw = b"".join(islice(iter(lambda: self.file.read(1), b"\0"), most))
        if len(raw) == most:
            raise corrupt(self.path, f"{self.doing} has a name without a zero byte at its end")
        self.left -= len(raw) + 1
        # Names are not always UTF-8: COLMAP on Windows writes them in the system's code page, see `photo_names`.
        return raw.decode("utf-8", "surrogateescape")

    def count(self, what: str, least: int) -> int:
        """Read the header: the number of records. what, least: as for `records`."""
        (number,) = map(int, self.read(COLMAP_COUNT))
        if number * least > self.size:
            self.doing = f"the {number} {what}s that its header announces"
            self.need(number * least)
        return number

    def end(self, what: str, number: int) -> None:
        """Raise InputError if bytes follow the last record."""
        if self.left:
            raise corrupt(self.path, f"{self.left} bytes follow the last of its {number} {what}s")


@contextmanager
def _opened(path: Path, what: str, least: int) -> Iterator[tuple[Records, int]]:
    """Context manager that opens a binary file and yields a reader after the header, and the number of records.

    what, least: as for `records`.
    At the end, raises InputError if bytes follow the last record.
    """
    with open_input(path, COLMAP_FILE_KIND) as opened:
        file = Records(path, opened)
        number = file.count(what, least)
        yield file, number
        file.end(what, number)


def records(path: Path, what: str, least: int) -> Iterator[Records]:
    """Yield a reader at the beginning of each record that the file's header announces.

    what: the kind of record, for messages.
    least: minimum number of bytes of a record.
    """
    with _opened(path, what, least) as (file, number):
        for index in range(number):
            file.doing = f"{what} {index + 1} of {number}"
            yield file


def record_blocks(
    path: Path, what: str, layout: np.dtype[Any], item_bytes: int, *, whole: bool
) -> Iterator[tuple[bytes, NDArray[np.int64]]]:
    """Yield the records of a file in blocks: the bytes of a block, and the indices (k,) of the records' first bytes.

    A record is a fixed part and a list of items. The fixed part ends with the number of items, as 8 bytes.

    what: the kind of record, for messages.
    layout: the fixed part. item_bytes: number of bytes of an item.
    whole: True to put the complete list of each record into the block of the record. False to skip the rest of a list
        that does not fit into the block.
    """
    head, length_at = layout.itemsize, COLMAP_COUNT.unpack_from
    number, kept, least = 0, b"", head
    with _opened(path, what, head) as (file, total):
        while number < total:
            file.doing = f"{what} {number + 1} of {total}"
            file.need(least - len(kept))
            data = kept + file.take(min(max(RECORD_BLOCK_BYTES, least - len(kept)), file.left))
            begins, at, last = array("q"), 0, len(data) - head
            for _ in range(total - number):
                if at > last:
                    break
                begins.append(at)
                at += head + item_bytes * length_at(data, at + head - COLMAP_COUNT.size)[0]
            least = head
            if at > len(data) and whole:
                least, at = at - begins[-1], begins.pop()
            elif at > len(data):
                file.doing = f"{what} {number + len(begins)} of {total}"
                file.skip(at - len(data))
            number, kept = number + len(begins), data[at:]
            if begins:
                yield data, np.frombuffer(begins, np.int64)
        file.left += len(kept)


def at_each(data: bytes, begins: NDArray[np.int64], layout: np.dtype[Any]) -> NDArray[Any]:
    """Return the values (k,) of type `layout` at the indices `begins` (k,) of some bytes, aligned or not."""
    each = np.ndarray(max(len(data) - layout.itemsize + 1, 0), layout, data, strides=(1,))  # one at every byte
    return each[begins]


def corrupt(path: Path, trouble: str) -> InputError:
    """Return the error for invalid contents of a model's file."""
    return InputError(f"{path}: truncated or corrupt: {trouble}; copy the file again or export the model again")


def file_of(folder: Path, stem: str) -> Path | None:
    """Return the file of a model, binary or else text; None if there is neither. stem: "cameras" or the like."""
    for extension in (".bin", ".txt"):
        path = folder / (stem + extension)
        if is_file(path):
            return path
    if not os.path.isdir(folder):  # noqa: PTH112  # Path.is_dir raises for a long name
        return None
    lower = {
        f"{stem}{extension}".lower() for extension in (".bin", ".txt")
    }  # hierarchical-3d-gaussians writes points3d in lower case
    return next((path for path in sorted(folder.iterdir()) if path.name.lower() in lower and is_file(path)), None)


def require_file(folder: Path, stem: str) -> Path:
    """Return the file of a model like `file_of`. Raises InputError if there is none."""
    path = file_of(folder, stem)
    if path is None:
        raise InputError(f"{folder}: has no {stem}.bin or {stem}.txt, expected a COLMAP model with cameras and images")
    return path


def check_count(path: Path, count: int) -> None:
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


def line_blocks(path: Path) -> Iterator[tuple[int, list[str]]]:
    """Yield the lines of a text file in blocks: the number of the block's first line, and the stripped lines.

    Comments and empty lines are among them. Raises InputError for a line that is too long, or text in another encoding.
    """
    with open_input(path, COLMAP_FILE_KIND) as opened:
        wide = opened.read(2) in (codecs.BOM_UTF16_LE, codecs.BOM_UTF16_BE)  # PowerShell writes text in UTF-16
        opened.seek(0)
        encoding, errors = ("utf-16", "strict") if wide else ("utf-8-sig", "surrogateescape")
        decoder = io.IncrementalNewlineDecoder(codecs.getincrementaldecoder(encoding)(errors), translate=True)
        first, rest, data = 1, "", b" "
        while data:
            data = opened.read(TEXT_BLOCK_BYTES)
            try:
                block = decoder.decode(data, final=not data).split("\n")
            except UnicodeDecodeError:
                raise corrupt(path, "is not text in UTF-8 or UTF-16") from None
            block[0] = rest + block[0]
            rest = block.pop()
            if (len(block[0]) + 1 if block else len(rest)) >= MAX_LINE_CHARACTERS:
                raise corrupt(path, f"line {first} has over {MAX_LINE_CHARACTERS:,} characters")
            if rest and not data:
                block.append(rest)
            if block:
                yield first, list(map(str.strip, block))
            first += len(block)


def lines_of(path: Path, *, keep_empty: bool = False) -> Iterator[tuple[int, str]]:
    """Yield numbers and stripped text of a file's lines, without comments."""
    for first, block in line_blocks(path):
        for number, line in enumerate(block, first):
            if not line.startswith("#") and (line or keep_empty):
                yield number, line


@contextmanager
def parsing(path: Path, number: int, expected: str) -> Iterator[None]:
    """Context manager that raises InputError in place of an error of Python for a line. number: the line's number."""
    try:
        yield
    except (ValueError, IndexError, OverflowError):
        raise unreadable(path, number, expected) from None


def unreadable(path: Path, number: int, expected: str) -> InputError:
    """Return the error for line `number` of a text file. expected: the fields of a valid line."""
    return InputError(f"{path}: line {number} does not read as {expected}; is the file damaged?")


def camera_rows(path: Path) -> Iterator[tuple[int, Lens]]:
    """Yield id and lens of each camera of cameras.bin or cameras.txt."""
    return _binary_cameras(path) if path.suffix == ".bin" else _text_cameras(path)


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


def claimed_images(folder: Path) -> int:
    """Return the number of images in a model, by images.bin's header or images.txt's lines; -1 without such a file."""
    path = file_of(folder, "images")
    if path is None:
        return -1
    if path.suffix == ".bin":
        with open_input(path, COLMAP_FILE_KIND) as file:
            return int.from_bytes(file.read(8), "little")
    return sum(1 for _ in _image_lines(path))


def image_rows(path: Path) -> Iterator[ImageRow]:
    """Yield the images of images.bin or images.txt, without their observations."""
    return _binary_images(path) if path.suffix == ".bin" else _text_images(path)


def _binary_images(path: Path) -> Iterator[ImageRow]:
    head = struct.Struct("<I7dI")
    for file in records(path, "image", head.size + 1 + COLMAP_COUNT.size):
        key, *pose, camera = file.read(head)
        name = file.name()
        (observations,) = file.read(COLMAP_COUNT)
        file.skip(int(observations) * OBSERVATION_BYTES)
        yield int(key), name, int(camera), tuple(pose)


def _text_images(path: Path) -> Iterator[ImageRow]:
    for number, line, expected in _image_lines(path):
        with parsing(path, number, expected):
            words = line.split(maxsplit=9)  # the name is the rest of the line, spaces included
            yield int(words[0]), words[9], int(words[8]), tuple(map(float, words[1:8]))


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


def point_blocks(path: Path) -> Iterator[PointBlock]:
    """Yield the points of points3D.bin or points3D.txt in blocks, without their tracks."""
    return _binary_points(path) if path.suffix == ".bin" else _text_points(path)


def _binary_points(path: Path) -> Iterator[PointBlock]:
    for data, begins in record_blocks(path, "point", POINT_RECORD, TRACK_BYTES, whole=False):
        points = at_each(data, begins, POINT_RECORD)
        yield points["place"], points["levels"].copy()  # a copy, as a view keeps all fields


def _text_points(path: Path) -> Iterator[PointBlock]:
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
        table = values_of(values).reshape(-1, 6)
        with np.errstate(invalid="ignore"):
            levels = table[:, 3:].astype(np.uint8)
        yield table[:, :3], levels if (levels == table[:, 3:]).all() else table[:, 3:].copy()


def track_blocks(path: Path) -> Iterator[TrackBlock]:
    """Yield the points of points3D.bin or points3D.txt in blocks, with their tracks."""
    return _binary_tracks(path) if path.suffix == ".bin" else _text_tracks(path)


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
        yield rows_of(places), values_of(errors), values_of(lengths), values_of(images)


def rows_of(values: array[float]) -> Float64:
    """Return numbers in rows of three (N, 3), in the memory of `values`."""
    rows: Float64 = values_of(values).reshape(-1, 3)
    return rows


def values_of(values: array[Any]) -> NDArray[Any]:
    """Return numbers (N,) in the memory of `values`."""
    return np.frombuffer(values, values.typecode) if values else np.empty(0, values.typecode)
