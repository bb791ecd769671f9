# SPDX-License-Identifier: Apache-2.0
"""Reading depth maps: PNG and TIFF of whole numbers, EXR, NPY."""

from __future__ import annotations

from pathlib import Path
from typing import Any

import numpy as np
import OpenImageIO as oiio

from clsplat.arrays import Float32
from clsplat.errors import InputError
from clsplat.files import open_input
from clsplat.images.reading import MAX_PIXELS, error_of, image_size, one_line, open_image

EXTENSIONS = (".png", ".exr", ".tif", ".tiff", ".npy")
"""Extensions of depth maps when a folder is searched, in lower case."""
KINDS = "a depth map: PNG or TIFF of whole numbers, EXR, or NPY"


LEVELS = {"uint8": 255, "uint16": 65535}
"""Largest values of the whole numbers that pictures hold."""


def map_header(path: Path) -> tuple[int, int, bool]:
    """Width and height of a depth map, and whether it is of whole numbers. Raises InputError as `read_map`, but for
    what is behind the header."""
    if path.suffix.lower() == ".npy":
        array = _numpy(path)
        return array.shape[1], array.shape[0], array.dtype.kind in "iu"
    source = open_image(path)
    kind = str(source.spec().format)
    source.close()
    return *image_size(path, orient=False), kind in LEVELS


def read_map(path: Path) -> Float32:
    """The values (H, W) of a depth map as they are stored: whole numbers of 8 and 16 bits are not scaled. Of a file
    with several channels the one called Z or depth, else the first. NaN where a value is not finite.

    Raises InputError, naming the file, for one that is missing, damaged, or no depth map.
    """
    if path.suffix.lower() == ".npy":
        values = np.array(_numpy(path), np.float32)
    else:
        source = open_image(path)
        spec = source.spec()
        pixels = source.read_image(oiio.FLOAT)
        reason = error_of(source)
        source.close()
        if pixels is None or reason:
            raise InputError(f"{path}: does not decode: {one_line(reason)}; copy the depth map again")
        pixels = np.asarray(pixels, np.float32).reshape(spec.height, spec.width, spec.nchannels)
        values = np.ascontiguousarray(pixels[:, :, _channel(spec)])
        levels = LEVELS.get(str(spec.format))
        if levels:
            values = np.rint(values * np.float32(levels))
    return np.where(np.isfinite(values), values, np.float32(np.nan))


def _channel(spec: Any) -> int:
    names = [name.rpartition(".")[2].lower() for name in spec.channelnames]
    return next((names.index(name) for name in ("z", "depth") if name in names), 0)


def _numpy(path: Path) -> Any:
    with open_input(path, KINDS):
        pass
    try:
        array = np.load(path, mmap_mode="r", allow_pickle=False)
    except (ValueError, OSError, EOFError) as error:
        raise InputError(f"{path}: does not read as NPY: {one_line(str(error))}; expected {KINDS}") from None
    array = array[..., 0] if array.ndim == 3 and array.shape[2] == 1 else array
    if array.ndim != 2 or array.dtype.kind not in "fiu" or not 0 < array.size <= MAX_PIXELS:
        raise InputError(f"{path}: is {array.dtype} of shape {array.shape}, expected numbers (height, width)")
    return array
