# SPDX-License-Identifier: Apache-2.0
"""Table of the photographs that OpenImageIO's wheel does not decode: HEIF, AVIF and raw files.

A file's first bytes select the decoder. The extension counts only for raw files that begin like any TIFF.
"""

from __future__ import annotations

from collections.abc import Callable, Iterable
from dataclasses import dataclass
from functools import cache
from importlib.metadata import PackageNotFoundError, version
from importlib.util import find_spec
from pathlib import Path

from clsplat.errors import InputError
from clsplat.images.decoders.avif import open_avif_photo
from clsplat.images.decoders.decoded_photo import DecodedPhoto
from clsplat.images.decoders.heif import open_heif_photo
from clsplat.images.decoders.raw import open_raw_photo
from clsplat.images.decoders.tiff_tags import TIFF_BYTE_ORDERS, is_dng

PHOTO_HEAD_BYTES = 64
"""Number of a file's first bytes from which `decoder_of` recognises a photograph."""
_HEIF_BRANDS = frozenset({b"heic", b"heix", b"heim", b"heis", b"hevc", b"hevx", b"hevm", b"hevs", b"mif1", b"msf1"})
_AVIF_BRANDS = frozenset({b"avif", b"avis"})
_RAW_SIGNATURES = (b"FUJIFILMCCD-RAW", b"IIRO", b"IIRS", b"MMOR", b"IIU\0")
"""First bytes of RAF, ORF (three) and RW2."""
_TIFF_RAW_EXTENSIONS = (".nef", ".arw")


@dataclass(frozen=True)
class PhotoDecoder:
    """Decoder of a kind of photographs.

    kind: name of the photographs for messages, with its article.
    extensions: lower-case extensions of their files.
    module: the Python module that decodes.
    open: function that opens a photograph without decoding its pixels. Raises InputError.
    """

    kind: str
    extensions: tuple[str, ...]
    module: str
    open: Callable[[Path], DecodedPhoto]


PHOTO_DECODERS = {
    "heif": PhotoDecoder("a HEIC photograph", (".heic", ".heif", ".hif"), "pillow_heif", open_heif_photo),
    "avif": PhotoDecoder("an AVIF photograph", (".avif",), "PIL._avif", open_avif_photo),
    "raw": PhotoDecoder(
        "a raw photograph", (".dng", ".cr2", ".cr3", ".nef", ".arw", ".raf", ".orf", ".rw2"), "rawpy", open_raw_photo
    ),
}
"""Decoder by the name of its format."""
DECODED_PHOTO_EXTENSIONS = tuple(extension for each in PHOTO_DECODERS.values() for extension in each.extensions)
"""Extensions of the photographs that these decoders read."""
LOSSY_PHOTO_FORMATS = ("heif", "avif")
"""Names of the formats whose compression changes values."""


def decoder_of(path: Path, head: bytes) -> PhotoDecoder | None:
    """Return the decoder of a file; None if OpenImageIO should read it. head: its first PHOTO_HEAD_BYTES."""
    brands = _brands(head)
    if brands & _AVIF_BRANDS:
        return PHOTO_DECODERS["avif"]
    if brands & _HEIF_BRANDS:
        return PHOTO_DECODERS["heif"]
    if b"crx " in brands or head.startswith(_RAW_SIGNATURES) or _is_raw_tiff(path, head):
        return PHOTO_DECODERS["raw"]
    return None


@cache
def decoder_versions() -> tuple[str, ...]:
    """Return the versions of pillow, pillow-heif and rawpy, "" for a package that is not installed."""
    found = []
    for package in ("pillow", "pillow-heif", "rawpy"):
        try:
            found.append(version(package))
        except PackageNotFoundError:
            found.append("")
    return tuple(found)


def lacks_decoder(path: Path) -> bool:
    """Return True if the package that decodes files with this extension is not installed."""
    extension = path.suffix.lower()
    return any(extension in each.extensions and find_spec(each.module) is None for each in PHOTO_DECODERS.values())


def wrong_contents(path: Path, head: bytes) -> InputError | None:
    """Return the error for a file with an extension of PHOTO_DECODERS but other contents; None for other extensions.

    head: first bytes of the file, which no decoder recognises.
    """
    extension = path.suffix.lower()
    kind = next((each.kind for each in PHOTO_DECODERS.values() if extension in each.extensions), "")
    if not kind:
        return None
    begin = f"begins with {head[:12]!r}" if head else "is empty"
    return InputError(f"{path}: does not decode: {begin}, expected {kind}; copy it again or leave it out")


def without_converted(paths: Iterable[Path]) -> tuple[list[Path], list[Path]]:
    """Return the pictures to use, and the photographs of PHOTO_DECODERS that also exist in another format.

    IMG_1.dng and IMG_1.heic are left out if IMG_1.jpg or IMG_1.heic.jpg is in their folder. Cameras write a JPEG beside
    a raw file, and users convert HEIC for other programs. IMG_1.heic.png may be a mask, by COLMAP's rule for names.
    """
    pictures = list(paths)
    stems = set()
    for path in pictures:
        extension, stem = path.suffix.lower(), path.stem.casefold()
        is_mask = extension == ".png" and stem.endswith(DECODED_PHOTO_EXTENSIONS)
        if extension not in DECODED_PHOTO_EXTENSIONS and not is_mask:
            stems.add((path.parent, stem))
    used: list[Path] = []
    converted: list[Path] = []
    for path in pictures:
        names = {(path.parent, path.stem.casefold()), (path.parent, path.name.casefold())}
        again = path.suffix.lower() in DECODED_PHOTO_EXTENSIONS and bool(names & stems)
        (converted if again else used).append(path)
    return used, converted


def _brands(head: bytes) -> set[bytes]:
    """Return the brands in the first box of an ISO media file; empty for other files."""
    if len(head) < 16 or head[4:8] != b"ftyp":
        return set()
    end = min(int.from_bytes(head[:4], "big"), len(head))
    return {head[8:12], *(head[at : at + 4] for at in range(16, end - 3, 4))}


def _is_raw_tiff(path: Path, head: bytes) -> bool:
    """Return True for a TIFF that is a DNG or CR2 by its contents, or a NEF or ARW by its extension."""
    order = TIFF_BYTE_ORDERS.get(head[:4])
    if order is None or len(head) < 10:
        return False
    if head[8:10] == b"CR" or path.suffix.lower() in _TIFF_RAW_EXTENSIONS:
        return True
    return is_dng(path, order)
