# SPDX-License-Identifier: Apache-2.0
"""Deep EXR: the samples of a pixel are slices of the scene by depth, each with its alpha and associated colour.

Over each other, front to back, they are the flat picture: the Gaussians of a slice are those that the pixel takes. Each
pixel has its slices where its light is taken (docs/pictures.md).
"""

from __future__ import annotations

from collections import deque
from collections.abc import Iterator
from itertools import repeat
from pathlib import Path
from typing import Any

import numpy as np
import OpenImageIO as oiio

from clsplat.arrays import Float32
from clsplat.camera import Camera
from clsplat.config.channels import DEEP
from clsplat.config.pictures import DEEP_STRIP_FLOATS, DeepConfig, Encoding
from clsplat.device.context import Device
from clsplat.device.layout import TILE
from clsplat.errors import InputError
from clsplat.frame.draw import on_tiles
from clsplat.frame.strips import strips
from clsplat.gaussians import Gaussians
from clsplat.images.colour import Colours
from clsplat.images.frame_files import HALF_MAX, Header, deep_spec
from clsplat.images.writing import write_rows
from clsplat.rendering.memory_needs import frame_pixels
from clsplat.rendering.renderer import Renderer
from clsplat.stages.deep import DEEP_FLOATS


def render_deep(renderer: Renderer, gaussians: Gaussians, camera: Camera, bins: int) -> Float32:
    """(bins, H, W, 5): red, green, blue, associated with alpha; alpha; depth. All 0 behind a pixel's last slice."""
    larger, rows, columns = on_tiles(camera)
    return renderer.render_deep(gaussians, larger, bins)[:, rows, columns]


def deep_rows(device: Device, camera: Camera, bins: int) -> int:
    """Rows of the strips, in whole tiles, that a deep picture of `bins` slices is rendered in."""
    floats = DEEP_FLOATS * bins
    pixels = min(DEEP_STRIP_FLOATS // floats, frame_pixels(device, planes=4 * floats))
    return max(pixels // (camera.width + 2 * TILE) // TILE * TILE, TILE)  # with what fills the first and last tile


def write_deep(
    path: Path,
    renderer: Renderer,
    gaussians: Gaussians,
    camera: Camera,
    config: DeepConfig | None = None,
    encoding: Encoding | None = None,
    header: Header | None = None,
    colours: Colours | None = None,
) -> bool:
    """Render and write a deep scanline EXR, atomically, in strips that bound the memory; True if nothing is in it.

    Channels R G B A Z ZBack; a pixel has a sample for each of its slices, all of it at one depth. Colours are half or
    float as the encoding says, depths are float. Raises InputError and ClsplatError as
    `images.frame_files.write_channels`.
    """
    config = config or DeepConfig()
    encoding, header, colours = encoding or Encoding(), header or Header(), colours or Colours()
    if path.suffix.lower() != ".exr":
        raise InputError(f"{path}: deep samples want an .exr file")
    spec = deep_spec(camera.width, camera.height, encoding, header)
    rows = deep_rows(renderer.device, camera, config.bins)
    seen: list[bool] = []

    def pieces() -> Iterator[tuple[Any, int]]:
        for strip in strips(camera, rows):
            slices = render_deep(renderer, gaussians, strip, config.bins)
            seen.append(bool(slices[:, :, :, 3].any()))
            for image in slices:
                rgb, alpha = np.ascontiguousarray(image[:, :, :3]), np.ascontiguousarray(image[:, :, 3])
                image[:, :, :3] = colours.convert(rgb, alpha, colours.model, colours.output)
            yield from _deep_rows(slices, list(spec.channelformats), half=encoding.depth == "half")

    write_rows(path, spec, "exr", pieces())
    return not any(seen)


def _deep_rows(slices: Float32, kinds: list[Any], *, half: bool) -> Iterator[tuple[Any, int]]:
    """(samples, rows) from the top, a few rows at a time."""
    bins, height, width, _ = slices.shape
    if half:
        slices[:, :, :, :4] = np.clip(slices[:, :, :, :4], -HALF_MAX, HALF_MAX)
    for top in range(0, height, step := max((1 << 18) // width, 1)):
        rows = slices[:, top : top + step].reshape(bins, -1, DEEP_FLOATS).transpose(1, 0, 2)
        taken = rows[:, :, 3] > 0
        data = oiio.DeepData()
        data.init(len(rows), len(DEEP), kinds, list(DEEP))
        _call_with(data.set_samples, range(len(rows)), taken.sum(axis=1).tolist())
        pixels = np.nonzero(taken)[0].tolist()
        samples = (np.cumsum(taken, axis=1) - 1)[taken].tolist()
        values = rows[taken]
        for channel in range(len(DEEP)):  # the last is Z again: a slice begins and ends at one depth
            column = values[:, min(channel, DEEP_FLOATS - 1)].tolist()
            _call_with(data.set_deep_value, pixels, repeat(channel), samples, column)
        yield data, len(rows) // width


def _call_with(function: Any, *arguments: Any) -> None:
    """Call it with each row of arguments: OpenImageIO takes deep values one by one, and a loop takes twice as long."""
    deque(map(function, *arguments), maxlen=0)
