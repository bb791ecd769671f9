# SPDX-License-Identifier: Apache-2.0
"""Photographs as cameras and phones write them: EXIF data, HEIC, AVIF, and DNG of known linear values."""

from __future__ import annotations

import struct
from collections.abc import Mapping, Sequence
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import NDArray

XYZ_TO_LINEAR_SRGB = (3.2404542, -1.5371385, -0.4985314, -0.9692660, 1.8760108, 0.0415560, 0.0556434, -0.2040259,
                      1.0572252)  # fmt: skip
"""Matrix of a camera whose channels are linear sRGB."""
EXIF_IFD, GPS_IFD = 0x8769, 0x8825
Tags = dict[int, tuple[int, int, bytes]]
"""TIFF tags: type, number of values, and bytes."""


def exif_bytes(
    orientation: int = 1, focal_mm: float = 0.0, equivalent_mm: int = 0, *, gps: bool = False, lens: str = ""
) -> bytes:
    """EXIF data of the camera "Acme Cam 1", for Pillow and pillow-heif. gps: the position 47.5 N, 8.25 E, 400 m."""
    from PIL import Image
    from PIL.TiffImagePlugin import IFDRational

    record = Image.Exif()
    record[0x112], record[0x10F], record[0x110] = orientation, "Acme", "Cam 1"
    table = record.get_ifd(EXIF_IFD)
    table[0x829A], table[0x829D], table[0x8827] = IFDRational(1, 100), IFDRational(4, 1), 200
    if focal_mm:
        table[0x920A] = IFDRational(round(1000 * focal_mm), 1000)
    if equivalent_mm:
        table[0xA405] = equivalent_mm
    if lens:
        table[0xA434] = lens
    if gps:
        place = record.get_ifd(GPS_IFD)
        place.update({1: "N", 2: (47.0, 30.0, 0.0), 3: "E", 4: (8.0, 15.0, 0.0), 5: b"\0", 6: IFDRational(400, 1)})
    return record.tobytes()


def write_heic(path: Path, pixels: NDArray[Any], exif: bytes = b"", *, profile: bytes = b"", **settings: Any) -> Path:
    """Write stored pixels (H, W, 3 or 4) of uint8, or of uint16 from 0 to 1023, as HEIC; without loss by default.

    An orientation in `exif` becomes the file's properties irot and imir. profile: an ICC profile.
    """
    import pillow_heif

    height, width, channels = pixels.shape
    mode, data = ("RGB" if channels == 3 else "RGBA"), pixels
    if pixels.dtype == np.uint16:
        mode, data = f"{mode};16", pixels << 6
    file = pillow_heif.HeifFile()
    frame = file.add_frombytes(mode, (width, height), np.ascontiguousarray(data).tobytes())
    if profile:
        frame.info["icc_profile"], frame.info["icc_profile_type"] = profile, "prof"
    lossless = {"quality": -1, "chroma": 444, "matrix_coefficients": 0}
    file.save(path, **({"exif": exif} if exif else {}), **(settings or lossless))
    return path


def write_avif(path: Path, pixels: NDArray[Any], exif: bytes = b"") -> Path:
    """Write stored pixels (H, W, 3 or 4) as AVIF, with as little loss as Pillow offers."""
    from PIL import Image

    options = {"exif": exif} if exif else {}
    Image.fromarray(pixels).save(path, "AVIF", quality=100, subsampling="4:4:4", **options)
    return path


def write_dng(
    path: Path,
    values: NDArray[Any],
    *,
    orientation: int = 1,
    neutral: Sequence[float] = (1.0, 1.0, 1.0),
    black: int = 0,
    white: int = 65535,
    focal: tuple[int, int] | None = None,
    mosaic: bool = True,
) -> Path:
    """Write an uncompressed DNG of a camera whose channels are linear sRGB.

    values: the sensor's integers: (H, W, 3), or (H, W) in the pattern red, green / green, blue.
    mosaic: False for a camera without colours, with values (H, W).
    neutral: the camera's values of a white surface, as a fraction of the largest.
    black, white: the sensor's values of no light and of full exposure.
    focal: EXIF's focal length, and its 35 mm equivalent, in whole millimetres.
    """
    (height, width), planes = values.shape[:2], 1 if values.ndim == 2 else 3
    data = values.astype("<u2").tobytes()
    tags: Tags = {
        254: _longs(0),
        256: _longs(width),
        257: _longs(height),
        258: _shorts(*[16] * planes),
        259: _shorts(1),
        262: _shorts(32803 if planes == 1 and mosaic else 34892),
        271: _text("Acme"),
        272: _text("Cam 1"),
        274: _shorts(orientation),
        277: _shorts(planes),
        278: _longs(height),
        279: _longs(len(data)),
        284: _shorts(1),
        50706: _bytes(1, 4, 0, 0),
        50707: _bytes(1, 1, 0, 0),
        50708: _text("Acme Cam 1"),
        50714: _longs(*[black] * planes),
        50717: _longs(*[white] * planes),
        50721: _fractions(10, XYZ_TO_LINEAR_SRGB),
        50728: _fractions(5, neutral),
        50778: _shorts(21),
    }
    if planes == 1 and mosaic:
        tags |= {33421: _shorts(2, 2), 33422: _bytes(0, 1, 1, 2), 50710: _bytes(0, 1, 2), 50711: _shorts(1)}
    exif: Tags = {}
    if focal:
        exif = {0x920A: _fractions(5, focal[:1]), 0xA405: _shorts(focal[1])}
    # the places of the pixels and of EXIF follow from the directories' lengths, which do not depend on them
    pixels_at = exif_at = 0
    for _ in range(2):
        placed = {**tags, 273: _longs(pixels_at), **({EXIF_IFD: _longs(exif_at)} if exif else {})}
        first = _directory(placed, 8)
        exif_at = 8 + len(first)
        second = _directory(exif, exif_at) if exif else b""
        pixels_at = exif_at + len(second)
    path.write_bytes(b"II*\0" + struct.pack("<I", 8) + first + second + data)
    return path


def _directory(tags: Mapping[int, tuple[int, int, bytes]], at: int) -> bytes:
    entries, values = b"", b""
    values_at = at + 2 + 12 * len(tags) + 4
    for tag in sorted(tags):
        kind, count, data = tags[tag]
        if len(data) > 4:
            place = struct.pack("<I", values_at + len(values))
            values += data + bytes(len(data) % 2)
            data = place
        entries += struct.pack("<HHI", tag, kind, count) + data.ljust(4, b"\0")
    return struct.pack("<H", len(tags)) + entries + bytes(4) + values


def _bytes(*values: int) -> tuple[int, int, bytes]:
    return 1, len(values), bytes(values)


def _text(value: str) -> tuple[int, int, bytes]:
    return 2, len(value) + 1, value.encode() + b"\0"


def _shorts(*values: int) -> tuple[int, int, bytes]:
    return 3, len(values), struct.pack(f"<{len(values)}H", *values)


def _longs(*values: int) -> tuple[int, int, bytes]:
    return 4, len(values), struct.pack(f"<{len(values)}I", *values)


def _fractions(kind: int, values: Sequence[float]) -> tuple[int, int, bytes]:
    """kind: 5 for unsigned fractions, 10 for signed ones."""
    return kind, len(values), b"".join(struct.pack("<ii", round(1_000_000 * each), 1_000_000) for each in values)
