# SPDX-License-Identifier: Apache-2.0
"""Pixels of projected Gaussians in lists that are given, by the conventions of gsplat's `rasterize_to_pixels`."""

from __future__ import annotations

from dataclasses import dataclass
from math import prod

import numpy as np
from numpy.typing import ArrayLike, NDArray

from clsplat.arrays import Float32, Int64
from clsplat.device.buffers import Workspace, from_host, upload
from clsplat.device.context import Device
from clsplat.device.layout import TILE
from clsplat.errors import InputError
from clsplat.library.checks import floats, gradient, number, whole
from clsplat.library.pixels import Listed, ListedPixels
from clsplat.library.session import Session, session_of
from clsplat.rendering.build_flags import ALPHA_MAX
from clsplat.stages.duplicate import Band
from clsplat.stages.project import Projected
from clsplat.stages.ranges import TileLists
from clsplat.stages.splats import ScreenGaussians, splats


@dataclass(frozen=True, eq=False)
class RasterizedPixels:
    """colors (..., H, W, D) and alphas (..., H, W, 1) of as many images as there are lists."""

    colors: Float32
    alphas: Float32
    _views: tuple[tuple[slice, ListedPixels], ...]
    _batch: tuple[int, ...]

    def vjp(
        self, colors: ArrayLike | None = None, alphas: ArrayLike | None = None, *, absolute: bool = False
    ) -> dict[str, Float32]:
        """The vector-Jacobian product: gradients by `means2d`, `conics`, `colors`, `opacities`, and `backgrounds` where
        there are some, each of its argument's shape; with `absolute`, of the shape of means2d: sums of the absolute
        values of every pixel's gradient by them, if asked for.

        colors, alphas: the gradients by these, None for 0. Raises InputError for other shapes.
        """
        given = gradient("colors", colors, self.colors.shape)
        by_colors = np.zeros_like(self.colors) if given is None else given
        by_alphas = gradient("alphas", alphas, self.alphas.shape)
        height, width, depth = self.colors.shape[-3:]
        by_colors = by_colors.reshape(-1, height, width, depth)
        by_alphas = None if by_alphas is None else by_alphas.reshape(-1, height, width)
        rows = prod(self._batch)
        tails: dict[str, tuple[int, ...]] = {"means2d": (2,), "conics": (3,), "colors": (depth,), "opacities": ()}
        tails |= {"absolute": (2,)} if absolute else {}
        sums = {name: np.zeros((rows, *tail), np.float32) for name, tail in tails.items()}
        backgrounds = []
        for index, (own, pixels) in enumerate(self._views):
            d_alpha = None if by_alphas is None else by_alphas[index]
            found = pixels.gradient(by_colors[index], d_alpha, absolute=absolute)
            for name, array in sums.items():
                array[own] += found["colours" if name == "colors" else name]
            backgrounds += [found["background"]] if "background" in found else []
        result = {name: array.reshape(*self._batch, *tails[name]) for name, array in sums.items()}
        if backgrounds:
            result["backgrounds"] = np.stack(backgrounds).reshape(*self.colors.shape[:-3], depth)
        return result


def rasterize_to_pixels(
    means2d: ArrayLike,
    conics: ArrayLike,
    colors: ArrayLike,
    opacities: ArrayLike,
    image_width: int,
    image_height: int,
    tile_size: int,
    isect_offsets: ArrayLike,
    flatten_ids: ArrayLike,
    backgrounds: ArrayLike | None = None,
    masks: ArrayLike | None = None,
    *,
    alpha_max: float = ALPHA_MAX,
    device: Device | str | None = None,
) -> RasterizedPixels:
    """Blend projected Gaussians in the lists of `isect_tiles`.

    means2d (..., N, 2) in pixels, the first pixel's middle at 0.5; conics (..., N, 3): a, b, c of the inverse
    covariance; colors (..., N, D), D of at least 1; opacities (..., N) in [0, 1]; or packed, (M, 2) and so on.
    tile_size: 16; isect_offsets (..., tile_height, tile_width), where each tile's list begins in flatten_ids (pairs,),
    the numbers of Gaussians among those of all images, front to back; backgrounds (..., D), None for black; masks
    (..., tile_height, tile_width): a tile where it is false has the background alone; alpha_max: the cap of alpha;
    device: one that is open, or its name (see `clsplat devices`).

    Raises InputError, which names the argument, for another tile size, shape or number.
    """
    means = floats("means2d", means2d, *_shapes_of(means2d, 2))
    batch = means.shape[:-1]
    shape_conics = floats("conics", conics, (*batch, 3)).reshape(-1, 3)
    values = floats("colors", colors, (*batch, "D"))
    depth, opacity = values.shape[-1], floats("opacities", opacities, batch).reshape(-1)
    if depth < 1:
        raise InputError(f"colors: have {depth} channels, expected 1 or more")
    if whole(tile_size) != TILE:
        raise InputError(f"tile_size: got {tile_size}, expected {TILE}, which the kernels are made for")
    size = whole(image_width) or 0, whole(image_height) or 0
    if min(size) < 1:
        raise InputError(f"image_width, image_height: got {image_width} x {image_height}, expected 1 x 1 up")
    image_width, image_height = size
    alpha_max = number("alpha_max", alpha_max, 0)
    if not 0 < alpha_max < 1:
        raise InputError(f"alpha_max: got {alpha_max}, expected between 0 and 1")
    tiles = (-(-image_height // TILE), -(-image_width // TILE))
    offsets, ids = _lists(isect_offsets, flatten_ids, tiles, prod(batch))
    images = offsets.shape[:-2]
    if len(batch) > 1 and batch[:-1] != images:
        raise InputError(f"isect_offsets: of images {images}, expected {batch[:-1]} as of means2d")
    behind = None if backgrounds is None else floats("backgrounds", backgrounds, (*images, depth)).reshape(-1, depth)
    shown = _masks(masks, offsets.shape)

    session, flat = session_of(device), (means.reshape(-1, 2), shape_conics, values.reshape(-1, depth), opacity)
    starts = np.append(offsets.reshape(-1), len(ids)).reshape(-1)
    views = []
    for image in range(prod(images)):
        of_image = slice(image * prod(tiles), (image + 1) * prod(tiles) + 1)
        begin, counts, listed = _list_of(starts[of_image], ids, shown[image])
        own = _own_of(listed, batch, image)
        arrays = tuple(array[own] for array in flat)
        background = None if behind is None else behind[image]
        size = (image_width, image_height)
        pixels = _pixels(session, arrays, (begin, counts, listed - own.start), size, background, alpha_max)
        views.append((own, pixels))
    shape = (*images, image_height, image_width)
    pictures = np.stack([pixels.image for _, pixels in views]) if views else np.zeros(0, np.float32)
    alphas = np.stack([pixels.alpha for _, pixels in views]) if views else np.zeros(0, np.float32)
    return RasterizedPixels(pictures.reshape(*shape, depth), alphas.reshape(*shape, 1), tuple(views), batch)


def _pixels(
    session: Session,
    arrays: tuple[Float32, ...],
    lists: tuple[Int64, Int64, Int64],
    size: tuple[int, int],
    background: Float32 | None,
    alpha_max: float,
) -> ListedPixels:
    """The pixels of one image; lists: where each tile's begins, how many it has, and the Gaussians."""
    means, conics, values, opacities = arrays
    begin, counts, listed = lists
    with session.lock:
        device, n = session.device, len(means)
        on_device = [from_host(device, array) for array in (means, conics, opacities, opacities, values)]
        gaussians = ScreenGaussians(from_host(device, np.ones((n, 2), np.int32)), *on_device)

        def listing(work: Workspace) -> Listed:
            drawn = splats(device, work, gaussians, *size, listed=True)
            by_gaussian = np.bincount(listed, minlength=n)
            slots = np.empty(len(listed), np.uint32)
            slots[np.argsort(listed, kind="stable")] = np.arange(len(listed), dtype=np.uint32)
            ranges = np.stack([begin, begin + counts], axis=1)
            tile_counts, first_slots = by_gaussian, np.cumsum(by_gaussian) - by_gaussian
            words = (np.ascontiguousarray(of, np.uint32) for of in (ranges, listed, slots, tile_counts, first_slots))
            ranges_, listed_, slots_, counts_, first_ = (upload(device, word) for word in words)
            lists = TileLists(Band(0, len(begin)), ranges_, listed_, slots_)
            return Listed(Projected(drawn.splats, counts_), lists, first_)

        return ListedPixels(session, gaussians, listing, size, background, alpha_max, backward=True)


def _shapes_of(values: ArrayLike, last: int) -> list[tuple[int | str, ...]]:
    """The shape (..., N, last) with as many axes as the array has."""
    return [(*(f"axis {axis}" for axis in range(max(np.ndim(values) - 1, 1))), last)]


def _lists(isect_offsets: ArrayLike, flatten_ids: ArrayLike, tiles: tuple[int, int], count: int) -> tuple[Int64, Int64]:
    """The lists as integers. Raises InputError for what is none of so many tiles and Gaussians."""
    offsets, ids = np.asarray(isect_offsets), np.asarray(flatten_ids)
    if offsets.ndim < 2 or offsets.shape[-2:] != tiles or offsets.dtype.kind not in "iu":
        wanted = f"integers (..., {tiles[0]}, {tiles[1]})"
        raise InputError(f"isect_offsets: got {offsets.dtype} of shape {offsets.shape}, expected {wanted}")
    if ids.ndim != 1 or ids.dtype.kind not in "iu":
        raise InputError(f"flatten_ids: got {ids.dtype} of shape {ids.shape}, expected integers (pairs,)")
    if len(ids) and not 0 <= int(ids.min()) <= int(ids.max()) < count:
        raise InputError(f"flatten_ids: from {ids.min()} to {ids.max()}, expected 0 to {count - 1}, as of means2d")
    steps = np.diff(np.concatenate([[0], offsets.reshape(-1).astype(np.int64), [len(ids)]]))
    if (steps < 0).any():
        raise InputError(f"isect_offsets: expected numbers that do not fall, from 0 to the {len(ids)} pairs")
    return offsets.astype(np.int64), ids.astype(np.int64)


def _masks(masks: ArrayLike | None, shape: tuple[int, ...]) -> NDArray[np.bool_]:
    """(images, tiles): which tiles are drawn. Raises InputError."""
    tiles = prod(shape[-2:])
    if masks is None:
        return np.ones((prod(shape[:-2]), tiles), np.bool_)
    given = np.asarray(masks)
    if given.shape != shape or given.dtype != np.bool_:
        raise InputError(f"masks: got {given.dtype} of shape {given.shape}, expected bool of {shape}")
    return given.reshape(-1, tiles)


def _list_of(starts: Int64, ids: Int64, shown: NDArray[np.bool_]) -> tuple[Int64, Int64, Int64]:
    """Where the lists of one image's tiles begin in its own, how many they have, and the Gaussians in them."""
    counts, listed = np.diff(starts), ids[starts[0] : starts[-1]]
    if not shown.all():
        listed = listed[np.repeat(shown, counts)]
        counts = np.where(shown, counts, 0)
    return np.cumsum(counts) - counts, counts, listed


def _own_of(listed: Int64, batch: tuple[int, ...], image: int) -> slice:
    """The rows of one image's Gaussians: its own axis, or of packed arrays as far as its lists reach."""
    if len(batch) > 1:
        return slice(image * batch[-1], (image + 1) * batch[-1])
    return slice(int(listed.min()), int(listed.max()) + 1) if len(listed) else slice(0, 0)
