# SPDX-License-Identifier: Apache-2.0
"""Pictures of many kinds, made by Pillow. They may have another kind's file name, like downloads and renamed files."""

from __future__ import annotations

import io
from collections.abc import Callable
from typing import Any

import numpy as np
from PIL import Image

HEIGHT, WIDTH = 19, 23


def colours() -> Image.Image:
    """A picture with a ramp in each of its three channels, 19 rows of 23 pixels."""
    rows, columns = np.mgrid[:HEIGHT, :WIDTH]
    return Image.fromarray(np.stack([columns * 11, rows * 13, 255 - columns * 5], axis=2).astype(np.uint8))


def _cut_out() -> Image.Image:
    picture = colours()
    picture.putalpha(Image.fromarray(np.where(np.mgrid[:HEIGHT, :WIDTH][1] > 11, 255, 0).astype(np.uint8)))
    return picture


def _more() -> dict[str, Any]:
    """Pillow's settings for a file with a second frame that shows another picture."""
    return {"save_all": True, "append_images": [colours().rotate(180)]}


KINDS: dict[str, tuple[str, Callable[[], Image.Image], Callable[[], dict[str, Any]]]] = {
    "gif": ("GIF", lambda: colours().quantize(64), dict),
    "gif-grey": ("GIF", lambda: colours().convert("L"), dict),
    "gif-animated": ("GIF", lambda: colours().quantize(64), _more),
    "gif-transparent": ("GIF", _cut_out, dict),
    "webp": ("WEBP", colours, lambda: {"lossless": True}),
    "webp-animated": ("WEBP", colours, lambda: {"lossless": True, **_more()}),
    "webp-alpha": ("WEBP", _cut_out, lambda: {"lossless": True, "exact": True}),
    "bmp": ("BMP", colours, dict),
    "bmp-palette": ("BMP", lambda: colours().quantize(64), dict),
    "tiff-palette": ("TIFF", lambda: colours().quantize(64), dict),
    "tiff-grey": ("TIFF", lambda: colours().convert("L"), dict),
    "tiff-bits": ("TIFF", lambda: colours().convert("L").convert("1"), dict),
    "tiff-16": ("TIFF", lambda: Image.fromarray((np.mgrid[:HEIGHT, :WIDTH][1] * 2000).astype(np.uint16)), dict),
    "tiff-alpha": ("TIFF", _cut_out, dict),
    "tiff-cmyk": ("TIFF", lambda: colours().convert("CMYK"), dict),
    "tiff-pages": ("TIFF", colours, _more),
    "jpeg": ("JPEG", colours, lambda: {"quality": 95}),
    "jpeg-grey": ("JPEG", lambda: colours().convert("L"), lambda: {"quality": 95}),
    "jpeg-cmyk": ("JPEG", lambda: colours().convert("CMYK"), lambda: {"quality": 95}),
    "jpeg-2000": ("JPEG2000", colours, dict),
    "png": ("PNG", colours, dict),
    "png-palette": ("PNG", lambda: colours().quantize(64), dict),
    "png-bits": ("PNG", lambda: colours().convert("L").convert("1"), dict),
    "png-grey-alpha": ("PNG", lambda: _cut_out().convert("LA"), dict),
    "png-animated": ("PNG", colours, _more),
    "ico": ("ICO", colours, lambda: {"sizes": [(16, 13)]}),
    "tga": ("TGA", colours, dict),
    "ppm": ("PPM", colours, dict),
    "sgi": ("SGI", colours, dict),
    "dds": ("DDS", colours, dict),
    "pcx": ("PCX", colours, dict),
}
"""By name of a kind: Pillow's format, a function that makes the picture, and one that makes its file's settings."""


def other_picture(kind: str) -> bytes:
    """The bytes of a file of one of KINDS."""
    form, picture, settings = KINDS[kind]
    file = io.BytesIO()
    picture().save(file, form, **settings())
    return file.getvalue()
