# SPDX-License-Identifier: Apache-2.0
"""Files of a COLMAP model: where they are, records of binary files, lines of text files, and their errors."""

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

from clsplat.errors import InputError, warn
from clsplat.files.documents import is_file, open_input

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


def records(path: Path, what: str, least: int) -> Iterator[Records]:
    """Yield a reader at the beginning of each record that the file's header announces.

    what: the kind of record, for messages.
    least: minimum number of bytes of a record.
    """
    with open_input(path, COLMAP_FILE_KIND) as opened:
        file = Records(path, opened)
        number = file.count(what, least)
        for index in range(number):
            file.doing = f"{what} {index + 1} of {number}"
            yield file
        file.end(what, number)


def record_blocks(
    path: Path, what: str, layout: np.dtype[Any], item_bytes: int, *, whole: bool
) -> Iterator[tuple[bytes, NDArray[np.int64]]]:
    """Yield the records of a file in blocks: the bytes of a block, and the indices (k,) of the records' first bytes.

    A record is a fixed part and a list of items. The fixed part ends with the number of items, as 8 bytes.

    what: the kind of record, for messages.
    layout: the fixed part. item_bytes: number of bytes of an item.
    whole: True if a block has the lists of all its records. False if lists are not needed: those that are not in the
        block are skipped.
    """
    head, length_at = layout.itemsize, COLMAP_COUNT.unpack_from
    number, kept, least = 0, b"", head
    with open_input(path, COLMAP_FILE_KIND) as opened:
        file = Records(path, opened)
        total = file.count(what, head)
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
        file.end(what, total)


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
