# SPDX-License-Identifier: Apache-2.0
"""Raw photographs of cameras (DNG, CR2, CR3, NEF, ARW, RAF, ORF, RW2), developed by rawpy (LibRaw).

The development depends on the file's header alone: the camera's white balance and white level, sRGB primaries and the
sRGB curve, 16 bits, no automatic brightness. So two photographs with the same exposure and white balance agree in the
colours of the same surface.
"""

from __future__ import annotations

import io
from pathlib import Path
from typing import Any

import numpy as np
import OpenImageIO as oiio
from numpy.typing import NDArray

from clsplat.errors import InputError
from clsplat.files.names import native_name
from clsplat.images.decoders.decoded_photo import DecodedPhoto, photo_spec, undecodable, without_extra
from clsplat.images.decoders.tiff_tags import TIFF_BYTE_ORDERS, is_cut_off

SRGB_GAMMA = (2.4, 12.92)
"""Exponent of the sRGB curve and slope of its linear part, for LibRaw."""
EXIF_SEARCH_BYTES = 1 << 20
"""Number of bytes read to find the EXIF data of a raw file."""
_ORIENTATION_BY_FLIP = {0: 1, 1: 2, 3: 3, 2: 4, 4: 5, 6: 6, 7: 7, 5: 8}
"""EXIF orientation by LibRaw's number for it, `flip`."""
_FUJI_SIGNATURE, _FUJI_JPEG_OFFSET = b"FUJIFILMCCD-RAW", 84
"""First bytes of RAF, and the offset at which RAF gives the offset of its JPEG preview, which has the EXIF data."""


def open_raw_photo(path: Path) -> DecodedPhoto:
    """Open a raw photograph, without developing its pixels.

    Raises InputError if rawpy is missing, or the file is not a raw photograph that LibRaw knows.
    """
    try:
        import rawpy
    except ImportError:
        raise without_extra(path, "a raw photograph", "rawpy") from None
    _check_is_whole(path)
    try:
        with rawpy.RawPy() as raw:
            raw.open_file(native_name(path))
            sizes, lens, taken = raw.sizes, raw.lens, raw.other
    except Exception as error:  # noqa: BLE001  # LibRawError, OSError, and ValueError for dates
        raise undecodable(path, "a raw photograph", error) from None
    width, height = _developed_size(sizes)
    spec = photo_spec(width, height, "RGB", oiio.UINT16, _exif(path))
    spec.attribute("Orientation", _ORIENTATION_BY_FLIP.get(int(sizes.flip), 1))
    if taken.focal_length > 0:  # LibRaw also finds the focal length in maker notes
        spec.attribute("Exif:FocalLength", float(taken.focal_length))
    for name, text in (("Exif:LensMake", lens.make), ("Exif:LensModel", lens.model)):
        if text and not spec.get_string_attribute(name):
            spec.attribute(name, text)
    return DecodedPhoto("raw", spec, lambda: (_developed(path), 65535.0))


def _check_is_whole(path: Path) -> None:
    """Raise InputError for a truncated TIFF file. For such a file, LibRaw would print a message of its own."""
    with open(path, "rb") as file:
        order = TIFF_BYTE_ORDERS.get(file.read(4))
    if order and is_cut_off(path, order):
        size = path.stat().st_size
        raise InputError(
            f"{path}: does not decode: the raw photograph ends early, after {size} bytes; copy it again or leave it out"
        )


def _developed_size(sizes: Any) -> tuple[int, int]:
    """Return width and height of the developed picture before its rotation. LibRaw makes pixels square."""
    aspect = sizes.pixel_aspect or 1.0
    height = int(sizes.height / aspect + 0.5) if aspect < 0.995 else sizes.height
    return (int(sizes.width * aspect + 0.5) if aspect > 1.005 else sizes.width), height


def _developed(path: Path) -> NDArray[Any]:
    """Develop a raw photograph to 16 bits (H, W, 3), not rotated."""
    import rawpy

    with rawpy.RawPy() as raw:
        raw.open_file(native_name(path))
        raw.unpack()
        balance = raw.camera_whitebalance
        pixels: NDArray[Any] = raw.postprocess(
            # False gives the daylight balance, which depends on the camera alone. With True and no balance in the file,
            # LibRaw would compute one from the picture.
            use_camera_wb=min(balance[:3]) > 0,
            output_color=rawpy.ColorSpace.sRGB,
            gamma=SRGB_GAMMA,
            no_auto_bright=True,
            adjust_maximum_thr=0.0,  # by default, white would depend on the picture's maximum
            output_bps=16,
            user_sat=_full_exposure(raw),
            user_flip=0,
        )
    grey = pixels.ndim == 2 or pixels.shape[2] == 1  # from a monochrome camera
    return np.repeat(pixels.reshape(*pixels.shape[:2], 1), 3, axis=2) if grey else pixels


def _full_exposure(raw: Any) -> int | None:
    """Return the number of sensor levels from black to white; None to keep LibRaw's number.

    For LinearRaw DNGs, as phones write them, with a black level for each channel, LibRaw 0.22 does not subtract the
    black level from the white level. White would then be up to 5 % too dark.
    """
    import rawpy

    black = raw.black_level_per_channel
    if raw.raw_type != rawpy.RawType.Stack or len(black) < 4 or black[3] or not min(black[:3]):
        return None
    return int(raw.white_level) - int(min(black[:3]))


def _exif(path: Path) -> bytes | None:
    """Return the EXIF data of a raw file; None if it has none, or for CR3, whose EXIF data is not read."""
    with open(path, "rb") as file:
        head = file.read(EXIF_SEARCH_BYTES)
        if head.startswith(_FUJI_SIGNATURE):
            place = head[_FUJI_JPEG_OFFSET : _FUJI_JPEG_OFFSET + 4]
            file.seek(int.from_bytes(place, "big"))
            return _exif_of_jpeg(file.read(EXIF_SEARCH_BYTES))
    if head[:2] in (b"II", b"MM"):  # a TIFF, or ORF and RW2, which differ in the next two bytes
        return head[:2] + (b"*\0" if head[:2] == b"II" else b"\0*") + head[4:]
    return None


def _exif_of_jpeg(data: bytes) -> bytes | None:
    from PIL import Image

    try:
        with Image.open(io.BytesIO(data)) as picture:
            exif = picture.info.get("exif")
    except Exception:  # noqa: BLE001  # Pillow raises struct's, Python's and its own errors for damaged files
        return None
    return exif if isinstance(exif, bytes) else None
