# SPDX-License-Identifier: Apache-2.0
"""Reading of depth maps from files: integer PNG and TIFF, EXR, NPY."""

from __future__ import annotations

from pathlib import Path
from typing import Any

import numpy as np
import OpenImageIO as oiio

from clsplat.arrays import Float32
from clsplat.errors import InputError
from clsplat.files.documents import open_input
from clsplat.images.reading import MAX_IMAGE_PIXELS, error_of, one_line, open_image, stored_size

DEPTH_MAP_SUFFIXES = (".png", ".exr", ".tif", ".tiff", ".npy")
"""Lower-case extensions of the depth maps that a folder search finds."""
DEPTH_MAP_KINDS = "a depth map: PNG or TIFF of whole numbers, EXR, or NPY"


INTEGER_MAXIMA = {"uint8": 255, "uint16": 65535}
"""Largest value of each integer pixel type."""


def map_header(path: Path) -> tuple[int, int, bool]:
    """Return a depth map's width, height, and True if it stores integers. Reads only the header.

    Raises InputError like `read_map` for errors in the header.
    """
    if path.suffix.lower() == ".npy":
        array = _numpy(path)
        return array.shape[1], array.shape[0], array.dtype.kind in "iu"
    source = open_image(path)
    size, kind = stored_size(path, source), str(source.spec().format)
    source.close()
    return *size, kind in INTEGER_MAXIMA


def read_map(path: Path) -> Float32:
    """Read a depth map's values (H, W) as stored, without scaling of integers. Non-finite values become NaN.

    Of several channels, reads the channel called Z or depth, or else the first. Raises InputError with the file's name
    if the file is missing, damaged, or not a depth map.
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
        levels = INTEGER_MAXIMA.get(str(spec.format))
        if levels:
            values = np.rint(values * np.float32(levels))
    return np.where(np.isfinite(values), values, np.float32(np.nan))


def _channel(spec: Any) -> int:
    names = [name.rpartition(".")[2].lower() for name in spec.channelnames]
    return next((names.index(name) for name in ("z", "depth") if name in names), 0)


def _numpy(path: Path) -> Any:
    with open_input(path, DEPTH_MAP_KINDS):
        pass
    try:
        array = np.load(path, mmap_mode="r", allow_pickle=False)
    except (ValueError, OSError, EOFError) as error:
        raise InputError(f"{path}: cannot be read as NPY: {one_line(str(error))}; expected {DEPTH_MAP_KINDS}") from None
    array = array[..., 0] if array.ndim == 3 and array.shape[2] == 1 else array
    if array.ndim != 2 or array.dtype.kind not in "fiu" or not 0 < array.size <= MAX_IMAGE_PIXELS:
        raise InputError(f"{path}: is {array.dtype} of shape {array.shape}, expected an array (height, width)")
    return array
