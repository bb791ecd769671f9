# SPDX-License-Identifier: Apache-2.0
"""Deep EXR files. The samples of a pixel are slices of the scene by depth, with premultiplied colour and alpha.

The samples, composited front to back, give the flat picture. The slices of a pixel are at the depths where its light is
absorbed (docs/pictures.md).
"""

from __future__ import annotations

from collections.abc import Iterator
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import NDArray

from clsplat.arrays import Float32
from clsplat.camera import Camera
from clsplat.config.channels import DEEP_CHANNELS
from clsplat.config.pictures import Encoding
from clsplat.errors import InputError
from clsplat.files.atomic import scratch_folder
from clsplat.frame.deep import Convert, DrawDeep
from clsplat.frame.strips import strips
from clsplat.images.deep_samples import deep_data, samples_bytes
from clsplat.images.frame_files import MAX_HALF_FLOAT, FrameFileHeader, deep_spec
from clsplat.images.writing import write_rows

_ENCODE_BATCH_PIXELS = 1 << 16
"""Number of pixels that are encoded at a time: few enough to limit the memory on the host, and enough to give every
thread of the encoder some rows."""


def write_deep(
    path: Path,
    draw: DrawDeep,
    camera: Camera,
    rows: int,
    bins: int,
    encoding: Encoding | None = None,
    header: FrameFileHeader | None = None,
    convert: Convert | None = None,
) -> bool:
    """Draw and write a deep scanline EXR, atomically. Returns True if the picture is empty.

    Channels are R, G, B, A, Z and ZBack. A pixel has at most `bins` slices; each is a sample at a single depth.
    Raises InputError and ClsplatError like `images.frame_files.write_channels`.

    rows: number of rows of the strips in which the picture is drawn, to limit the memory.
    encoding: stores colours as half or float; depths are always float.
    convert: function that converts colours to the file's colour space; None leaves them unchanged.
    """
    encoding, header = encoding or Encoding(), header or FrameFileHeader()
    if path.suffix.lower() != ".exr":
        raise InputError(f"{path}: deep samples need an .exr file, but the name ends in {path.suffix!r}")
    spec = deep_spec(camera.width, camera.height, encoding, header)
    seen: list[bool] = []

    with scratch_folder(samples_bytes(_ENCODE_BATCH_PIXELS + camera.width, bins)) as folder:

        def pieces() -> Iterator[tuple[Any, int]]:
            for strip in strips(camera, rows):
                planes = draw(strip)
                for top in range(0, strip.height, step := max(_ENCODE_BATCH_PIXELS // camera.width, 1)):
                    some = planes[:, :, top : top + step]
                    counts, columns = _samples(some, convert, half=encoding.depth == "half")
                    seen.append(bool(counts.any()))
                    yield deep_data(folder / "rows.exr", counts, columns), len(counts)
                del planes, some  # frees these arrays before the next strip is drawn

        write_rows(path, spec, "exr", pieces())
    return not any(seen)


def _samples(
    slices: Float32, convert: Convert | None, *, half: bool
) -> tuple[NDArray[np.int32], dict[str, NDArray[Any]]]:
    """The number of samples in each pixel (h, w), and the samples' values by channel, pixel after pixel.

    slices: planes (bins, DEEP_FLOATS, h, w) of a few rows.
    convert: as for `write_deep`. half: True stores colours as half floats.
    """
    _, floats, height, width = slices.shape
    planes = np.ascontiguousarray(slices.swapaxes(0, 1)).reshape(floats, -1)
    counts = (slices[:, 3] > 0).sum(axis=0, dtype=np.int32)
    # sample k of pixel p is at index k h w + p in a row of `planes`, because a pixel's empty slices come last
    first = np.cumsum(counts.ravel(), dtype=np.int64) - counts.ravel()
    pixels = np.repeat(np.arange(height * width), counts.ravel())
    at = (np.arange(len(pixels)) - first[pixels]) * (height * width) + pixels
    alpha, depth = planes[3].take(at), planes[4].take(at)
    rgb = np.stack([planes[channel].take(at) for channel in range(3)]).T
    light = [*(rgb if convert is None else convert(rgb[None], alpha[None])[0]).T, alpha]
    if half:
        light = [np.clip(values, -MAX_HALF_FLOAT, MAX_HALF_FLOAT).astype(np.float16) for values in light]
    # depth is in the file twice, as Z and ZBack, because a slice has a single depth
    return counts, dict(zip(DEEP_CHANNELS, [*light, depth, depth], strict=True))
