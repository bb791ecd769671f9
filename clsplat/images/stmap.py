# SPDX-License-Identifier: Apache-2.0
"""Reading and writing of STMaps: images whose red and green give each pixel's source position in another image.

Positions are fractions of the source image's width and height, from its lower left corner, as in Nuke. At pixel (x, y)
from the top left corner, the identity map is (x + 1/2) / width and 1 - (y + 1/2) / height.
"""

from __future__ import annotations

from dataclasses import dataclass
from functools import lru_cache
from pathlib import Path

import numpy as np
import OpenImageIO as oiio

from clsplat.arrays import Float32, Float64
from clsplat.errors import InputError, warn
from clsplat.files.documents import digest
from clsplat.images.reading import error_of, one_line, open_image
from clsplat.images.writing import write_spec

HALF_FLOAT_SIDE_LIMIT_PX = 2048
"""Image side in pixels from which positions in half floats may be off by more than half a pixel."""


_ORIENTATION_CELLS_PER_SIDE = 32
"""Number of grid cells along each side of an image in `_oriented_share`, which tests if the image is an STMap."""
_MIN_CELL_SINE = 0.05
"""A grid cell counts as mirrored or not mirrored only if the angle between its mapped sides has a sine of at least this
magnitude."""
_MIN_ORIENTED_SHARE = 0.7
"""Minimum result of `_oriented_share` for an STMap. For an ordinary picture the result is about a half, and for a grey
picture 0, because the mapped sides of its cells coincide."""


@dataclass(frozen=True, eq=False)
class StMap:
    """STMap from a file.

    values: (H, W, 2) float32, source position of each pixel, as fractions of the source's width and height.
    x, y: position of the map's first pixel in the frame; may be negative.
    width, height: size of the frame.
    digest: SHA-256 of the map's file.
    """

    values: Float32
    x: int
    y: int
    width: int
    height: int
    digest: str

    def covers(self, x: int, y: int, width: int, height: int) -> bool:
        """Return True if the map has a value for each pixel of a window of the frame."""
        rows, columns, _ = self.values.shape
        across = self.x <= x and x + width <= self.x + columns
        return across and self.y <= y and y + height <= self.y + rows

    def at(self, x: Float64, y: Float64) -> Float64:
        """Return the map's values (h, w, 2) at positions x (w,), y (h,) of the frame, in pixels.

        Values are interpolated linearly between pixel centres, and extrapolated beyond the outermost centres.
        """
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
            return np.asarray(np.where(across == 0, begin, mixed))  # 0 times a non-finite neighbour would be NaN

        upper, lower = line(above), line(below)
        return np.asarray(np.where(down == 0, upper, upper + down * (lower - upper)))


def read_stmap(path: Path) -> StMap:
    """Read an STMap. The last two maps read are cached.

    Raises InputError for a file that is missing, not an image, not of floats, or without two channels. Warns if a large
    map has half floats, which are too coarse for its positions.
    """
    try:
        changed = path.stat().st_mtime_ns
    except OSError:
        changed = 0  # the file cannot be found, which open_image reports
    return _read(path, changed)


@lru_cache(maxsize=2)
def _read(path: Path, changed: int) -> StMap:  # noqa: ARG001  # `changed` is a key of the cache
    source = open_image(path)
    spec = source.spec()
    names = [name.upper() for name in spec.channelnames]
    channels = [names.index(name) if name in names else index for index, name in enumerate("RG")]
    kinds = {str(kind) for kind in spec.channelformats} or {str(spec.format)}
    if spec.nchannels < 2 or not kinds <= {"half", "float", "double"}:
        held = ", ".join(spec.channelnames)
        raise InputError(f"{path}: has {held} as {', '.join(sorted(kinds))}, expected an STMap's R and G as floats")
    pixels = source.read_image(oiio.FLOAT)
    reason = error_of(source)
    source.close()
    if pixels is None:
        raise InputError(f"{path}: does not decode: {one_line(reason)}; expected an STMap")
    values = np.asarray(pixels, np.float32).reshape(spec.height, spec.width, spec.nchannels)[:, :, channels]
    if _oriented_share(values) < _MIN_ORIENTED_SHARE:
        raise InputError(
            f"{path}: looks like a picture: as an STMap, it would mirror some cells of a grid and not others; expected "
            "R and G that are positions in another image"
        )
    if "half" in kinds and max(spec.full_width, spec.full_height) >= HALF_FLOAT_SIDE_LIMIT_PX:
        warn(f"{path}: has half floats, too coarse for {spec.full_width}x{spec.full_height} pixels; write floats")
    place = (spec.x - spec.full_x, spec.y - spec.full_y, spec.full_width, spec.full_height)
    return StMap(np.ascontiguousarray(values), *place, digest(path))


def _oriented_share(values: Float32) -> float:
    """Return the fraction of grid cells that an STMap mirrors, or that it does not mirror, whichever is larger.

    Cells whose values are not finite or do not vary are left out. The result is 1 for a map that is too small to judge
    or has no finite values. It is 0 for a map whose positions lie on a line or in a point.

    values: (H, W, 2), source positions, as in `StMap`.
    """
    rows, columns = (np.arange(0, side, max(side // _ORIENTATION_CELLS_PER_SIDE, 1)) for side in values.shape[:2])
    if len(rows) < _ORIENTATION_CELLS_PER_SIDE // 2 or len(columns) < _ORIENTATION_CELLS_PER_SIDE // 2:
        return 1.0
    corners = values[rows[:, None], columns].astype(np.float64)
    with np.errstate(invalid="ignore", over="ignore"):
        across, down = corners[:-1, 1:] - corners[:-1, :-1], corners[1:, :-1] - corners[:-1, :-1]
        areas = across[:, :, 0] * down[:, :, 1] - across[:, :, 1] * down[:, :, 0]
        sides = np.linalg.norm(across, axis=2) * np.linalg.norm(down, axis=2)
        told = np.isfinite(areas) & (sides > 0)
    if not told.any():
        return 0.0 if np.isfinite(corners).any() else 1.0
    turned = areas[told] / sides[told]  # sine of the angle between a cell's mapped sides
    return float(max((turned > _MIN_CELL_SINE).mean(), (turned < -_MIN_CELL_SINE).mean()))


def write_stmap(path: Path, places: Float64, width: int, height: int) -> None:
    """Write an STMap as a 32-bit float EXR, atomically. Its B is 0, because compositors expect three channels.

    places: (H, W, 2), source position of each pixel, in pixels from the source image's top left corner; NaN for none.
    width, height: size of the source image in pixels.
    Raises ClsplatError if writing fails.
    """
    pixels = np.zeros((*places.shape[:2], 3), np.float32)
    pixels[:, :, 0], pixels[:, :, 1] = places[:, :, 0] / width, 1 - places[:, :, 1] / height
    spec = oiio.ImageSpec(pixels.shape[1], pixels.shape[0], 3, oiio.FLOAT)
    spec.attribute("compression", "zip")
    spec.attribute("DateTime", "")
    write_spec(path, [pixels], [spec], "exr")
