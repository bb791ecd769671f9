# SPDX-License-Identifier: Apache-2.0
"""Disk cache of decoded photographs (--cache): a file for each photograph and size, with the same pixels.

A file has a header and the pixels. The header has the shape, the type, a key and a checksum of header and pixels. The
key is a digest of everything that the pixels depend on, and also names the file. Files are read and not mapped, because
a file that is cut short while it is mapped would end the process (docs/decisions/0045-photographs-by-the-slice.md).
"""

from __future__ import annotations

import hashlib
import json
import os
import struct
import threading
import time
import zlib
from collections.abc import Sequence
from contextlib import suppress
from pathlib import Path
from typing import Any

import numpy as np
import OpenImageIO as oiio
from numpy.typing import NDArray

from clsplat.errors import WriteError, reason_of
from clsplat.files.atomic import TEMPORARY_NAME, atomic_name, is_abandoned, remove
from clsplat.files.mounts import NetworkRate
from clsplat.images.decoders.photo_decoders import decoder_versions
from clsplat.version import package_version

FORMAT_VERSION = 2
SUFFIX = ".pixels"
KEY_BYTES = 32
_MAGIC = b"clsplat\x00"
_HEADER = struct.Struct(f"<8sIIIII{KEY_BYTES}s")
_CHECKSUM = struct.Struct("<I")
_TYPES: tuple[type[np.generic], ...] = (np.uint8, np.float32)
_HEADER_BYTES = _HEADER.size + _CHECKSUM.size


def key_of(parts: Sequence[object]) -> bytes:
    """Key of decoded pixels: digest of `parts`, and of the versions of this package, the format and the decoders."""
    versions = [FORMAT_VERSION, package_version(), oiio.VERSION_STRING, *decoder_versions()]
    text = json.dumps([versions, *parts], default=repr)
    return hashlib.blake2b(text.encode("utf-8", "surrogatepass"), digest_size=KEY_BYTES).digest()


class DecodedStore:
    """Folder of decoded photographs, which several threads and processes may use at the same time.

    A damaged file counts as missing. If writing a file fails, no further files are written. Each kind of failure is
    reported once, by `notes`.
    """

    def __init__(self, folder: Path) -> None:
        self.folder = folder
        self.writable = True
        self._lock = threading.Lock()
        self._notes: list[str] = []
        self._told_damage = False
        self._rate = NetworkRate(folder, "--cache")
        try:
            folder.mkdir(parents=True, exist_ok=True)
            self._remove_abandoned()
        except OSError as error:
            self._give_up(reason_of(error))

    def path(self, key: bytes) -> Path:
        """Path of the file for the pixels with this key."""
        return self.folder / f"{key.hex()}{SUFFIX}"

    def read(self, key: bytes) -> NDArray[Any] | None:
        """Pixels (H, W, C) of the file with this key; None if there is no such file, or if it is damaged."""
        path, start = self.path(key), time.perf_counter()
        try:
            pixels = _read(path, key)
        except FileNotFoundError:
            return None
        except (OSError, ValueError) as error:
            self._damaged(path, reason_of(error) if isinstance(error, OSError) else str(error))
            return None
        self._count(pixels.nbytes, time.perf_counter() - start)
        return pixels

    def write(self, key: bytes, pixels: NDArray[Any]) -> None:
        """Write pixels (H, W, C), uint8 or float32. After a failure the store writes nothing more."""
        if not self.writable:
            return
        path, start = self.path(key), time.perf_counter()
        pixels = np.ascontiguousarray(pixels)
        header = _HEADER.pack(_MAGIC, FORMAT_VERSION, _TYPES.index(pixels.dtype.type), *pixels.shape, key)
        try:
            # no flush to the disk, which takes long: the checksum tells if a power cut has damaged the file
            with atomic_name(path, _HEADER_BYTES + pixels.nbytes) as temporary, open(temporary, "xb") as file:
                file.write(header + _CHECKSUM.pack(_checksum(header, pixels)))
                file.write(pixels.data)
        except OSError as error:
            self._give_up(str(error.strerror) if isinstance(error, WriteError) else reason_of(error))
            return
        self._count(pixels.nbytes, time.perf_counter() - start)

    def notes(self) -> list[str]:
        """Return the warnings for the user that have not been returned yet."""
        if not self._notes:
            return []
        with self._lock:
            notes, self._notes = self._notes, []
        return notes

    def _remove_abandoned(self) -> None:
        """Remove the temporary files of processes that have ended."""
        for path in self.folder.iterdir():
            with suppress(OSError):
                if _is_abandoned(path):
                    remove(path)

    def _give_up(self, reason: str) -> None:
        with self._lock:
            if self.writable:
                self.writable = False
                self._notes.append(
                    f"{self.folder}: no decoded photographs can be written there ({reason}); a photograph that this "
                    "cache lacks is decoded each time it is used"
                )

    def _damaged(self, path: Path, reason: str) -> None:
        with self._lock:
            if not self._told_damage:
                self._told_damage = True
                self._notes.append(
                    f"{path}: is not an intact file of decoded pixels ({reason}); the photograph is decoded again "
                    "(further damaged files are not reported)"
                )

    def _count(self, nbytes: int, seconds: float) -> None:
        """Count bytes that were read or written in `seconds`, and note a warning if the folder is on a network disk."""
        with self._lock:
            if note := self._rate.count(nbytes, seconds):
                self._notes.append(note)


def remove_decoded(folder: Path) -> None:
    """Remove all decoded photographs from a folder, and the folder if nothing else is in it.

    A file that another process is writing stays.
    """
    with suppress(OSError):
        for path in folder.iterdir():
            if path.suffix == SUFFIX or _is_abandoned(path):
                remove(path)
        folder.rmdir()


def _is_abandoned(path: Path) -> bool:
    """True if `path` is a temporary file of this cache whose process has ended. Raises OSError."""
    match = TEMPORARY_NAME.fullmatch(path.name)
    return match is not None and match[1].endswith(SUFFIX) and is_abandoned(path, match[2])


def _read(path: Path, key: bytes) -> NDArray[Any]:
    """Pixels (H, W, C) of a file. Raises OSError, and ValueError for a damaged file or a file with another key."""
    with open(path, "rb", buffering=0) as file:
        size = os.fstat(file.fileno()).st_size
        head = file.read(_HEADER_BYTES)
        if len(head) < _HEADER_BYTES:
            raise ValueError(f"it has only {len(head)} bytes, expected a header of {_HEADER_BYTES}")
        magic, version, kind, height, width, channels, own = _HEADER.unpack(head[: _HEADER.size])
        if (magic, version, own) != (_MAGIC, FORMAT_VERSION, key) or kind >= len(_TYPES):
            raise ValueError("its header has another format, version or key")
        wanted = height * width * channels * np.dtype(_TYPES[kind]).itemsize
        if size != _HEADER_BYTES + wanted:
            raise ValueError(f"it has {size:,} bytes, expected {_HEADER_BYTES + wanted:,}")
        pixels = np.empty((height, width, channels), _TYPES[kind])
        rest = pixels.reshape(-1).view(np.uint8).data
        while rest and (count := file.readinto(rest)):
            rest = rest[count:]
    if rest:
        raise ValueError("it was cut short while it was read")
    if _CHECKSUM.unpack(head[_HEADER.size :])[0] != _checksum(head[: _HEADER.size], pixels):
        raise ValueError("its checksum is wrong")
    return pixels


def _checksum(header: bytes, pixels: NDArray[Any]) -> int:
    return zlib.crc32(pixels.reshape(-1).view(np.uint8).data, zlib.crc32(header))
