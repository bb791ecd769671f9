# SPDX-License-Identifier: Apache-2.0
"""Holdouts: surfaces of CG elements in a frame, read from a depth EXR or a deep EXR (docs/pictures.md)."""

from __future__ import annotations

from collections.abc import Iterator, Sequence
from contextlib import contextmanager
from dataclasses import dataclass
from itertools import repeat
from pathlib import Path
from typing import Any

import numpy as np
import OpenImageIO as oiio
from numpy.typing import NDArray

from clsplat.arrays import Float32
from clsplat.config.pictures import HOLDOUT_SURFACE_FIELDS
from clsplat.errors import InputError, examples
from clsplat.files.documents import is_file
from clsplat.images.reading import error_of, one_line, open_image


@dataclass(frozen=True, eq=False)
class Surfaces:
    """The surfaces in each pixel of an image, S in all.

    counts: (H, W) int64, number of surfaces of each pixel.
    rows: (S, 4) float32, the values HOLDOUT_SURFACE_FIELDS of each surface: front depth, back depth, transmittance, and
        log2 of the transmittance per unit of depth. Rows are ordered by pixel, and within a pixel by front depth.
    """

    counts: NDArray[np.int64]
    rows: Float32

    @property
    def dense(self) -> int:
        """Mean number of surfaces per pixel, rounded up, in the image row that has most surfaces."""
        return int(np.ceil(self.counts.mean(axis=1).max(initial=0)))

    def taken(self, across: NDArray[np.int64], down: NDArray[np.int64]) -> Surfaces:
        """Resample: pixel (x, y) of the result gets the surfaces of pixel (across[x], down[y]), if it exists."""
        height, width = self.counts.shape
        if np.array_equal(across, np.arange(width)) and np.array_equal(down, np.arange(height)):
            return self
        inside = ((down >= 0) & (down < height))[:, None] & ((across >= 0) & (across < width))
        source = np.clip(down, 0, height - 1)[:, None] * width + np.clip(across, 0, width - 1)
        counts = np.where(inside, self.counts.ravel()[source], 0)
        ends, flat = np.cumsum(self.counts), counts.ravel()
        first = (ends[source] - self.counts.ravel()[source]).ravel() - (np.cumsum(flat) - flat)
        return Surfaces(counts, self.rows[np.repeat(first, flat) + np.arange(flat.sum())])

    def scaled(self, factors: Float32) -> Surfaces:
        """Return a copy in which the depths of each pixel are multiplied by the pixel's factor in `factors` (H, W)."""
        by = np.repeat(factors.ravel(), self.counts.ravel())[:, None]
        return Surfaces(self.counts, (self.rows * np.concatenate([by, by, by**0, 1 / by], axis=1)).astype(np.float32))


@dataclass(frozen=True, eq=False)
class Holdout:
    """Surfaces of CG elements that hold out the model in a frame.

    surfaces: surfaces in the file's data window.
    x, y: position of the data window's first pixel in the frame.
    size: width and height of the frame.
    """

    surfaces: Surfaces
    x: int
    y: int
    size: tuple[int, int]


def check_holdout(path: Path, size: tuple[int, int], channel: str = "") -> bool:
    """Check the header of a holdout file. Return True if the file's depths are half floats.

    channel: name of the depth channel; "" for Z.
    Raises InputError if the file cannot be a holdout of a frame of this size (width, height).
    """
    with _part(path, size, channel) as (source, _, places):
        spec = source.spec()
        kinds = [str(kind) for kind in spec.channelformats] or [str(spec.format)] * spec.nchannels
        return any(kinds[place] == "half" for place in (places[0], places[2]) if place is not None)


def read_holdout(path: Path, size: tuple[int, int], channel: str = "", *, inverse: bool = False) -> Holdout:
    """Read the holdout of a frame of this size (width, height).

    channel: name of the depth channel; "" for Z. A flat file may also have A; a deep file has A and may have ZBack.
    inverse: True if the file stores 1 / depth.
    Depths of 0 and infinity mean no surface. Raises InputError like `check_holdout`, and for NaN, negative depths, and
    files that do not decode.
    """
    with _part(path, size, channel) as (source, part, places):
        spec = source.spec()
        shape = (spec.height, spec.width)
        if spec.deep:
            counts, columns = _deep(path, source, part, places)
        else:
            columns = [_plane(path, source, part, place) for place in places]
            counts = np.ones(shape[0] * shape[1], np.int64)
        origin = (spec.x - spec.full_x, spec.y - spec.full_y)
    begin, alpha, end = columns
    assert begin is not None, "`_part` requires the depth channel"
    name, end = channel or "Z", begin if end is None else end
    alpha = np.ones(len(begin), np.float32) if alpha is None else alpha
    for values, what in ((begin, name), (end, "ZBack"), (alpha, "A")):
        if odd := int(np.isnan(values).sum()):
            raise InputError(f"{path}: {odd} values of {what} are NaN, expected depths and alpha of surfaces")
    if odd := int((begin < 0).sum()):
        raise InputError(f"{path}: {odd} values of {name} are negative, expected depths along the camera's axis")
    if inverse:
        with np.errstate(divide="ignore"):
            begin, end = (1 / np.asarray(values, np.float64) for values in (begin, end))
    return Holdout(_surfaces(begin, end, alpha, counts, shape), *origin, size)


def surfaces_of(begin: NDArray[Any], end: NDArray[Any], alpha: NDArray[Any]) -> Surfaces:
    """Return surfaces from front depths, back depths and alpha, each (H, W, count).

    Entries with a front depth of 0 or infinity, or an alpha of 0, are left out.
    """
    counts = np.full(begin.shape[0] * begin.shape[1], begin.shape[2])
    return _surfaces(begin.ravel(), end.ravel(), alpha.ravel(), counts, begin.shape[:2])


def _surfaces(
    begin: NDArray[Any], end: NDArray[Any], alpha: NDArray[Any], counts: NDArray[np.int64], shape: tuple[int, ...]
) -> Surfaces:
    """Return surfaces like `surfaces_of`, from flat arrays that are ordered by pixel.

    begin, end, alpha: (S,), front depths, back depths and alpha.
    counts: (H W,), number of entries of these arrays that belong to each pixel.
    shape: height and width of the image.
    """
    alpha = np.clip(alpha, 0, 1)
    shown = (begin > 0) & (begin < np.inf) & (alpha > 0)
    pixels = np.repeat(np.arange(len(counts)), counts)[shown]
    begin, end, alpha = begin[shown], end[shown], alpha[shown]
    if counts.max(initial=0) > 1:
        order = np.lexsort((begin, pixels))
        begin, end, alpha = begin[order], end[order], alpha[order]
    rows = _rows(begin, end, alpha)
    return Surfaces(np.bincount(pixels, minlength=len(counts)).reshape(shape), rows)


def _rows(begin: NDArray[Any], end: NDArray[Any], alpha: NDArray[Any]) -> Float32:
    """Return `Surfaces.rows` (S, 4) of surfaces with these front depths, back depths and alpha, each (S,).

    The back depth of an opaque surface is set to its front depth.
    """
    rows = np.zeros((len(begin), len(HOLDOUT_SURFACE_FIELDS)), np.float32)
    rows[:, 0], rows[:, 2] = begin, 1 - alpha
    rows[:, 1] = np.where((alpha < 1) & (end > begin), end, begin)
    long = rows[:, 1] > rows[:, 0]
    length = rows[long, 1].astype(np.float64) - rows[long, 0]
    rows[long, 3] = np.log2(1 - alpha[long].astype(np.float64)) / length
    return rows


@contextmanager
def _part(path: Path, size: tuple[int, int], channel: str) -> Iterator[tuple[Any, int, list[int | None]]]:
    """Open a holdout file. Yield OpenImageIO's input, the number of the part that contains the depth channel, and the
    indices of the channels of front depths, alpha and back depths. An index is None if the file lacks the channel.

    size: width and height of the frame.
    channel: name of the depth channel; "" for Z.
    """
    if not is_file(path):
        raise InputError(f"{path}: no such holdout file, expected a depth or deep EXR for each rendered frame")
    source = open_image(path)
    try:
        if source.format_name() != "openexr":
            raise InputError(f"{path}: is not an EXR file, expected a depth or deep EXR as a holdout")
        name, part, seen = channel or "Z", 0, []
        while source.seek_subimage(part, 0) and name not in (names := list(source.spec().channelnames)):
            seen += names
            part += 1
        spec = source.spec()
        if not source.seek_subimage(part, 0):
            raise InputError(
                f"{path}: has the channels {examples(seen)}, expected {name}; give the channel of its depths with "
                "--holdout.channel"
            )
        if (spec.full_width, spec.full_height) != size:
            raise InputError(
                f"{path}: has a display window of {spec.full_width}x{spec.full_height} pixels, expected "
                f"{size[0]}x{size[1]} like the rendered frame"
            )
        layer = name[: name.rfind(".") + 1]
        alpha, back = (names.index(layer + word) if layer + word in names else None for word in ("A", "ZBack"))
        if spec.deep and alpha is None:
            raise InputError(f"{path}: is a deep EXR without {layer}A, expected the alpha of its samples")
        yield source, part, [names.index(name), alpha, back if spec.deep else None]
    finally:
        source.close()


def _plane(path: Path, source: Any, part: int, place: int | None) -> NDArray[Any] | None:
    if place is None:
        return None
    plane = source.read_image(part, 0, place, place + 1, oiio.FLOAT)
    if plane is None:
        raise InputError(f"{path}: does not decode: {one_line(error_of(source))}; write the holdout again")
    return np.asarray(plane).ravel()


def _deep(
    path: Path, source: Any, part: int, places: Sequence[int | None]
) -> tuple[NDArray[np.int64], list[NDArray[Any] | None]]:
    data = source.read_native_deep_image(part, 0)
    if data is None:
        raise InputError(f"{path}: does not decode: {one_line(error_of(source))}; write the holdout again")
    counts = np.fromiter(map(data.samples, range(data.pixels)), np.int64, data.pixels)
    total = int(counts.sum())
    pixels = np.repeat(np.arange(data.pixels), counts).tolist()
    samples = (np.arange(total) - np.repeat(np.cumsum(counts) - counts, counts)).tolist()

    def column(place: int | None) -> NDArray[Any] | None:
        if place is None:
            return None
        return np.fromiter(map(data.deep_value, pixels, repeat(place), samples), np.float32, total)

    return counts, [column(place) for place in places]
