# SPDX-License-Identifier: Apache-2.0
"""Frames that are too large for the device's memory or the host's: rendered in strips, and written as they come."""

from __future__ import annotations

from collections.abc import Collection, Iterator
from itertools import chain
from pathlib import Path

import numpy as np

from clsplat.camera import Camera
from clsplat.config.pictures import STRIP_PIXELS, Encoding, FramingConfig
from clsplat.device.context import Device
from clsplat.device.layout import TILE
from clsplat.errors import InputError
from clsplat.frame.draw import Draw, Planes, feature_floats
from clsplat.frame.window import crop
from clsplat.images.frame_files import Header, check_target, encoded
from clsplat.images.writing import write_rows
from clsplat.rendering.memory_needs import frame_pixels


def strip_rows(
    device: Device,
    camera: Camera,
    names: Collection[str] = ("rgb",),
    config: FramingConfig | None = None,
    planes: int = 0,
) -> int:
    """Rows of a strip that leaves room for the rest, whole tiles of them; the picture's height where it needs none.

    names: of the channels that are wanted; config: supersampling makes strips larger than they are written; planes:
    bytes of each pixel in further planes.
    """
    samples = config.supersample if config else 1
    most = min(frame_pixels(device, feature_floats(names), planes), STRIP_PIXELS)
    across = -(-camera.width * samples // TILE) * TILE * samples
    rows = most // across - 2 * TILE  # what a window that begins within a tile, and a filter's margins, add
    if rows >= camera.height:
        return camera.height
    return max(rows // TILE, 1) * TILE


def strips(camera: Camera, rows: int) -> Iterator[Camera]:
    """The picture from the top, `rows` at a time; where there are several they end with the frame's tiles."""
    if rows >= camera.height:
        yield camera
        return
    top = 0
    while top < camera.height:
        within = (camera.window.y + top) % TILE if camera.window and rows >= TILE else 0
        height = min(rows - within, camera.height - top)
        yield crop(camera, 0, top, camera.width, height)
        top += height


def in_strips(draw: Draw, rows: int) -> Draw:
    """The same channels, drawn in strips: bounds the device's memory, not the host's."""

    def drawn(camera: Camera, names: Collection[str]) -> Planes:
        parts = [draw(strip, names) for strip in strips(camera, rows)]
        return {name: np.concatenate([part[name] for part in parts]) for name in names} if len(parts) > 1 else parts[0]

    return drawn


def check_parts(camera: Camera, encoding: Encoding, views: int = 1) -> None:
    """Raise InputError for several parts, which a file has one after the other. views: of a stereo pair in the file."""
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
    header: Header | None = None,
) -> None:
    """Draw and write a picture strip by strip, atomically. The bytes are those that `write_channels` writes of all of
    it, except in formats whose layout depends on how the rows come.

    Raises InputError for what the format cannot hold and for several parts, which a file has one after the other;
    ClsplatError if writing fails.
    """
    encoding, header, extension = encoding or Encoding(), header or Header(), path.suffix.lower()
    check_target(path, names)
    if extension == ".exr":
        check_parts(camera, encoding)
    parts = (encoded(extension, draw(strip, names), encoding, header)[0] for strip in strips(camera, rows))
    first, spec = next(parts)
    spec.height = camera.height
    if header.window is None:
        spec.full_height = camera.height
    pieces = chain(iter([first]), (pixels for pixels, _ in parts))
    del first  # its memory is free before the third is drawn
    write_rows(path, spec, extension[1:], ((pixels, len(pixels)) for pixels in pieces))
