# SPDX-License-Identifier: Apache-2.0
"""Strips of a large picture: rendering strip by strip saves device memory, and writing strip by strip host memory."""

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
    extra_bytes: int = 0,
) -> int:
    """Number of rows of a strip, a multiple of the tile size, that leaves memory for the model and its pairs.

    If the picture fits in a single strip, the number is the picture's height.

    names: names of the channels to render.
    config: the framing; with supersampling, rendered strips are larger than written strips.
    extra_bytes: bytes per pixel that the frame needs in addition to its channels, such as for a holdout.
    """
    samples = config.supersample if config else 1
    most = min(frame_pixels(device, feature_floats(names), extra_bytes), STRIP_PIXELS)
    across = -(-camera.width * samples // TILE) * TILE * samples
    rows = most // across - 2 * TILE  # two tiles spare: windows may begin inside a tile, and filters read margins
    if rows >= camera.height:
        return camera.height
    return max(rows // TILE, 1) * TILE


def deep_rows(device: Device, camera: Camera, bins: int, pictures: int = 1) -> int:
    """Number of rows of a deep picture's strips, a multiple of the tile size.

    bins: maximum number of slices per pixel.
    pictures: number of pictures that are averaged.
    """
    floats = DEEP_FLOATS * bins
    most = DEEP_STRIP_FLOATS if pictures == 1 else DEEP_MERGE_FLOATS // min(pictures, DEEP_PICTURES)
    pixels = min(most // floats, frame_pixels(device, planes=4 * floats))
    return max(pixels // (camera.width + 2 * TILE) // TILE * TILE, TILE)  # up to 2 TILE columns are padding


def strips(camera: Camera, rows: int) -> Iterator[Camera]:
    """Yield the cameras of a picture's strips, from the top, of at most `rows` rows each.

    Every strip but the last ends at a tile border of the frame.
    """
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
    """Return a function (`Draw`) that renders a picture in strips and joins them, to save memory on the device."""

    def drawn(camera: Camera, names: Collection[str]) -> Planes:
        parts = [draw(strip, names) for strip in strips(camera, rows)]
        return {name: np.concatenate([part[name] for part in parts]) for name in names} if len(parts) > 1 else parts[0]

    return drawn


def check_parts(camera: Camera, encoding: Encoding, views: int = 1) -> None:
    """Raise InputError if an EXR file of several parts or views would have to be written in strips.

    Such a file stores one whole part or view after the other, but each strip has rows of all parts and views.

    views: number of views in the file, 2 for a stereo pair.
    """
    if views > 1:
        raise InputError(
            f"--stereo: a picture of {camera.width}x{camera.height} is too large to be written at once, expected a "
            "file for each eye: put {eye} into the name that -o gives"
        )
    if encoding.parts == "several":
        raise InputError(
            f"--parts several: a picture of {camera.width}x{camera.height} is too large to be written at once, "
            "expected --parts one"
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
    del first  # frees the first strip before the third is drawn
    write_rows(path, spec, extension[1:], ((pixels, len(pixels)) for pixels in pieces))
