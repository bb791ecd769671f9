# SPDX-License-Identifier: Apache-2.0
"""Colour spaces: the one that a model was trained in, light in linear values, and the one that a picture is written in.

Gaussians are blended in the space of the photographs, as they were trained. Everything that adds up light (filters,
shutter, lens) works on linear values. The way out goes through OpenColorIO's configuration, the one built into
OpenImageIO. sRGB's curve is done here: OpenColorIO's own is a quick approximation, off by up to 3e-4.
"""

from __future__ import annotations

import os
from collections.abc import Collection, Iterable
from difflib import get_close_matches
from functools import cached_property, lru_cache
from pathlib import Path
from typing import Any

import numpy as np
import OpenImageIO as oiio
from numpy.typing import NDArray

from clsplat.arrays import Float32
from clsplat.config.pictures import ColourConfig
from clsplat.errors import InputError, examples

SRGB = "sRGB"
"""sRGB's curve over Rec.709's primaries: what 8-bit photographs are in, and models that say nothing else."""
LINEAR = "lin_rec709"
"""The same primaries without a curve."""
BUILT_IN = "ocio://studio-config-latest"

_COMMENT = "clsplat colorspace "
_NAMES = {
    SRGB: ("srgb_texture", "sRGB - Texture", "srgb_tx", "sRGB", "Utility - sRGB - Texture"),
    LINEAR: ("lin_rec709", "Linear Rec.709 (sRGB)", "lin_srgb", "Utility - Linear - sRGB", "lin_rec709_scene"),
}
"""Names of these two in configurations."""
INTEROP = {
    SRGB: "srgb_rec709_scene",
    LINEAR: "lin_rec709_scene",
    "ACEScg": "lin_ap1_scene",
    "ACES2065-1": "lin_ap0_scene",
}
"""Names of spaces in EXR's attribute colorInteropID (Color Interop Forum, "Color Space Encodings for Texture Assets",
https://github.com/AcademySoftwareFoundation/ColorInterop)."""
_REC709 = (0.64, 0.33, 0.30, 0.60, 0.15, 0.06)
_ACES_WHITE, _D65 = (0.32168, 0.33767), (0.3127, 0.3290)
CHROMATICITIES: dict[str, tuple[float, ...]] = {
    LINEAR: (*_REC709, *_D65),
    "ACEScg": (0.713, 0.293, 0.165, 0.830, 0.128, 0.044, *_ACES_WHITE),
    "ACES2065-1": (0.73470, 0.26530, 0.0, 1.0, 0.00010, -0.0770, *_ACES_WHITE),
    "Linear P3-D65": (0.680, 0.320, 0.265, 0.690, 0.150, 0.060, *_D65),
    "Linear Rec.2020": (0.708, 0.292, 0.170, 0.797, 0.131, 0.046, *_D65),
    "Linear AdobeRGB": (0.64, 0.33, 0.21, 0.71, 0.15, 0.06, *_D65),
}
"""x and y of red, green, blue and white, of linear spaces, for EXR files: AP1 and AP0 by SMPTE ST 2065-1 and
the Academy's S-2014-004, the others by their own standards."""
MAX_LINE = 1 << 20
"""Bytes of a line of a PLY's header."""
_LINEAR_PHOTOS = (".exr", ".hdr")


def comment(space: str) -> str:
    """The line of a model file's header that records the space it was trained in."""
    return _COMMENT + space


def recorded_space(path: str | os.PathLike[str]) -> str:
    """The space that a model file's header records, sRGB where it records none."""
    with open(path, "rb") as file:
        if file.readline(16).strip() != b"ply":
            return SRGB
        for line in iter(lambda: file.readline(MAX_LINE + 1), b""):  # not `in file`: what is behind a header has none
            words = line.decode("ascii", "replace").strip()
            if words == "end_header" or len(line) > MAX_LINE:
                break
            kind, _, rest = words.partition(" ")
            if kind in ("comment", "obj_info") and rest.startswith(_COMMENT):
                return rest[len(_COMMENT) :].strip() or SRGB
    return SRGB


def photos_space(paths: Iterable[str | os.PathLike[str]]) -> str:
    """The space of a model that is trained from these pictures: linear if every one is a float EXR or HDR."""
    endings = {Path(path).suffix.lower() for path in paths}
    return LINEAR if endings and endings <= set(_LINEAR_PHOTOS) else SRGB


def srgb_to_linear(values: Float32) -> Float32:
    """sRGB's curve (IEC 61966-2-1), which goes on as it is above 1, and below 0 as the line that it begins with."""
    curve = ((np.maximum(values, np.float32(0.04045)) + np.float32(0.055)) / np.float32(1.055)) ** np.float32(2.4)
    return np.where(values > np.float32(0.04045), curve, values / np.float32(12.92)).astype(np.float32, copy=False)


def linear_to_srgb(values: Float32) -> Float32:
    """The way back from `srgb_to_linear`."""
    edge = np.float32(0.04045 / 12.92)
    curve = np.float32(1.055) * np.maximum(values, edge) ** np.float32(1 / 2.4) - np.float32(0.055)
    return np.where(values > edge, curve, values * np.float32(12.92)).astype(np.float32, copy=False)


def displayed(rgb: NDArray[Any], space: str) -> Float32:
    """(H, W, 3) of a model's space as PNG and JPEG files show it: in sRGB, within [0, 1]. Raises InputError for a space
    that is not known."""
    colours = _to_srgb(space, os.environ.get("OCIO", ""))
    return np.clip(colours.convert(np.asarray(rgb, np.float32), None, colours.model, SRGB), 0, 1)


@lru_cache(maxsize=8)
def _to_srgb(space: str, source: str) -> Colours:
    """The spaces of pictures on a display, loaded once: a viewer shows many."""
    return Colours(ColourConfig(colorspace=SRGB, ocio_config=source), space)


class Colours:
    """The spaces of one job. model, light, output: SRGB, LINEAR or names of the configuration; light is linear."""

    def __init__(self, config: ColourConfig | None = None, recorded: str = SRGB) -> None:
        """recorded: `recorded_space` of the model. Raises InputError for a configuration that does not load, and for a
        space that it lacks, with the names that are near."""
        config = config or ColourConfig()
        self._source = config.ocio_config or os.environ.get("OCIO", "") or BUILT_IN
        self._matrices: dict[tuple[str, str], Float32 | None] = {}
        flag = "--model-colorspace" if config.model_colorspace else "the model's colour space"
        self.model = self._known(config.model_colorspace or recorded, flag)
        self.output = self._known(config.colorspace, "--colorspace") if config.colorspace else self.model
        is_linear = self.model not in _NAMES and self._config.isColorSpaceLinear(self.model)
        self.light = self.model if is_linear else LINEAR
        spaces = {self.model, self.light, self.output}
        if LINEAR in spaces and spaces - _NAMES.keys():
            self._ocio_name(LINEAR)

    def is_linear(self, space: str) -> bool:
        """True if one of the job's spaces has no curve."""
        return space == LINEAR or (space != SRGB and bool(self._config.isColorSpaceLinear(space)))

    def has_rec709(self, space: str) -> bool:
        """True if one of the job's spaces has Rec.709's primaries and white, whatever its curve is."""
        if space in _NAMES:
            return True
        light = np.array([[[1, 0, 0], [0, 1, 0], [0, 0, 1], [1, 1, 1]]], np.float32)
        colours = self.convert(light, None, LINEAR, space)[0]
        one, rest = colours[:3][np.eye(3, dtype=bool)], colours[:3][~np.eye(3, dtype=bool)]
        return bool(np.allclose(rest, 0, atol=2e-3) and np.allclose([*one, *colours[3]], colours[3, 0], atol=2e-3))

    def check_file(self, path: str, extension: str, videos: Collection[str]) -> None:
        """Raise InputError where a file of that extension would be shown in other colours than it holds. Whole numbers
        are not for linear light, and a video, whose extension is one of `videos`, has to be in Rec.709."""
        advice = "write .exr, or give --colorspace sRGB"
        if extension != ".exr" and self.is_linear(self.output):
            raise InputError(f"{path}: its colours would be {self.output}, which is linear, expected sRGB; {advice}")
        if extension in videos and not self.has_rec709(self.output):
            raise InputError(f"{path}: its colours would be {self.output}, expected sRGB's primaries; {advice}")

    @cached_property
    def _config(self) -> Any:
        config = oiio.ColorConfig(self._source)
        if reason := config.geterror():
            raise InputError(f"{self._source}: no OpenColorIO configuration: {' '.join(reason.split())}")
        return config

    def _known(self, name: str, flag: str) -> str:
        for space, names in _NAMES.items():
            if name.lower() in {alias.lower() for alias in names}:
                return space
        resolved = self._config.resolve(name)
        if self._config.getColorSpaceIndex(resolved) < 0:
            spaces = {listed.lower(): listed for listed in self._config.getColorSpaceNames()}
            for listed in list(spaces.values()):
                spaces.update({alias.lower(): listed for alias in self._config.getAliases(listed)})
            near = dict.fromkeys(spaces[word] for word in get_close_matches(name.lower(), spaces, 5, 0.4))
            advice = (
                f"near it are {', '.join(near)}" if near else f"it has {examples(self._config.getColorSpaceNames())}"
            )
            raise InputError(f"{flag} {name}: not in the configuration {self._source}; {advice}")
        for space, names in _NAMES.items():
            if any(self._config.resolve(alias) == resolved for alias in names):
                return space
        return str(resolved)

    def _ocio_name(self, space: str) -> str:
        """The space's name in the configuration. Raises InputError where it has no linear Rec.709."""
        for name in _NAMES.get(space, (space,)):
            if self._config.getColorSpaceIndex(self._config.resolve(name)) >= 0:
                return str(self._config.resolve(name))
        raise InputError(f"{self._source}: has none of {', '.join(_NAMES[space])}, expected one to convert through")

    def convert(self, rgb: Float32, alpha: Float32 | None, source: str, target: str) -> Float32:
        """rgb (H, W, 3) from one of the job's spaces to another; alpha (H, W): rgb is associated with it, else opaque.

        Curves work on colours, so that these are divided by alpha before and multiplied after; where alpha is 0 the
        result is 0. Nothing is clipped.
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
        red, green, blue = (rgb[:, :, index, None] for index in range(3))  # no sum of a library's, whose order varies
        return np.asarray(red * matrix[0] + green * matrix[1] + blue * matrix[2], np.float32)

    def _matrix(self, source: str, target: str) -> Float32 | None:
        """(3, 3), a row for each channel of the source; None where one does not do. Each conversion by OpenImageIO
        loads the configuration anew, which takes longer than a frame."""
        light = np.array([[[1, 0, 0], [0, 1, 0], [0, 0, 1], [0, 0, 0], [4, -1, 2], [0.2, 0.01, 0.5]]], np.float32)
        colours = self._converted(light, source, target)
        matrix, sums = colours[0, :3], colours[0, 3:]
        return matrix if np.allclose(light[0, 3:] @ matrix, sums, rtol=1e-5, atol=1e-5) else None  # sums up to 4

    def _converted(self, rgb: Float32, source: str, target: str) -> Float32:
        pixels = oiio.ImageBuf(np.ascontiguousarray(rgb, np.float32))
        result = oiio.ImageBufAlgo.colorconvert(pixels, source, target, unpremult=False, colorconfig=self._source)
        if reason := result.geterror():
            raise InputError(f"{self._source}: {source} to {target}: {' '.join(reason.split())}")
        return np.asarray(result.get_pixels(oiio.FLOAT), np.float32)
