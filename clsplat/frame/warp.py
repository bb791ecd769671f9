# SPDX-License-Identifier: Apache-2.0
"""Warped pictures, sampled from undistorted pictures at the positions that a `Warp` gives (docs/pictures.md).

The pixels of a window are the same as in the whole warped picture.
"""

from __future__ import annotations

from collections.abc import Collection
from dataclasses import replace
from typing import Any

import numpy as np
from numpy.typing import NDArray

from clsplat.arrays import Float32, Float64
from clsplat.camera import Camera, Window
from clsplat.config.channels import FRAME_CHANNELS
from clsplat.frame.draw import Draw, Planes
from clsplat.frame.lens import Warp

_SAMPLE_ROWS_PER_BATCH = 128
"""Number of rows of samples that are interpolated at a time, which limits the memory on the host."""


def warped(draw: Draw, warp: Warp) -> Draw:
    """Return a function (`Draw`) that renders warped pictures.

    The returned function uses only size and window of its camera. `draw` renders windows of the undistorted frame,
    with rgb in linear light. A pixel's rgb and alpha are means of `Warp.samples` x `Warp.samples` samples, interpolated
    by the Catmull-Rom cubic. Other channels come from the nearest pixel. Where nothing is visible, ids are -1 and all
    other values 0.
    """

    def bent(camera: Camera, names: Collection[str]) -> Planes:
        places, window = warp.of_window(camera)
        whole = Window(0, 0, warp.frame.width, warp.frame.height)
        straight = window or replace(warp.frame, width=1, height=1, window=whole)
        planes = draw(straight, names)
        assert straight.window is not None
        places = places - (straight.window.x, straight.window.y)
        return {name: _taken(np.asarray(plane), places, warp.samples, name) for name, plane in planes.items()}

    return bent


def _taken(plane: NDArray[Any], places: Float64, samples: int, name: str) -> NDArray[Any]:
    """Return the pixels (rows, columns) of a warped plane, from an undistorted plane (h, w) or (h, w, floats).

    places: positions (k rows, k columns, 2) of the samples in the undistorted plane; k is `samples`.
    name: name of the channel, which determines the interpolation.
    """
    height, width = places.shape[0] // samples, places.shape[1] // samples
    channel = FRAME_CHANNELS.get(name)
    result = np.empty((height, width, *plane.shape[2:]), plane.dtype)
    step = max(_SAMPLE_ROWS_PER_BATCH // samples, 1)
    for top in range(0, height, step):
        some = places[top * samples : (top + step) * samples]
        if channel is None or channel.is_light:
            values = cubic(plane, some)
            rows = len(some) // samples
            values = values.reshape(rows, samples, width, samples, *plane.shape[2:]).mean(axis=(1, 3))
        else:
            middle = some[samples // 2 :: samples, samples // 2 :: samples]
            values = nearest(plane, middle, -1 if name == "id" else 0)
        result[top : top + step] = values
    return result


def nearest(plane: NDArray[Any], places: Float64, nothing: float = 0) -> NDArray[Any]:
    """Return the values of the pixels that contain the positions (h, w, 2); `nothing` where a position is NaN."""
    there = ~np.isnan(places[:, :, 0])
    at = np.where(there[:, :, None], np.floor(places), 0).astype(np.int64)
    x, y = (np.clip(at[:, :, axis], 0, plane.shape[1 - axis] - 1) for axis in (0, 1))
    values = plane[y, x]
    values[~there] = nothing
    return values


def cubic(plane: NDArray[Any], places: Float64) -> NDArray[Any]:
    """Interpolate a plane at positions by the Catmull-Rom cubic; 0 where a position is NaN.

    The result is clamped to the range of the sixteen pixels that are read.
    """
    there = ~np.isnan(places[:, :, 0])
    at = np.where(there[:, :, None], places, 0.5) - 0.5
    first = np.floor(at).astype(np.int64)
    weights = [_catmull_rom((at - first)[:, :, axis].astype(np.float32)) for axis in (0, 1)]
    # with a repeated border, the offsets of the sixteen pixels are the same everywhere
    edges = [(2, 2), (2, 2)] + [(0, 0)] * (plane.ndim - 2)
    padded = np.pad(np.asarray(plane, np.float32), edges, mode="edge")
    height, width = padded.shape[:2]
    x, y = np.clip(first[:, :, 0] + 1, 0, width - 4), np.clip(first[:, :, 1] + 1, 0, height - 4)
    begin, lines = y * width + x, padded.reshape(height * width, *plane.shape[2:])
    total = np.zeros((*there.shape, *plane.shape[2:]), np.float32)
    low, high = np.full_like(total, np.inf), np.full_like(total, -np.inf)
    for row, down in enumerate(weights[1]):
        for column, across in enumerate(weights[0]):
            values = lines.take(begin + (row * width + column), axis=0)
            np.minimum(low, values, out=low)
            np.maximum(high, values, out=high)
            weight = down * across
            values *= weight[:, :, None] if plane.ndim == 3 else weight
            total += values
    result = np.clip(total, low, high)
    result[~there] = 0
    return result


def _catmull_rom(t: Float32) -> tuple[Float32, Float32, Float32, Float32]:
    """Weights of the four pixels around a position, which is at the distance t after the second pixel."""
    return (
        0.5 * t * (t * (2 - t) - 1),
        0.5 * (t * t * (3 * t - 5) + 2),
        0.5 * t * (t * (4 - 3 * t) + 1),
        0.5 * t * t * (t - 1),
    )
