# SPDX-License-Identifier: Apache-2.0
"""Rendering in strips, for frames that are too large for the device's memory, and writing by strips, for the host's."""

from __future__ import annotations

from collections.abc import Collection, Iterator
from itertools import chain
from pathlib import Path

import numpy as np

from clsplat.camera import Camera
from clsplat.config.pictures import (
    DEEP_MERGE_FLOATS,
    DEEP_STRIP_FLOATS,
    STRIP_PIXELS,
    Encoding,
    FramingConfig,
)
from clsplat.device.context import Device
from clsplat.errors import InputError
from clsplat.frame.draw import Draw, Planes, feature_floats
from clsplat.images.frame_files import FrameFileHeader, check_target, encoded
from clsplat.images.writing import write_rows
from clsplat.layouts.columns import DEEP_PICTURES, TILE
from clsplat.rendering.memory_needs import frame_pixels
from clsplat.stages.deep import DEEP_FLOATS


def strip_rows(
    device: Device,
    camera: Camera,
    names: Collection[str] = ("rgb",),
    config: FramingConfig | None = None,
    planes: int = 0,
) -> int:
    """Rows of a strip, a multiple of the tile size, such that memory is left for the model and its pairs.

    This is the picture's height if it fits in a single strip.

    names: names of the channels to render.
    config: the framing; with supersampling, rendered strips are larger than written strips.
    planes: bytes per pixel of further planes.
    """
    samples = config.supersample if config else 1
    most = min(frame_pixels(device, feature_floats(names), planes), STRIP_PIXELS)
    across = -(-camera.width * samples // TILE) * TILE * samples
    rows = most // across - 2 * TILE  # leaves room for windows that begin inside a tile, and for a filter's margins
    if rows >= camera.height:
        return camera.height
    return max(rows // TILE, 1) * TILE


def deep_rows(device: Device, camera: Camera, bins: int, pictures: int = 1) -> int:
    """Rows of a deep picture's strips, in whole tiles, for `bins` slices.

    pictures: number of pictures that each pixel is the mean of.
    """
    floats = DEEP_FLOATS * bins
    most = DEEP_STRIP_FLOATS if pictures == 1 else DEEP_MERGE_FLOATS // min(pictures, DEEP_PICTURES)
    pixels = min(most // floats, frame_pixels(device, planes=4 * floats))
    return max(pixels // (camera.width + 2 * TILE) // TILE * TILE, TILE)  # with the padding of the first and last tile


def strips(camera: Camera, rows: int) -> Iterator[Camera]:
    """Cameras of the picture's strips, of at most `rows` rows, from the top. All but the last end at tile borders."""
    if rows >= camera.height:
        yield camera
        return
    top = 0
    while top < camera.height:
        within = (camera.window.y + top) % TILE if camera.window and rows >= TILE else 0
        height = min(rows - within, camera.height - top)
        yield camera.cropped(0, top, camera.width, height)
        top += height


def in_strips(draw: Draw, rows: int) -> Draw:
    """A Draw that renders in strips. This limits the memory on the device, not on the host."""

    def drawn(camera: Camera, names: Collection[str]) -> Planes:
        parts = [draw(strip, names) for strip in strips(camera, rows)]
        return {name: np.concatenate([part[name] for part in parts]) for name in names} if len(parts) > 1 else parts[0]

    return drawn


def check_parts(camera: Camera, encoding: Encoding, views: int = 1) -> None:
    """Raise InputError for several parts or views: a file stores one after the other, so strips cannot be written.

    views: number of views in the file, 2 for a stereo pair.
    """
    if views > 1:
        raise InputError(
            f"--stereo: a picture of {camera.width}x{camera.height} is written in strips here, expected a file for "
            "each eye: {eye} in -o"
        )
    if encoding.parts == "several":
        raise InputError(
            f"--parts several: a picture of {camera.width}x{camera.height} is written in strips here, expected one part"
        )


def write_in_strips(
    path: Path,
    draw: Draw,
    camera: Camera,
    names: Collection[str],
    rows: int,
    encoding: Encoding | None = None,
    header: FrameFileHeader | None = None,
) -> None:
    """Draw and write a picture strip by strip, atomically.

    The file has the bytes that `write_channels` writes for the whole picture, except in formats whose layout depends on
    the number of rows that are written at a time. Raises InputError for channels that the format cannot store, and in
    the cases of `check_parts`. Raises ClsplatError if writing fails.
    """
    encoding, header, extension = encoding or Encoding(), header or FrameFileHeader(), path.suffix.lower()
    check_target(path, names)
    if extension == ".exr":
        check_parts(camera, encoding)
    parts = (encoded(extension, draw(strip, names), encoding, header)[0] for strip in strips(camera, rows))
    first, spec = next(parts)
    spec.height = camera.height
    if header.window is None:
        spec.full_height = camera.height
    pieces = chain(iter([first]), (pixels for pixels, _ in parts))
    del first  # frees the memory before the third strip is drawn
    write_rows(path, spec, extension[1:], ((pixels, len(pixels)) for pixels in pieces))
