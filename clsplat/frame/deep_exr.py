# SPDX-License-Identifier: Apache-2.0
"""Deep EXR: the samples of a pixel are slices of the scene by depth, each with its alpha and associated colour.

Over each other, front to back, they are the flat picture: the Gaussians of a slice are those that the pixel takes. Each
pixel has its slices where its light is taken (docs/pictures.md).
"""

from __future__ import annotations

from collections.abc import Iterator
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import NDArray

from clsplat.arrays import Float32
from clsplat.camera import Camera
from clsplat.config.channels import DEEP
from clsplat.config.pictures import DEEP_STRIP_FLOATS, DeepConfig, Encoding
from clsplat.device.context import Device
from clsplat.device.layout import TILE
from clsplat.errors import InputError
from clsplat.files import scratch_folder
from clsplat.frame.draw import on_tiles
from clsplat.frame.strips import strips
from clsplat.gaussians import Gaussians
from clsplat.images.colour import Colours
from clsplat.images.deep_samples import deep_data, samples_bytes
from clsplat.images.frame_files import HALF_MAX, Header, deep_spec
from clsplat.images.writing import write_rows
from clsplat.rendering.memory_needs import frame_pixels
from clsplat.rendering.renderer import Renderer
from clsplat.stages.deep import DEEP_FLOATS

_MOST_PIXELS = 1 << 16
"""Pixels that are encoded at once: bounds the host's memory, and leaves the encoder rows for its threads."""


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

    with scratch_folder(samples_bytes(_MOST_PIXELS + camera.width, config.bins)) as folder:

        def pieces() -> Iterator[tuple[Any, int]]:
            for strip in strips(camera, rows):
                slices = render_deep(renderer, gaussians, strip, config.bins)
                for top in range(0, strip.height, step := max(_MOST_PIXELS // camera.width, 1)):
                    counts, columns = _samples(slices[:, top : top + step], colours, half=encoding.depth == "half")
                    seen.append(bool(counts.any()))
                    yield deep_data(folder / "rows.exr", counts, columns), len(counts)
                del slices  # its memory is free before the next strip takes some

        write_rows(path, spec, "exr", pieces())
    return not any(seen)


def _samples(slices: Float32, colours: Colours, *, half: bool) -> tuple[NDArray[np.int32], dict[str, NDArray[Any]]]:
    """The number of samples of each pixel, and their values as `deep_data` takes them. slices: of a few rows."""
    _, height, width, floats = slices.shape
    planes = np.ascontiguousarray(slices.transpose(3, 0, 1, 2)).reshape(floats, -1)
    counts = (slices[:, :, :, 3] > 0).sum(axis=0, dtype=np.int32)
    # the slices of a pixel are its first ones: sample k of pixel p is at k H W + p
    first = np.cumsum(counts.ravel(), dtype=np.int64) - counts.ravel()
    pixels = np.repeat(np.arange(height * width), counts.ravel())
    at = (np.arange(len(pixels)) - first[pixels]) * (height * width) + pixels
    alpha, depth = planes[3].take(at), planes[4].take(at)
    rgb = np.stack([planes[channel].take(at) for channel in range(3)]).T
    light = [*colours.convert(rgb[None], alpha[None], colours.model, colours.output)[0].T, alpha]
    if half:
        light = [np.clip(values, -HALF_MAX, HALF_MAX).astype(np.float16) for values in light]
    return counts, dict(zip(DEEP, [*light, depth, depth], strict=True))  # a slice begins and ends at one depth
