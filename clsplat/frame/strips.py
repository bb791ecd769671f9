# SPDX-License-Identifier: Apache-2.0
"""Frames that are too large for the device's memory or the host's: rendered in strips, and written as they come."""

from __future__ import annotations

from collections.abc import Collection, Iterator
from pathlib import Path
from typing import TYPE_CHECKING, Any

import numpy as np
from numpy.typing import NDArray

from clsplat.camera import Camera
from clsplat.config.pictures import STRIP_PIXELS, Encoding, FramingConfig
from clsplat.device.layout import TILE
from clsplat.errors import InputError
from clsplat.frame.draw import Draw, Layers, feature_floats
from clsplat.frame.window import crop
from clsplat.images.channels import check_format, encoded
from clsplat.images.exr_header import Header
from clsplat.images.writing import atomic_output
from clsplat.rendering.memory_needs import frame_pixels

if TYPE_CHECKING:
    from clsplat.device.context import Device


def strip_rows(
    device: Device, camera: Camera, names: Collection[str] = ("rgb",), config: FramingConfig | None = None
) -> int:
    """Rows of a strip that leaves room for the rest, whole tiles of them; the picture's height where it needs none.

    names: of the layers that are wanted; config: supersampling makes strips larger than they are written.
    """
    samples = config.supersample if config else 1
    most = min(frame_pixels(device, feature_floats(names)), STRIP_PIXELS)
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
    """The same layers, drawn in strips: bounds the device's memory, not the host's."""

    def drawn(camera: Camera, names: Collection[str]) -> Layers:
        parts = [draw(strip, names) for strip in strips(camera, rows)]
        return {name: np.concatenate([part[name] for part in parts]) for name in parts[0]}

    return drawn


def write_in_strips(
    path: Path,
    draw: Draw,
    camera: Camera,
    names: Collection[str],
    rows: int,
    encoding: Encoding | None = None,
    header: Header | None = None,
) -> None:
    """Draw and write a picture strip by strip, atomically; the same bytes as `write_channels` writes of all of it, but
    for layouts of a file that depend on how it is handed over.

    Raises InputError for what the format cannot hold and for several parts, which a file has one after the other;
    ClsplatError if writing fails.
    """
    path, encoding, header = Path(path), encoding or Encoding(), header or Header()
    extension = path.suffix.lower()
    check_format(str(path), names)
    if not path.parent.is_dir():
        raise InputError(f"{path.parent}: no such folder to write {path.name} to")
    if extension == ".exr" and encoding.parts == "several":
        raise InputError(
            f"--parts several: a picture of {camera.width}x{camera.height} is written in strips, expected one part"
        )
    pictures = strips(camera, rows)

    def made(strip: Camera) -> tuple[NDArray[Any], Any]:
        ((pixels, spec),) = encoded(extension, draw(strip, names), encoding, header)
        return pixels, spec

    pixels, spec = made(next(pictures))
    spec.height = camera.height
    if header.window is None:
        spec.full_height = camera.height
    with atomic_output(path, [spec], extension[1:]) as output:
        row = spec.y
        while True:
            output.take(output.file.write_scanlines(row, row + len(pixels), 0, pixels))
            row += len(pixels)
            if row == spec.y + camera.height:
                break
            pixels, _ = made(next(pictures))
