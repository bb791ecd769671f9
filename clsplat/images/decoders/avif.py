# SPDX-License-Identifier: Apache-2.0
"""AVIF photographs, decoded by Pillow (libavif) to 8 bits a channel.

Photographs are turned upright as the file says (its properties irot and imir, which Pillow gives as an orientation).
As for HEIF, the orientation in the file's EXIF data is ignored.
"""

from __future__ import annotations

from importlib.util import find_spec
from pathlib import Path
from typing import Any

import numpy as np
import OpenImageIO as oiio
from numpy.typing import NDArray

from clsplat.images.decoders.decoded_photo import DecodedPhoto, photo_spec, undecodable, whole_file, without_extra
from clsplat.images.decoders.orientation import turned

_ORIENTATION_TAG = 0x112


def open_avif_photo(path: Path) -> DecodedPhoto:
    """Open the first image of an AVIF file, without decoding its pixels.

    Raises InputError if Pillow lacks libavif, or the header is damaged.
    """
    if find_spec("PIL._avif") is None:
        raise without_extra(path, "an AVIF photograph", "Pillow 11.3 or later with libavif")
    from PIL.AvifImagePlugin import AvifImageFile

    try:
        image: Any = AvifImageFile(whole_file(path))
        (width, height), channels, exif = image.size, image.mode, image.info.get("exif")
        profile = image.info.get("icc_profile")
        orientation = int(image.getexif().get(_ORIENTATION_TAG, 1))
    except Exception as error:  # noqa: BLE001  # SyntaxError, ValueError, OSError, struct.error and others
        raise undecodable(path, "an AVIF photograph", error) from None
    if orientation >= 5:
        width, height = height, width
    spec = photo_spec(width, height, channels.replace("L", "Y"), oiio.UINT8, exif, profile)

    def decode() -> tuple[NDArray[Any], float]:
        pixels = np.asarray(image)
        return turned(pixels.reshape(*pixels.shape[:2], -1), orientation), 255.0

    return DecodedPhoto("avif", spec, decode)
