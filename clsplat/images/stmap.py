# SPDX-License-Identifier: Apache-2.0
"""STMaps: pictures whose red and green say of each pixel where it comes from in another picture.

The numbers are parts of that picture's width and height, from its lower left corner, as in Nuke: the identity has
(x + 1/2) / width and 1 - (y + 1/2) / height in the pixel (x, y) from the top left.
"""

from __future__ import annotations

from dataclasses import dataclass
from functools import lru_cache
from pathlib import Path

import numpy as np
import OpenImageIO as oiio

from clsplat.arrays import Float32, Float64
from clsplat.errors import InputError, warn
from clsplat.files import digest
from clsplat.images.reading import error_of, one_line, open_image
from clsplat.images.writing import write_spec

HALF_PLACES = 2048
"""Pixels a side from which on a half float is more than half a pixel off."""


_PARTS = 32
"""Parts of a map's sides, of each of which it is asked which way around it lies."""
_SINE = 0.05
"""Least of the angle between a part's sides: those of a grey picture are one."""
_ALIKE = 0.7
"""Share of these that lie the same way in any map; in pictures it is a half, or they lie no way as they are grey."""


@dataclass(frozen=True, eq=False)
class StMap:
    """A map that was read. values (H, W, 2) float32: across and up; x, y: of its first pixel in the frame, which may be
    negative; width, height: of the frame; digest: SHA-256 of its file."""

    values: Float32
    x: int
    y: int
    width: int
    height: int
    digest: str

    def covers(self, x: int, y: int, width: int, height: int) -> bool:
        """True if it has a value for each pixel of a window of the frame."""
        rows, columns, _ = self.values.shape
        across = self.x <= x and x + width <= self.x + columns
        return across and self.y <= y and y + height <= self.y + rows

    def at(self, x: Float64, y: Float64) -> Float64:
        """(h, w, 2): its values at places x (w,), y (h,) of the frame, in pixels, interpolated linearly between pixels'
        centres; beyond the outer centres as the last two go on."""
        rows, columns, _ = self.values.shape

        def ends(place: Float64, count: int) -> tuple[np.ndarray, np.ndarray, Float64]:
            at = place - 0.5
            first = np.clip(np.floor(at), 0, max(count - 2, 0)).astype(np.int64)
            return first, np.minimum(first + 1, count - 1), at - first

        left, right, across = ends(x - self.x, columns)
        above, below, down = ends(y - self.y, rows)
        across, down = across[None, :, None], down[:, None, None]
        values = self.values

        def line(row: np.ndarray) -> Float64:
            begin, end = (values[row[:, None], column[None, :]].astype(np.float64) for column in (left, right))
            mixed = begin + across * (end - begin)
            return np.asarray(np.where(across == 0, begin, mixed))  # what is not finite stays where it is

        upper, lower = line(above), line(below)
        return np.asarray(np.where(down == 0, upper, upper + down * (lower - upper)))


def read_stmap(path: Path) -> StMap:
    """The map in a file; one that was read before is kept. Raises InputError for a file that is missing, no picture, of
    whole numbers or without two channels. Warns of half floats, which are too coarse for places in large pictures."""
    open_image(path).close()
    return _read(path, path.stat().st_mtime_ns)


@lru_cache(maxsize=2)
def _read(path: Path, changed: int) -> StMap:  # noqa: ARG001  # asked anew where the file has changed
    source = open_image(path)
    spec = source.spec()
    names = [name.upper() for name in spec.channelnames]
    channels = [names.index(name) if name in names else index for index, name in enumerate("RG")]
    kinds = {str(kind) for kind in spec.channelformats} or {str(spec.format)}
    if spec.nchannels < 2 or not kinds <= {"half", "float", "double"}:
        held = ", ".join(spec.channelnames)
        raise InputError(f"{path}: has {held} as {', '.join(sorted(kinds))}, expected an STMap: R and G as floats")
    pixels = source.read_image(oiio.FLOAT)
    reason = error_of(source)
    source.close()
    if pixels is None:
        raise InputError(f"{path}: does not decode: {one_line(reason)}; expected an STMap")
    values = np.asarray(pixels, np.float32).reshape(spec.height, spec.width, spec.nchannels)[:, :, channels]
    if (share := _one_way(values)) < _ALIKE:
        raise InputError(
            f"{path}: looks like a picture, as its R and G lead to and fro ({100 * share:.0f} % of its parts one way), "
            "expected an STMap, whose R and G are places that follow each other"
        )
    if "half" in kinds and max(spec.full_width, spec.full_height) >= HALF_PLACES:
        warn(f"{path}: is of half floats, which are pixels off at {spec.full_width}x{spec.full_height}; write floats")
    place = (spec.x - spec.full_x, spec.y - spec.full_y, spec.full_width, spec.full_height)
    return StMap(np.ascontiguousarray(values), *place, digest(path))


def _one_way(values: Float32) -> float:
    """The share of the parts of a map that show what they show the same way around, mirrored or not, of those that have
    numbers and are no part of one value; 1 of maps without numbers or too small to tell, 0 of those that show a line or
    a place."""
    rows, columns = (np.arange(0, side, max(side // _PARTS, 1)) for side in values.shape[:2])
    if len(rows) < _PARTS // 2 or len(columns) < _PARTS // 2:
        return 1.0
    corners = values[rows[:, None], columns].astype(np.float64)
    with np.errstate(invalid="ignore", over="ignore"):
        across, down = corners[:-1, 1:] - corners[:-1, :-1], corners[1:, :-1] - corners[:-1, :-1]
        areas = across[:, :, 0] * down[:, :, 1] - across[:, :, 1] * down[:, :, 0]
        sides = np.linalg.norm(across, axis=2) * np.linalg.norm(down, axis=2)
        told = np.isfinite(areas) & (sides > 0)
    if not told.any():
        return 0.0 if np.isfinite(corners).any() else 1.0
    turned = areas[told] / sides[told]  # the sine of the angle between them
    return float(max((turned > _SINE).mean(), (turned < -_SINE).mean()))


def write_stmap(path: Path, places: Float64, width: int, height: int) -> None:
    """Write a map as an EXR of 32-bit floats, atomically: R, G, and B of zeros, which compositors expect.

    places (H, W, 2): x and y in pixels from the top left corner of a picture of that width and height, NaN where there
    is none. Raises ClsplatError if writing fails.
    """
    pixels = np.zeros((*places.shape[:2], 3), np.float32)
    pixels[:, :, 0], pixels[:, :, 1] = places[:, :, 0] / width, 1 - places[:, :, 1] / height
    spec = oiio.ImageSpec(pixels.shape[1], pixels.shape[0], 3, oiio.FLOAT)
    spec.attribute("compression", "zip")
    spec.attribute("DateTime", "")
    write_spec(path, [pixels], [spec], "exr")
