# SPDX-License-Identifier: Apache-2.0
"""HEIF photographs (.heic, .heif, .hif), decoded by pillow-heif (libheif).

libheif turns and mirrors pixels as the file says (its properties irot and imir). So photographs are always upright, and
the orientation in EXIF, which repeats these properties, is ignored.
"""

from __future__ import annotations

from pathlib import Path
from typing import Any

import numpy as np
import OpenImageIO as oiio
from numpy.typing import NDArray

from clsplat.images.decoders.decoded_photo import DecodedPhoto, photo_spec, undecodable, whole_file, without_extra

_CHANNELS = {"L": "Y", "LA": "YA", "La": "YA", "RGB": "RGB", "RGBA": "RGBA", "RGBa": "RGBA"}
"""Letters of the channels by pillow-heif's image mode, without the ";" and number of bits at the end of some modes."""


def open_heif_photo(path: Path) -> DecodedPhoto:
    """Open the primary image of a HEIF file, without decoding its pixels.

    Raises InputError if pillow-heif is missing, or the header is damaged.
    """
    try:
        import pillow_heif
    except ImportError:
        raise without_extra(path, "a HEIC photograph", "pillow-heif") from None
    try:
        image: Any = pillow_heif.open_heif(whole_file(path), convert_hdr_to_8bit=False, hdr_to_16bit=False)
        (width, height), mode, exif = image.size, image.mode, image.info.get("exif")
        profile = image.info.get("icc_profile")
        bits, channels = int(image.info["bit_depth"]), _CHANNELS[mode.partition(";")[0]]
    except Exception as error:  # noqa: BLE001  # ValueError, EOFError, SyntaxError, RuntimeError, KeyError, IndexError
        raise undecodable(path, "a HEIC photograph", error) from None
    spec = photo_spec(width, height, channels, oiio.UINT8 if bits <= 8 else oiio.UINT16, exif, profile)
    if image.premultiplied_alpha:
        spec.attribute("oiio:UnassociatedAlpha", 0)

    def decode() -> tuple[NDArray[Any], float]:
        pixels = np.asarray(image).reshape(height, width, -1)
        return pixels, float((1 << bits) - 1)

    return DecodedPhoto("heif", spec, decode)
