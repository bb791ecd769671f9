# SPDX-License-Identifier: Apache-2.0
"""Conversion of photographs with an ICC profile of Display P3 or Adobe RGB to sRGB, where they are decoded (`in_srgb`).

LittleCMS, in Pillow, tells which space a profile describes, and converts pixels of 8 bits. OpenImageIO converts pixels
with more bits, which Pillow does not have, and pixels with premultiplied alpha.
"""

from __future__ import annotations

import io
from collections.abc import Callable
from dataclasses import dataclass
from functools import lru_cache
from typing import Any

import numpy as np
import OpenImageIO as oiio
from numpy.typing import NDArray

from clsplat.arrays import Float32
from clsplat.images.alpha import associate, unassociate
from clsplat.images.colour import linear_to_srgb, srgb_to_linear
from clsplat.images.decoders.decoded_photo import ICC_PROFILE_ATTRIBUTE

ADOBE_RGB_GAMMA = 563 / 256
"""Exponent of the curve of Adobe RGB (1998)."""
MAX_SAME_SPACE_LEVELS = 2.0
"""Largest difference in 255ths of LittleCMS's conversion by a profile from a `WideSpace`'s conversion.

With a larger one the profile describes another space. Two roundings to 8 bits account for 1, and the precision of
curves in profiles for the rest.
"""
MAX_PROFILE_BYTES = 1 << 20
"""Largest size in bytes of an ICC profile that is read. Display P3 and Adobe RGB take up to 4 KB, and `space_of` keeps
64 profiles in memory."""
CONVERTED_PIXELS = 1 << 20
"""Number of pixels that OpenImageIO converts at once. A conversion takes seven times the memory of its pixels."""
_BUILT_IN_CONFIG = "ocio://default"
"""OpenImageIO's name of the OpenColorIO configuration, which does not depend on the user's variable OCIO."""


@dataclass(frozen=True)
class WideSpace:
    """A colour space with a larger gamut than sRGB.

    linear: OpenColorIO's name of the linear space with the same primaries.
    to_linear: function from stored values to linear ones.
    """

    linear: str
    to_linear: Callable[[Float32], Float32]

    def to_srgb(self, rgb: Float32) -> Float32:
        """Convert colours (H, W, 3) from 0 to 1. Colours that sRGB does not have are clipped to 0 and 1."""
        srgb, rows = np.empty(rgb.shape, np.float32), max(1, CONVERTED_PIXELS // rgb.shape[1])
        for first in range(0, len(rgb), rows):
            srgb[first : first + rows] = self._rows_to_srgb(rgb[first : first + rows])
        return srgb

    def _rows_to_srgb(self, rgb: Float32) -> Float32:
        source = oiio.ImageBuf(np.ascontiguousarray(self.to_linear(rgb), np.float32))
        made = oiio.ImageBufAlgo.colorconvert(
            source, self.linear, "Linear Rec.709 (sRGB)", colorconfig=_BUILT_IN_CONFIG
        )
        assert not made.has_error, made.geterror()
        linear = np.asarray(made.get_pixels(oiio.FLOAT), np.float32).reshape(rgb.shape)
        return linear_to_srgb(np.clip(linear, 0, 1))


def _adobe_to_linear(values: Float32) -> Float32:
    return np.asarray(values ** np.float32(ADOBE_RGB_GAMMA), np.float32)


DISPLAY_P3 = WideSpace("Linear P3-D65", srgb_to_linear)
"""Display P3, the space of Apple's phones: the primaries of SMPTE EG 432-1 with the white D65, and the sRGB curve."""
ADOBE_RGB = WideSpace("Linear AdobeRGB", _adobe_to_linear)
"""Adobe RGB (1998)."""


class SrgbPhoto:
    """A photograph in a `WideSpace` whose pixels are read as sRGB, with the methods of OpenImageIO's ImageInput."""

    def __init__(self, source: Any, space: WideSpace, profile: bytes) -> None:
        """Wrap an open photograph of unsigned integers with 3 or 4 channels.

        space: the space of its colours. profile: its ICC profile.
        """
        self._source, self._space, self._profile = source, space, profile
        self._spec = oiio.ImageSpec(source.spec())
        for attribute in list(self._spec.extra_attribs):
            if attribute.name.startswith(ICC_PROFILE_ATTRIBUTE):
                self._spec.erase_attribute(attribute.name)

    def spec(self) -> Any:
        """Return OpenImageIO's specification, without the ICC profile."""
        return self._spec

    def format_name(self) -> str:
        """Return the name of the file's format."""
        return str(self._source.format_name())

    def read_image(self, form: Any) -> NDArray[Any] | None:
        """Decode the pixels (H, W, C); None after an error. form: OpenImageIO's type of the result's values."""
        stored, name = self._spec.format, str(oiio.TypeDesc(form))
        pixels = self._source.read_image(stored)
        if pixels is None:
            return None
        premultiplied = pixels.shape[2] == 4 and not self._spec.get_int_attribute("oiio:UnassociatedAlpha", 0)
        scale = np.float32(1 / np.iinfo(pixels.dtype).max)
        if str(stored) == "uint8" and not premultiplied:
            rgb = _converted_by_littlecms(pixels[:, :, :3], self._profile)
            pixels = np.concatenate([rgb, pixels[:, :, 3:]], axis=2)
            if name == "uint8":
                return pixels
            values = np.asarray(pixels * scale, np.float32)
        else:
            values = np.asarray(pixels * scale, np.float32)
            values = unassociate(values) if premultiplied else values
            values = np.concatenate([self._space.to_srgb(values[:, :, :3]), values[:, :, 3:]], axis=2)
            values = associate(values) if premultiplied else values
        if not name.startswith("uint"):
            return values
        return np.asarray(np.rint(values * np.float32(np.iinfo(name).max)), name)

    def geterror(self) -> str:
        """Return the message of the decoder's last error, and forget it; "" if there was none."""
        return str(self._source.geterror())

    def close(self) -> None:
        """Close the file."""
        self._source.close()


def in_srgb(source: Any) -> Any:
    """Return an open image whose pixels are in sRGB: an `SrgbPhoto` if its ICC profile is that of a `WideSpace`.

    Other images are returned unchanged: without a profile, with a profile of another space or of more than
    MAX_PROFILE_BYTES, grey, or of floats.
    """
    spec = source.spec()
    profile = spec.getattribute(ICC_PROFILE_ATTRIBUTE)
    if profile is None or spec.nchannels not in (3, 4) or not str(spec.format).startswith("uint"):
        return source
    content = np.asarray(profile, np.uint8).tobytes()
    space = space_of(content) if len(content) <= MAX_PROFILE_BYTES else None
    return source if space is None else SrgbPhoto(source, space, content)


@lru_cache(maxsize=64)
def space_of(profile: bytes) -> WideSpace | None:
    """Return the space that an ICC profile describes; None for sRGB, for any other space and for a damaged profile."""
    from PIL import ImageCms

    levels = np.array([(r, g, b) for r in (40, 90, 160, 230) for g in (60, 128, 200) for b in (50, 120, 210)], np.uint8)
    samples = levels[None]
    try:
        converted = _converted_by_littlecms(samples, profile)
    except (ImageCms.PyCMSError, OSError, ValueError):
        return None
    values = np.asarray(samples, np.float32) / np.float32(255)
    for space in (DISPLAY_P3, ADOBE_RGB):
        if np.abs(255 * space.to_srgb(values) - np.asarray(converted, np.float32)).max() <= MAX_SAME_SPACE_LEVELS:
            return space
    return None


def _converted_by_littlecms(rgb: NDArray[np.uint8], profile: bytes) -> NDArray[np.uint8]:
    """Convert colours (H, W, 3) to sRGB. profile: their ICC profile. Raises Pillow's errors for a damaged profile."""
    from PIL import Image, ImageCms

    converted = ImageCms.profileToProfile(
        Image.fromarray(np.ascontiguousarray(rgb)),
        ImageCms.ImageCmsProfile(io.BytesIO(profile)),
        ImageCms.createProfile("sRGB"),
        renderingIntent=ImageCms.Intent.RELATIVE_COLORIMETRIC,
    )
    return np.asarray(converted, np.uint8)
