# SPDX-License-Identifier: Apache-2.0
"""Depth EXR and deep EXR files as other renderers write them, and depths of a sphere for them."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from pathlib import Path
from typing import Any

import numpy as np
import OpenImageIO as oiio
from numpy.typing import NDArray
from pictures import write_pixels

from clsplat.camera import Camera

Samples = Sequence[Sequence[Sequence[float]]]
"""Samples of all pixels: a list for each pixel, with the channels' values of each of its samples."""


def write_flat(
    path: Path,
    channels: Mapping[str, NDArray[Any]],
    *,
    size: tuple[int, int] | None = None,
    window: tuple[int, int, int, int] | None = None,
) -> Path:
    """Write an EXR of channels (H, W).

    size: width and height of the frame; by default those of the channels.
    window: the data window (x, y, width, height); by default it begins at the frame's corner.
    """
    pixels = np.stack(list(channels.values()), axis=2).astype(np.float32)
    x, y = (window or (0, 0))[:2]
    width, height = size or (pixels.shape[1], pixels.shape[0])
    frame: dict[str, Any] = {"full_x": 0, "full_y": 0, "full_width": width, "full_height": height}
    return write_pixels(path, pixels, channelnames=tuple(channels), x=x, y=y, **frame)


def write_samples(path: Path, size: tuple[int, int], samples: Samples, names: Sequence[str] = ("A", "Z")) -> Path:
    """Write a deep EXR of a frame. size: width and height."""
    spec = oiio.ImageSpec(*size, len(names), oiio.FLOAT)
    spec.channelnames, spec.deep = tuple(names), True
    data = oiio.DeepData()
    data.init(size[0] * size[1], len(names), [oiio.TypeDesc("float")] * len(names), list(names))
    for pixel, each in enumerate(samples):
        data.set_samples(pixel, len(each))
    for pixel, each in enumerate(samples):
        for sample, values in enumerate(each):
            for channel, value in enumerate(values):
                data.set_deep_value(pixel, channel, sample, float(value))
    output = oiio.ImageOutput.create(str(path))
    assert output is not None and output.open(str(path), spec) and output.write_deep_image(data)
    output.close()
    return path


def sphere(camera: Camera, centre: Sequence[float], radius: float) -> NDArray[np.float64]:
    """Depths (H, W) along the camera's axis of a sphere, at the pixels' centres; infinite in pixels that miss it.

    centre: (3,), in the camera's space.
    """
    x = (np.arange(camera.width) + 0.5 - camera.cx) / camera.fx
    y = (np.arange(camera.height) + 0.5 - camera.cy) / camera.fy
    rays = np.stack(np.broadcast_arrays(x, y[:, None], 1.0), axis=2)
    along, square = rays @ np.asarray(centre, np.float64), (rays**2).sum(axis=2)
    root = along**2 - square * (np.dot(centre, centre) - radius**2)
    return np.asarray(np.where(root > 0, (along - np.sqrt(np.maximum(root, 0))) / square, np.inf))


def sphere_samples(camera: Camera, centre: Sequence[float], radius: float, fine: int = 4) -> list[list[list[float]]]:
    """Deep samples of a sphere, one for each pixel that it covers at least partly.

    A sample's alpha is the fraction of fine x fine rays that hit the sphere, and its depth is their mean.
    """
    depths = sphere(camera.resized(camera.width * fine, camera.height * fine), centre, radius)
    blocks = depths.reshape(camera.height, fine, camera.width, fine).transpose(0, 2, 1, 3).reshape(-1, fine * fine)
    hits = np.isfinite(blocks)
    return [[[hit.mean(), block[hit].mean()]] if hit.any() else [] for hit, block in zip(hits, blocks, strict=True)]
