# SPDX-License-Identifier: Apache-2.0
"""Colour spaces (sRGB, linear, OpenColorIO's): conversion between the model's space, linear light, and the space of
output files.

Gaussians are blended in the colour space of their training photographs. Operations that add light (filters, shutter,
lens) work on linear values. OpenColorIO converts the output, by default with the configuration built into OpenImageIO.
This module computes the sRGB curve (gamma) itself, because OpenColorIO's fast approximation is off by up to 3e-4.
"""

from __future__ import annotations

import os
import re
from collections.abc import Iterable
from difflib import get_close_matches
from functools import cached_property, lru_cache
from glob import escape, glob
from pathlib import Path
from typing import Any

import numpy as np
import OpenImageIO as oiio
from numpy.typing import NDArray

from clsplat.arrays import Float32
from clsplat.config.pictures import VIDEO_SUFFIXES, ColourConfig
from clsplat.errors import InputError, examples, warn
from clsplat.files.documents import is_file, known_digest

SRGB = "sRGB"
"""sRGB curve over Rec.709 primaries: the space of 8-bit photographs, and the default of models."""
LINEAR = "lin_rec709"
"""Linear values with Rec.709 primaries."""
BUILT_IN_OCIO_CONFIG = "ocio://studio-config-latest"
"""OpenImageIO's name of its built-in OpenColorIO configuration."""

_SPACE_COMMENT_PREFIX = "clsplat colorspace "
_SPACE_ALIASES = {
    SRGB: ("srgb_texture", "sRGB - Texture", "srgb_tx", "sRGB", "Utility - sRGB - Texture"),
    LINEAR: ("lin_rec709", "Linear Rec.709 (sRGB)", "lin_srgb", "Utility - Linear - sRGB", "lin_rec709_scene"),
}
"""Names of sRGB and linear Rec.709 in OpenColorIO configurations."""
COLOR_INTEROP_IDS = {
    SRGB: "srgb_rec709_scene",
    LINEAR: "lin_rec709_scene",
    "ACEScg": "lin_ap1_scene",
    "ACES2065-1": "lin_ap0_scene",
}
"""Names in EXR's attribute colorInteropID (Color Interop Forum, "Color Space Encodings for Texture Assets",
https://github.com/AcademySoftwareFoundation/ColorInterop)."""
_REC709_PRIMARIES = (0.64, 0.33, 0.30, 0.60, 0.15, 0.06)
REC709_LUMA_WEIGHTS = (0.2126, 0.7152, 0.0722)
"""Rec.709 luma weights, which the saturation of ASC CDL uses too."""
_ACES_WHITE, _D65 = (0.32168, 0.33767), (0.3127, 0.3290)
CHROMATICITIES: dict[str, tuple[float, ...]] = {
    LINEAR: (*_REC709_PRIMARIES, *_D65),
    "ACEScg": (0.713, 0.293, 0.165, 0.830, 0.128, 0.044, *_ACES_WHITE),
    "ACES2065-1": (0.73470, 0.26530, 0.0, 1.0, 0.00010, -0.0770, *_ACES_WHITE),
    "Linear P3-D65": (0.680, 0.320, 0.265, 0.690, 0.150, 0.060, *_D65),
    "Linear Rec.2020": (0.708, 0.292, 0.170, 0.797, 0.131, 0.046, *_D65),
    "Linear AdobeRGB": (0.64, 0.33, 0.21, 0.71, 0.15, 0.06, *_D65),
}
"""Chromaticities x and y of red, green, blue and white of linear spaces, for EXR files.

ACEScg and ACES2065-1 follow the Academy's S-2014-004 and SMPTE ST 2065-1, the others their own standards.
"""
MAX_PLY_LINE_BYTES = 1 << 20
"""Longest header line of a PLY in bytes. A longer line ends the search for the colour space."""
_LINEAR_PHOTO_SUFFIXES = (".exr", ".hdr")


def comment(space: str) -> str:
    """Return the comment for a model file's header that records the model's colour space."""
    return _SPACE_COMMENT_PREFIX + space


def recorded_space(path: str | os.PathLike[str]) -> str:
    """Return the colour space that a model file's header records; sRGB if it records none."""
    with open(path, "rb") as file:
        if file.readline(16).strip() != b"ply":
            return SRGB
        # `for line in file` could read all binary data as one line.
        for line in iter(lambda: file.readline(MAX_PLY_LINE_BYTES + 1), b""):
            words = line.decode("ascii", "replace").strip()
            if words == "end_header" or len(line) > MAX_PLY_LINE_BYTES:
                break
            kind, _, rest = words.partition(" ")
            if kind in ("comment", "obj_info") and rest.startswith(_SPACE_COMMENT_PREFIX):
                return rest[len(_SPACE_COMMENT_PREFIX) :].strip() or SRGB
    return SRGB


def photos_space(paths: Iterable[str | os.PathLike[str]]) -> str:
    """Return the colour space of a model trained on these photographs: linear if all are EXR or HDR, otherwise sRGB."""
    endings = {Path(path).suffix.lower() for path in paths}
    return LINEAR if endings and endings <= set(_LINEAR_PHOTO_SUFFIXES) else SRGB


def srgb_to_linear(values: Float32) -> Float32:
    """Decode the sRGB curve (IEC 61966-2-1). The curve also applies above 1, and its linear segment below 0."""
    curve = ((np.maximum(values, np.float32(0.04045)) + np.float32(0.055)) / np.float32(1.055)) ** np.float32(2.4)
    return np.where(values > np.float32(0.04045), curve, values / np.float32(12.92)).astype(np.float32, copy=False)


def linear_to_srgb(values: Float32) -> Float32:
    """Encode linear values by the sRGB curve (gamma), the inverse of `srgb_to_linear`."""
    edge = np.float32(0.04045 / 12.92)
    curve = np.float32(1.055) * np.maximum(values, edge) ** np.float32(1 / 2.4) - np.float32(0.055)
    return np.where(values > edge, curve, values * np.float32(12.92)).astype(np.float32, copy=False)


def displayed(rgb: NDArray[Any], space: str) -> Float32:
    """Convert an image (H, W, 3) from a model's colour space to sRGB in [0, 1], for display or PNG and JPEG files.

    Raises InputError for an unknown space.
    """
    colours = _to_srgb(space, os.environ.get("OCIO", ""))
    return np.clip(colours.convert(np.asarray(rgb, np.float32), None, colours.model, SRGB), 0, 1)


@lru_cache(maxsize=8)
def _to_srgb(space: str, source: str) -> Colours:
    """Return `Colours` that convert from a model's space to sRGB. They are cached, as a viewer shows many images.

    space: the model's colour space.
    source: OpenColorIO configuration; "" for the built-in one.
    """
    return Colours(ColourConfig(colorspace=SRGB, ocio_config=source), space)


class Colours:
    """The three colour spaces of a rendering job, and conversions between them.

    model: the space in which the model's Gaussians are blended.
    light: the linear space for operations that add light.
    output: the space of the files.
    Each is SRGB, LINEAR or a name of the OpenColorIO configuration.
    """

    def __init__(self, config: ColourConfig | None = None, recorded: str = SRGB) -> None:
        """Load the OpenColorIO configuration and look up the spaces.

        recorded: the model's colour space, from `recorded_space`. `config.model_colorspace` overrides it.
        Raises InputError if the configuration does not load or lacks a space. The message lists similar names.
        """
        config = config or ColourConfig()
        self._source = config.ocio_config or os.environ.get("OCIO", "") or BUILT_IN_OCIO_CONFIG
        self._matrices: dict[tuple[str, str], Float32 | None] = {}
        flag = "--model-colorspace" if config.model_colorspace else "the model's colour space"
        self.model = self._known(config.model_colorspace or recorded, flag)
        self.output = self._known(config.colorspace, "--colorspace") if config.colorspace else self.model
        is_linear = self.model not in _SPACE_ALIASES and self._config.isColorSpaceLinear(self.model)
        self.light = self.model if is_linear else LINEAR
        spaces = {self.model, self.light, self.output}
        if LINEAR in spaces and spaces - _SPACE_ALIASES.keys():
            self._ocio_name(LINEAR)

    def is_linear(self, space: str) -> bool:
        """Return True if `space`, a colour space of the job, is linear."""
        return space == LINEAR or (space != SRGB and bool(self._config.isColorSpaceLinear(space)))

    def has_rec709(self, space: str) -> bool:
        """Return True if `space`, a colour space of the job, has Rec.709's primaries and white point."""
        if space in _SPACE_ALIASES:
            return True
        light = np.array([[[1, 0, 0], [0, 1, 0], [0, 0, 1], [1, 1, 1]]], np.float32)
        colours = self.convert(light, None, LINEAR, space)[0]
        one, rest = colours[:3][np.eye(3, dtype=bool)], colours[:3][~np.eye(3, dtype=bool)]
        return bool(np.allclose(rest, 0, atol=2e-3) and np.allclose([*one, *colours[3]], colours[3, 0], atol=2e-3))

    def check_file(self, path: str) -> None:
        """Check that a file of this name can store colours of the output space.

        Raises InputError for linear colours in a format other than EXR, and for a video without Rec.709's primaries.
        Warns if an EXR file would lack chromaticities.
        """
        extension = Path(path).suffix.lower()
        advice = "write .exr, or give --colorspace sRGB"
        if extension != ".exr" and self.is_linear(self.output):
            raise InputError(f"{path}: its colours would be {self.output}, which is linear, expected sRGB; {advice}")
        if extension in VIDEO_SUFFIXES and not self.has_rec709(self.output):
            raise InputError(f"{path}: its colours would be {self.output}, expected sRGB's primaries; {advice}")
        if extension == ".exr" and self.is_linear(self.output) and self.output not in CHROMATICITIES:
            warn(f"{path}: clsplat does not know the chromaticities of {self.output}, so the files do not have them")

    @cached_property
    def _config(self) -> Any:
        config = oiio.ColorConfig(self._source)
        if reason := config.geterror():
            raise InputError(f"{self._source}: is not an OpenColorIO configuration: {' '.join(reason.split())}")
        return config

    def _known(self, name: str, flag: str) -> str:
        for space, names in _SPACE_ALIASES.items():
            if name.lower() in {alias.lower() for alias in names}:
                return space
        resolved = self._config.resolve(name)
        if self._config.getColorSpaceIndex(resolved) < 0:
            spaces = {listed.lower(): listed for listed in self._config.getColorSpaceNames()}
            for listed in list(spaces.values()):
                spaces.update({alias.lower(): listed for alias in self._config.getAliases(listed)})
            near = dict.fromkeys(spaces[word] for word in get_close_matches(name.lower(), spaces, 5, 0.4))
            advice = (
                f"similar names: {', '.join(near)}" if near else f"it has {examples(self._config.getColorSpaceNames())}"
            )
            raise InputError(f"{flag} {name}: is not in the configuration {self._source}; {advice}")
        for space, names in _SPACE_ALIASES.items():
            if any(self._config.resolve(alias) == resolved for alias in names):
                return space
        return str(resolved)

    def _ocio_name(self, space: str) -> str:
        """Return the name of a space in the OpenColorIO configuration. Raises InputError if the space is missing."""
        for name in _SPACE_ALIASES.get(space, (space,)):
            if self._config.getColorSpaceIndex(self._config.resolve(name)) >= 0:
                return str(self._config.resolve(name))
        raise InputError(
            f"{self._source}: lacks a colour space for conversions, expected one of {', '.join(_SPACE_ALIASES[space])}"
        )

    def convert(self, rgb: Float32, alpha: Float32 | None, source: str, target: str) -> Float32:
        """Convert rgb (H, W, 3) from one of the job's spaces to another, without clipping.

        alpha: (H, W), by which rgb is premultiplied; None for opaque images. Conversion needs straight colours, so rgb
          is divided by alpha before it and multiplied by alpha after it. Where alpha is 0 the result is 0.
        """
        if source == target:
            return rgb
        if alpha is not None:
            rgb = rgb / np.where(alpha > 0, alpha, np.float32(1)).astype(np.float32, copy=False)[:, :, None]
        if source == SRGB:
            rgb, source = srgb_to_linear(rgb), LINEAR
        through = LINEAR if target == SRGB else target
        if source != through:
            rgb = self._by_ocio(rgb, source, through)
        if target == SRGB:
            rgb = linear_to_srgb(rgb)
        return rgb if alpha is None else np.asarray(rgb * alpha[:, :, None], np.float32)

    def _by_ocio(self, rgb: Float32, source: str, target: str) -> Float32:
        names = self._ocio_name(source), self._ocio_name(target)
        if names not in self._matrices:
            linear = all(self._config.isColorSpaceLinear(name) for name in names)
            self._matrices[names] = self._matrix(*names) if linear else None
        if (matrix := self._matrices[names]) is None:
            return self._converted(rgb, names[0], names[1])
        # not a matrix product, as BLAS would vary the order of the sum
        red, green, blue = (rgb[:, :, index, None] for index in range(3))
        return np.asarray(red * matrix[0] + green * matrix[1] + blue * matrix[2], np.float32)

    def _matrix(self, source: str, target: str) -> Float32 | None:
        """Return the matrix (3, 3) of a conversion, a row per source channel; None if the conversion is not linear.

        With a matrix, frames are converted without OpenImageIO. It would load the configuration in every call, which
        takes longer than rendering a frame.
        """
        light = np.array([[[1, 0, 0], [0, 1, 0], [0, 0, 1], [0, 0, 0], [4, -1, 2], [0.2, 0.01, 0.5]]], np.float32)
        colours = self._converted(light, source, target)
        matrix, sums = colours[0, :3], colours[0, 3:]
        # the tolerance is small compared with the tested values of up to 4
        linear = np.allclose(light[0, 3:] @ matrix, sums, rtol=1e-5, atol=1e-5)
        return matrix if linear else None

    def _converted(self, rgb: Float32, source: str, target: str) -> Float32:
        pixels = oiio.ImageBuf(np.ascontiguousarray(rgb, np.float32))
        result = oiio.ImageBufAlgo.colorconvert(pixels, source, target, unpremult=False, colorconfig=self._source)
        if reason := result.geterror():
            raise InputError(f"{self._source}: cannot convert {source} to {target}: {' '.join(reason.split())}")
        return np.asarray(result.get_pixels(oiio.FLOAT), np.float32)


def configuration_digest(source: str) -> str:
    """Return the SHA-256 digests of an OpenColorIO file and of the tables that it names.

    Returns `source` itself if it is not a file.
    """
    if not source or not is_file(source):
        return source
    patterns = _table_patterns(source, Path(source).stat().st_mtime_ns)
    tables = sorted({path for pattern in patterns for path in glob(pattern) if is_file(path)})  # noqa: PTH207
    return " ".join(known_digest(Path(path)) for path in (source, *tables))


@lru_cache(maxsize=8)
def _table_patterns(source: str, changed: int) -> tuple[str, ...]:  # noqa: ARG001  # `changed` is part of the cache's key
    """Return glob patterns for the files that the FileTransforms in an OpenColorIO configuration may read.

    There is a pattern for each file name in each folder of the configuration's search_path, with "*" in place of
    environment variables.

    source: path of the configuration.
    changed: time of its last change.
    """
    text = Path(source).read_text("utf-8", "replace")
    listed = re.search(r"^search_path:([^\n]*(?:\n[ \t]*- [^\n]*)*)", text, re.MULTILINE)
    places = re.split(r"[\n\[\],:;]|\s-\s", listed[1]) if listed else []
    names = re.findall(r"\bsrc:[ \t]*(\"[^\"]*\"|'[^']*'|[^,}\n]+)", text)
    folders, files = (
        {re.sub(r"\$\{\w+\}|\$\w+|%\w+%", "*", escape(text.strip(" \t\"'"))) for text in texts}
        for texts in (places, names)
    )
    home = Path(escape(str(Path(source).parent)))
    return tuple(sorted({str(home / folder / file) for folder in folders | {""} for file in files}))
