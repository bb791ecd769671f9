# SPDX-License-Identifier: Apache-2.0
"""Photographs that libraries other than OpenImageIO decode, with the methods of OpenImageIO's ImageInput.

The modules `heif`, `avif` and `raw` open them with one library each. `photo_decoders` selects the module.
"""

from __future__ import annotations

import io
import math
from collections.abc import Callable
from pathlib import Path
from typing import Any

import numpy as np
import OpenImageIO as oiio
from numpy.typing import NDArray

from clsplat.errors import InputError

PHOTOS_EXTRA = "pip install 'clsplat[photos]'"
"""Command that installs the libraries for HEIC, AVIF and raw files."""
ICC_PROFILE_ATTRIBUTE = "ICCProfile"
"""OpenImageIO's attribute of a picture with the bytes of its ICC profile."""
EXIF_ORIENTATION_ATTRIBUTE = "clsplat:ExifOrientation"
"""Attribute of a photograph with the orientation in its EXIF data, which the decoder ignores. Apple's accelerometer has
the axes of the sensor, so that its reader needs the orientation."""
_EXIF_IFD, _GPS_IFD = 0x8769, 0x8825
_EXIF_TEXTS = {(0, 0x10F): "Make", (0, 0x110): "Model", (_EXIF_IFD, 0xA433): "Exif:LensMake",
               (_EXIF_IFD, 0xA434): "Exif:LensModel", (_GPS_IFD, 1): "GPS:LatitudeRef",
               (_GPS_IFD, 3): "GPS:LongitudeRef", (_GPS_IFD, 9): "GPS:Status"}  # fmt: skip
"""OpenImageIO's names of EXIF tags whose values are texts, by directory (0: the first one) and number of the tag."""
_EXIF_INTEGERS = {(0, 0x112): EXIF_ORIENTATION_ATTRIBUTE, (_EXIF_IFD, 0x8827): "Exif:PhotographicSensitivity",
                  (_EXIF_IFD, 0xA405): "Exif:FocalLengthIn35mmFilm",
                  (_EXIF_IFD, 0xA210): "Exif:FocalPlaneResolutionUnit", (_EXIF_IFD, 0xA002): "Exif:PixelXDimension",
                  (_EXIF_IFD, 0xA003): "Exif:PixelYDimension", (_GPS_IFD, 5): "GPS:AltitudeRef"}  # fmt: skip
"""OpenImageIO's names of EXIF tags whose values are whole numbers, by directory and number."""
_EXIF_FLOATS = {(_EXIF_IFD, 0x829A): "ExposureTime", (_EXIF_IFD, 0x829D): "FNumber",
                (_EXIF_IFD, 0x920A): "Exif:FocalLength", (_EXIF_IFD, 0xA20E): "Exif:FocalPlaneXResolution",
                (_EXIF_IFD, 0xA20F): "Exif:FocalPlaneYResolution", (_GPS_IFD, 6): "GPS:Altitude"}  # fmt: skip
"""OpenImageIO's names of EXIF tags whose values are fractions, by directory and number."""
_GPS_ANGLES = {(_GPS_IFD, 2): "GPS:Latitude", (_GPS_IFD, 4): "GPS:Longitude"}
"""OpenImageIO's names of EXIF tags whose values are degrees, minutes and seconds, by directory and number."""


class DecodedPhoto:
    """A photograph with those methods of OpenImageIO's ImageInput that clsplat's readers of images call.

    `read_image` decodes the pixels. If it fails, `geterror` returns the message, as in OpenImageIO.
    """

    def __init__(self, kind: str, spec: Any, decode: Callable[[], tuple[NDArray[Any], float]]) -> None:
        """Store the header, and the function that decodes the pixels.

        kind: name of the format, such as "heif".
        spec: OpenImageIO's specification, with the size of the decoded pixels and the attributes from EXIF.
        decode: returns pixels (H, W, C) of unsigned integers, and the integer that stands for the value 1.0.
        """
        self._kind, self._spec, self._decode = kind, spec, decode
        self._error = ""

    def spec(self) -> Any:
        """Return OpenImageIO's specification."""
        return self._spec

    def format_name(self) -> str:
        """Return the name of the format."""
        return self._kind

    def read_image(self, form: Any) -> NDArray[Any] | None:
        """Decode the pixels (H, W, C); None after an error. form: OpenImageIO's type of the result's values."""
        try:
            pixels, highest = self._decode()
            pixels = np.ascontiguousarray(pixels)
        except Exception as error:  # noqa: BLE001  # decoders of damaged files raise what they like
            self._error = decoder_message(error)
            return None
        spec, name = self._spec, str(oiio.TypeDesc(form))
        if pixels.shape != (spec.height, spec.width, spec.nchannels):
            expected = (spec.height, spec.width, spec.nchannels)
            self._error = f"decodes to values of shape {pixels.shape}, expected {expected} as in its header"
            return None
        if name == str(pixels.dtype) and highest == np.iinfo(pixels.dtype).max:
            return pixels
        values = pixels * np.float32(1 / highest)
        if not name.startswith("uint"):
            return values
        return np.asarray(np.rint(values * np.float32(np.iinfo(name).max)), name)

    def geterror(self) -> str:
        """Return the message of the last error, and forget it; "" if there was none."""
        error, self._error = self._error, ""
        return error

    def close(self) -> None:
        """Do nothing: the decoders close their files when they have decoded."""


def photo_spec(
    width: int, height: int, channels: str, form: Any, exif: bytes | None = None, profile: bytes | None = None
) -> Any:
    """Return OpenImageIO's specification of a photograph that is upright and has straight alpha.

    channels: a letter for each channel, such as "RGBA" or "YA".
    form: OpenImageIO's type of the stored values.
    exif: EXIF data, whose values become attributes. Its orientation becomes EXIF_ORIENTATION_ATTRIBUTE.
    profile: ICC profile of the colours, for the attribute ICC_PROFILE_ATTRIBUTE.
    """
    spec = oiio.ImageSpec(width, height, len(channels), form)
    spec.channelnames = tuple(channels)
    spec.alpha_channel = channels.find("A")
    if "A" in channels:
        spec.attribute("oiio:UnassociatedAlpha", 1)
    if exif:
        _set_exif(spec, exif)
    if profile:
        spec.attribute(ICC_PROFILE_ATTRIBUTE, f"uint8[{len(profile)}]", np.frombuffer(profile, np.uint8))
    return spec


def _set_exif(spec: Any, exif: bytes) -> None:
    """Set attributes of a photograph from EXIF data, with or without "Exif" in front. Damaged values are left out."""
    from PIL import Image

    try:
        record = Image.Exif()
        record.load(exif)
        tables = {0: dict(record), **{place: dict(record.get_ifd(place)) for place in (_EXIF_IFD, _GPS_IFD)}}
    except Exception:  # noqa: BLE001  # Pillow raises struct's, Python's and its own errors for damaged EXIF data
        return
    for (place, tag), name in _EXIF_TEXTS.items():
        text = tables[place].get(tag)
        if isinstance(text, str) and (text := text.rstrip("\0 ")):
            spec.attribute(name, text)
    for (place, tag), name in _EXIF_INTEGERS.items():
        if (value := _number(tables[place].get(tag))) is not None and value < 2**31:
            spec.attribute(name, int(value))
    for (place, tag), name in _EXIF_FLOATS.items():
        if (value := _number(tables[place].get(tag))) is not None:
            spec.attribute(name, value)
    for (place, tag), name in _GPS_ANGLES.items():
        parts = tables[place].get(tag)
        angle = [_number(part) for part in parts] if isinstance(parts, tuple) else []
        if len(angle) == 3 and None not in angle:
            spec.attribute(name, "float[3]", tuple(angle))


def _number(value: Any) -> float | None:
    """Return an EXIF value, or the first of several, as a float; None if it is negative, infinite or no number."""
    value = value[0] if isinstance(value, (tuple, bytes)) and len(value) else value
    try:
        number = float(value)
    except (TypeError, ValueError, ZeroDivisionError, OverflowError):
        return None
    return number if 0 <= number < math.inf else None


def decoder_message(error: Exception) -> str:
    """Return the text of a decoder's exception in one line. A text that is bytes is decoded from UTF-8."""
    told = error.args[-1] if error.args else ""
    text = told.decode("utf-8", "replace") if isinstance(told, bytes) else str(told)
    return " ".join(text.split()) or type(error).__name__


def undecodable(path: Path, kind: str, error: Exception) -> InputError:
    """Return the error for a file that begins like a photograph of `kind`, but whose header is damaged.

    kind: name for messages, with its article. error: the decoder's exception.
    """
    return InputError(
        f"{path}: does not decode as {kind}: {decoder_message(error)}; copy the picture again or leave it out"
    )


def without_extra(path: Path, kind: str, package: str) -> InputError:
    """Return the error for a photograph whose decoder is not installed.

    kind: name for messages, with its article. package: the missing package.
    """
    return InputError(f"{path}: {kind} needs {package}, which is not installed: {PHOTOS_EXTRA}")


def whole_file(path: Path) -> io.BytesIO:
    """Read a file for a decoder. So no file stays open, and the decoder need not handle the encoding of its name."""
    return io.BytesIO(path.read_bytes())
