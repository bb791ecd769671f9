# SPDX-License-Identifier: Apache-2.0
"""Lists of the tiles that projected Gaussians reach, by the conventions of gsplat's functions of these names."""

from __future__ import annotations

from math import prod

import numpy as np
from numpy.typing import ArrayLike, NDArray

from clsplat.errors import InputError
from clsplat.library.checks import floats, whole

DEPTH_BITS = 32
"""Low bits of an id: those of the depth as a float32."""


def isect_tiles(
    means2d: ArrayLike,
    radii: ArrayLike,
    depths: ArrayLike,
    tile_size: int,
    tile_width: int,
    tile_height: int,
    sort: bool = True,
    *,
    image_ids: ArrayLike | None = None,
    n_images: int | None = None,
) -> tuple[NDArray[np.int32], NDArray[np.int64], NDArray[np.int32]]:
    """Pairs of a tile and a Gaussian whose box, its mean plus and minus the radii, overlaps the tile.

    means2d (..., N, 2) and radii (..., N, 2) in pixels, depths (..., N): of each image; packed: (M, 2), (M, 2), (M,)
    with image_ids (M,), and n_images of them. tile_size: the side of a tile in pixels; tile_width, tile_height: tiles
    across and down. Returns tiles_per_gauss (..., N) or (M,) int32, 0 where a radius is not over 0; isect_ids (pairs,)
    int64: the image, the tile in row-major order and the bits of the depth, from the high bits down; flatten_ids
    (pairs,) int32: the Gaussian among those of all images. By image, tile and depth, ties by Gaussian, unless `sort` is
    off: then by Gaussian. Raises InputError for other shapes.
    """
    means = floats("means2d", means2d, ("N", 2), *_batched("N", 2, of=means2d))
    count = means.shape[:-1]
    reach = floats("radii", radii, (*count, 2)).reshape(-1, 2)
    depth = np.ascontiguousarray(floats("depths", depths, count).reshape(-1))
    tile_size, tile_width, tile_height = _lengths(tile_size=tile_size, tile_width=tile_width, tile_height=tile_height)
    images, image = _images(count, image_ids, None if n_images is None else whole(n_images))

    most = np.array([tile_width, tile_height])
    middle, side = means.reshape(-1, 2) / np.float32(tile_size), reach / np.float32(tile_size)
    low = np.clip(np.floor(middle - side), 0, most).astype(np.int64)
    high = np.clip(np.ceil(middle + side), 0, most).astype(np.int64)
    sides = (high - low) * (reach > 0).all(axis=1, keepdims=True)
    counts = sides.prod(axis=1)

    owner = np.repeat(np.arange(len(counts)), counts)
    within = np.arange(len(owner)) - np.repeat(np.cumsum(counts) - counts, counts)
    across = sides[owner, 0]
    tile = (
        (low[owner, 1] + within // np.maximum(across, 1)) * tile_width + low[owner, 0] + within % np.maximum(across, 1)
    )
    tile_bits = (tile_width * tile_height).bit_length()
    if images.bit_length() + tile_bits + DEPTH_BITS > 64:
        raise InputError(f"{images} images of {tile_width} x {tile_height} tiles: ids have 64 bits, expected fewer")
    ids = (
        (image[owner] << (tile_bits + DEPTH_BITS))
        | (tile << DEPTH_BITS)
        | depth.view(np.uint32).astype(np.int64)[owner]
    )
    if sort:
        order = np.argsort(ids, kind="stable")
        ids, owner = ids[order], owner[order]
    return counts.reshape(count).astype(np.int32), ids, owner.astype(np.int32)


def isect_offset_encode(isect_ids: ArrayLike, n_images: int, tile_width: int, tile_height: int) -> NDArray[np.int32]:
    """Places in sorted ids of `isect_tiles` where each tile's begin, (n_images, tile_height, tile_width) int32. Raises
    InputError for ids of other images or tiles."""
    n_images, tile_width, tile_height = _lengths(n_images=n_images, tile_width=tile_width, tile_height=tile_height)
    ids, tiles = np.asarray(isect_ids), tile_width * tile_height
    if ids.ndim != 1 or ids.dtype.kind not in "iu":
        raise InputError(f"isect_ids: got {ids.dtype} of shape {ids.shape}, expected integers (pairs,)")
    keys = ids.astype(np.int64) >> DEPTH_BITS
    bits = tiles.bit_length()
    image, tile = keys >> bits, keys & ((1 << bits) - 1)
    if len(keys) and (int(image.max()) >= n_images or int(image.min()) < 0 or int(tile.max()) >= tiles):
        raise InputError(f"isect_ids: of images or tiles beyond {n_images} of {tile_width} x {tile_height}")
    counts = np.bincount(image * tiles + tile, minlength=n_images * tiles)
    return (np.cumsum(counts) - counts).astype(np.int32).reshape(n_images, tile_height, tile_width)


def _lengths(**given: int) -> list[int]:
    """Arguments as whole numbers. Raises InputError where one is none, or below 1."""
    found = [whole(value) for value in given.values()]
    lengths = [length for length in found if length is not None and length >= 1]
    if len(lengths) < len(found):
        raise InputError(f"{', '.join(given)}: got {', '.join(map(str, given.values()))}, expected 1 up")
    return lengths


def _batched(*row: int | str, of: ArrayLike) -> list[tuple[int | str, ...]]:
    """The shape of rows with the leading axes that an array has."""
    more = max(np.ndim(of) - len(row), 0)
    return [(*(f"axis {axis}" for axis in range(more)), *row)]


def _images(count: tuple[int, ...], image_ids: ArrayLike | None, n_images: int | None) -> tuple[int, NDArray[np.int64]]:
    """How many images there are, and the one of each Gaussian. Raises InputError."""
    if image_ids is None:
        images = prod(count[:-1])
        return images, np.repeat(np.arange(images), count[-1])
    given = np.asarray(image_ids)
    if given.shape != count or len(count) != 1 or given.dtype.kind not in "iu":
        raise InputError(
            f"image_ids: got {given.dtype} of shape {given.shape}, expected integers {count} of packed arrays"
        )
    if n_images is None or (len(given) and not 0 <= int(given.min()) <= int(given.max()) < n_images):
        raise InputError(f"image_ids: expected to be below n_images, which is {n_images}")
    return n_images, given.astype(np.int64)
