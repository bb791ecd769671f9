# SPDX-License-Identifier: Apache-2.0
"""Deep pictures: rendered by the kernels, averaged over samples of shutter and lens, and warped (docs/pictures.md).

A `DrawDeep` returns the slices of a camera's picture by depth, as planes (bins, DEEP_FLOATS, H, W): premultiplied red,
green and blue, alpha, and depth. A pixel with fewer slices than `bins` has zeros after its last slice.
"""

from __future__ import annotations

from collections.abc import Callable, Iterable, Iterator, Sequence
from functools import reduce
from itertools import islice

import numpy as np

from clsplat.arrays import Float32, Float64
from clsplat.camera import Camera
from clsplat.config.pictures import DEEP_MERGE_FLOATS
from clsplat.device.buffers import Workspace, upload
from clsplat.device.context import Device
from clsplat.frame.draw import on_tiles
from clsplat.frame.lens import Warp
from clsplat.frame.strips import strips
from clsplat.gaussians import Gaussians
from clsplat.layouts.columns import DEEP_PICTURES, TILE
from clsplat.rendering.renderer import Renderer
from clsplat.stages.deep import DEEP_FLOATS
from clsplat.stages.deep_merge import deep_merge, merge_bytes

DrawDeep = Callable[[Camera], Float32]
"""Function that takes a camera and returns the planes of its deep picture, which may be a view of another array."""
Convert = Callable[[Float32, Float32], Float32]
"""Function from premultiplied rgb (h, w, 3) and its alpha (h, w) to rgb in another colour space."""
Weighted = tuple[Float32, Float32]
"""Planes of a deep picture, and weights (H, W) of its pixels."""
_MERGE_MEMORY_DIVISOR = 16
"""A merge may use the device's memory limit divided by this. Rendering uses the rest."""
_WARP_BATCH_PIXELS = 1 << 14
"""Number of pixels that are warped at a time, which limits the memory on the host."""


def render_deep(renderer: Renderer, gaussians: Gaussians, camera: Camera, bins: int) -> Float32:
    """Render the slices (bins, H, W, DEEP_FLOATS) of a camera's picture by depth. The camera may have a window.

    bins: maximum number of slices per pixel.
    """
    larger, rows, columns = on_tiles(camera)
    return renderer.render_deep(gaussians, larger, bins)[:, rows, columns]


def drawn_in_slices(renderer: Renderer, gaussians: Callable[[], Gaussians], bins: int) -> DrawDeep:
    """Return a function (`DrawDeep`) that renders deep pictures with the kernels.

    gaussians: function that returns the model; it is called only when the picture is drawn.
    bins: maximum number of slices per pixel.
    """
    return lambda camera: render_deep(renderer, gaussians(), camera, bins).transpose(0, 3, 1, 2)


def deep_in_strips(draw: DrawDeep, rows: Callable[[Camera], int]) -> DrawDeep:
    """Return a function (`DrawDeep`) that renders a deep picture with `draw`, strip by strip.

    rows: function from a camera to the number of rows of a strip.
    """
    return lambda camera: np.concatenate([draw(strip) for strip in strips(camera, rows(camera))], axis=2)


def deep_converted(draw: DrawDeep, convert: Convert) -> DrawDeep:
    """Return a function (`DrawDeep`) that converts the colours of the pictures of `draw` to another colour space."""

    def drawn(camera: Camera) -> Float32:
        planes = np.array(draw(camera))
        alpha = planes[:, 3]
        there = alpha > 0
        # one plane at a time, which takes a quarter less time than a mask over three planes
        rgb = np.stack([planes[:, channel][there] for channel in range(3)], axis=1)
        converted = convert(rgb[None], alpha[there][None])[0]
        for channel in range(3):
            planes[:, channel][there] = converted[:, channel]
        return planes

    return drawn


class Merge:
    """Weighted mean of deep pictures on the device, with weights for each pixel. Colours must be linear.

    bins: maximum number of slices per pixel.
    """

    def __init__(self, device: Device, bins: int) -> None:
        self.bins, self._device, self._work = bins, device, Workspace(device)
        limit = min(device.budget // _MERGE_MEMORY_DIVISOR, device.max_allocation, 4 * DEEP_MERGE_FLOATS)
        self._pixels = max(limit // merge_bytes(DEEP_PICTURES, bins), TILE)

    def __call__(self, pictures: Iterable[Weighted]) -> Float32:
        """Merge one or more pictures into their weighted mean. For each pixel the sum of weights must be 1.

        To limit memory, groups of pictures are merged first, and then the means of the groups.
        """
        groups = list(self._groups(pictures))
        return groups[0][0] if len(groups) == 1 else self(groups)

    def _groups(self, pictures: Iterable[Weighted]) -> Iterator[Weighted]:
        waiting = iter(pictures)
        while group := list(islice(waiting, DEEP_PICTURES)):
            whole = reduce(np.add, (weights for _, weights in group))
            yield self._merged(group, np.where(whole > 0, whole, 1)), whole

    def _merged(self, group: Sequence[Weighted], whole: Float32) -> Float32:
        height, width = whole.shape
        planes = np.empty((self.bins, DEEP_FLOATS, height * width), np.float32)
        pictures = [picture.reshape(self.bins, DEEP_FLOATS, -1) for picture, _ in group]
        weights = np.stack([(weight / whole).ravel() for _, weight in group])
        for first in range(0, height * width, self._pixels):
            some = slice(first, first + self._pixels)
            together = np.stack([picture[:, :, some] for picture in pictures])
            arrays = (upload(self._device, together), upload(self._device, np.ascontiguousarray(weights[:, some])))
            planes[:, :, some] = deep_merge(self._device, self._work, *arrays).get()
        return planes.reshape(self.bins, DEEP_FLOATS, height, width)


def deep_sampled(draws: Sequence[DrawDeep], cameras: Sequence[Camera], merge: Merge) -> DrawDeep:
    """Return a function (`DrawDeep`) that renders the mean of deep pictures over samples of shutter and lens.

    The returned function uses only size and window of its camera.

    draws, cameras: for each sample, the function that renders it (`DrawDeep`) and its camera of the whole frame.
    """

    def blurred(camera: Camera) -> Float32:
        weight = np.full((camera.height, camera.width), 1 / len(cameras), np.float32)
        drawn = (draw(sample.reframed(camera)) for draw, sample in zip(draws, cameras, strict=True))
        return merge((planes, weight) for planes in drawn)

    return blurred


def deep_warped(draw: DrawDeep, warp: Warp, merge: Merge) -> DrawDeep:
    """Return a function (`DrawDeep`) that renders warped deep pictures.

    The returned function uses only size and window of its camera. A pixel is the mean of slices at `Warp.samples` x
    `Warp.samples` positions. Interpolation is bilinear, because the negative weights of a cubic filter would give
    invalid slices. Pixels in which nothing is visible have no slices.
    """

    def bent(camera: Camera) -> Float32:
        places, window = warp.of_window(camera)
        if window is None or window.window is None:
            return np.zeros((merge.bins, DEEP_FLOATS, camera.height, camera.width), np.float32)
        straight, samples = draw(window), warp.samples
        at = (places - (window.window.x, window.window.y)).reshape(camera.height, samples, camera.width, samples, 2)
        step = max(_WARP_BATCH_PIXELS // camera.width, 1)
        parts = [merge(_around(straight, at[top : top + step])) for top in range(0, camera.height, step)]
        return np.concatenate(parts, axis=2)

    return bent


def _around(straight: Float32, places: Float64) -> Iterator[Weighted]:
    """Yield pictures (h, w) with weights: the four pixels around each sample's position, one picture for each of them.

    The weights are bilinear, divided by the number of samples in a pixel.

    straight: planes of the undistorted picture.
    places: positions (h, samples, w, samples, 2) in this picture, NaN where nothing is visible.
    """
    height, width = straight.shape[2:]
    samples = places.shape[1]
    for down, across in np.ndindex(samples, samples):
        place = places[:, down, :, across] - 0.5
        there = ~np.isnan(place[..., 0])
        first = np.floor(np.where(there[..., None], place, 0)).astype(np.int64)
        part = np.where(there[..., None], place, 0) - first
        for y, x in np.ndindex(2, 2):
            rows, columns = np.clip(first[..., 1] + y, 0, height - 1), np.clip(first[..., 0] + x, 0, width - 1)
            planes = straight[:, :, rows, columns]
            planes[:, :, ~there] = 0
            share = np.where(y, part[..., 1], 1 - part[..., 1]) * np.where(x, part[..., 0], 1 - part[..., 0])
            yield planes, (share / samples**2).astype(np.float32)
