# SPDX-License-Identifier: Apache-2.0
"""Lists of the tiles that projected Gaussians reach: functions with the names and conventions of gsplat's."""

from __future__ import annotations

from math import prod

import numpy as np
from numpy.typing import ArrayLike, NDArray

from clsplat.arrays import Float32, Int64
from clsplat.errors import InputError
from clsplat.library.checks import floats, whole

ISECT_ID_DEPTH_BITS = 32
"""Number of low bits of an id, which hold the depth as a float32."""


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
    """List the (tile, Gaussian) pairs in which the tile overlaps the Gaussian's bounding box, mean +- radii.

    Parameters
    ----------
    means2d, radii : (..., N, 2) array_like
        Pixels. Packed arrays, with one axis for the Gaussians of all images, are (M, 2).
    depths : (..., N) array_like
        Depths by which pairs are sorted. Packed: (M,).
    tile_size : int
        Side of a tile in pixels.
    tile_width, tile_height : int
        Number of tiles across and down.
    sort : bool
        Sort pairs by image, tile and depth, ties by Gaussian. If False, pairs are in the order of the Gaussians.
    image_ids : (M,) array_like of int, optional
        Image of each Gaussian, for packed arrays.
    n_images : int, optional
        Number of images, for packed arrays.

    Returns
    -------
    tiles_per_gauss : (..., N) or (M,) int32
        Number of tiles of each Gaussian; 0 if one of its radii is not above 0.
    isect_ids : (pairs,) int64
        From high to low bits: the image, the tile in row-major order, and the 32 bits of the depth.
    flatten_ids : (pairs,) int32
        Index of the Gaussian, counted over all images.

    Raises
    ------
    InputError
        If a shape is wrong, or the ids do not fit into 64 bits.

    Notes
    -----
    Kerbl et al. 2023, section 6; gsplat 1.5.3's function of this name.
    """
    means = floats("means2d", means2d, ("N", 2), *_batched("N", 2, of=means2d))
    count = means.shape[:-1]
    reach = floats("radii", radii, (*count, 2)).reshape(-1, 2)
    depth = np.ascontiguousarray(floats("depths", depths, count).reshape(-1))
    tile_size, tile_width, tile_height = _lengths(tile_size=tile_size, tile_width=tile_width, tile_height=tile_height)
    images, image = _images(count, image_ids, None if n_images is None else whole(n_images))
    counts, owner, tile = _tiles_of_boxes(means.reshape(-1, 2), reach, tile_size, (tile_width, tile_height))
    ids = _packed(image[owner], tile, depth[owner], images, (tile_width, tile_height))
    order = np.argsort(ids, kind="stable") if sort else slice(None)
    return counts.reshape(count).astype(np.int32), ids[order], owner[order].astype(np.int32)


def _tiles_of_boxes(
    means: Float32, reach: Float32, tile_size: int, tiles: tuple[int, int]
) -> tuple[Int64, Int64, Int64]:
    """Return the number of tiles in each Gaussian's bounding box (n,), then Gaussian and tile of each pair (pairs,).

    means, reach: (n, 2), middles and half sides of the boxes, in pixels.
    tiles: number of tiles across and down.
    """
    middle, side = means / np.float32(tile_size), reach / np.float32(tile_size)
    low = np.clip(np.floor(middle - side), 0, np.array(tiles)).astype(np.int64)
    high = np.clip(np.ceil(middle + side), 0, np.array(tiles)).astype(np.int64)
    sides = (high - low) * (reach > 0).all(axis=1, keepdims=True)
    counts = sides.prod(axis=1)
    owner = np.repeat(np.arange(len(counts)), counts)
    within = np.arange(len(owner)) - np.repeat(np.cumsum(counts) - counts, counts)
    across = np.maximum(sides[owner, 0], 1)
    return counts, owner, (low[owner, 1] + within // across) * tiles[0] + low[owner, 0] + within % across


def _packed(image: Int64, tile: Int64, depth: Float32, images: int, tiles: tuple[int, int]) -> Int64:
    """Return the ids of pairs from their images, tiles and depths, (pairs,) each. Raises InputError if they do not fit.

    images: number of images. tiles: number of tiles across and down.
    """
    tile_bits = prod(tiles).bit_length()
    if images.bit_length() + tile_bits + ISECT_ID_DEPTH_BITS > 64:
        raise InputError(f"{images} images of {tiles[0]} x {tiles[1]} tiles do not fit in 64-bit ids, expected fewer")
    return (((image << tile_bits) | tile) << ISECT_ID_DEPTH_BITS) | depth.view(np.uint32).astype(np.int64)


def isect_offset_encode(isect_ids: ArrayLike, n_images: int, tile_width: int, tile_height: int) -> NDArray[np.int32]:
    """Find the start of each tile's list in the sorted ids of `isect_tiles`.

    Parameters
    ----------
    isect_ids : (pairs,) array_like of int
        Sorted ids of `isect_tiles`.
    n_images : int
        Number of images.
    tile_width, tile_height : int
        Number of tiles across and down.

    Returns
    -------
    (n_images, tile_height, tile_width) int32
        Index of the first id of each tile.

    Raises
    ------
    InputError
        If an id names an image that is not below `n_images`, or a tile outside `tile_width` x `tile_height`.
    """
    n_images, tile_width, tile_height = _lengths(n_images=n_images, tile_width=tile_width, tile_height=tile_height)
    ids, tiles = np.asarray(isect_ids), tile_width * tile_height
    if ids.ndim != 1 or ids.dtype.kind not in "iu":
        raise InputError(f"isect_ids: got {ids.dtype} of shape {ids.shape}, expected integers (pairs,)")
    keys = ids.astype(np.int64) >> ISECT_ID_DEPTH_BITS
    bits = tiles.bit_length()
    image, tile = keys >> bits, keys & ((1 << bits) - 1)
    if len(keys) and (int(image.max()) >= n_images or int(image.min()) < 0 or int(tile.max()) >= tiles):
        raise InputError(
            f"isect_ids: found ids beyond the {n_images} images of {tile_width} x {tile_height} tiles, expected ids "
            "that isect_tiles returns for these numbers"
        )
    counts = np.bincount(image * tiles + tile, minlength=n_images * tiles)
    return (np.cumsum(counts) - counts).astype(np.int32).reshape(n_images, tile_height, tile_width)


def _lengths(**given: int) -> list[int]:
    """Return the arguments' values as integers. Raises InputError unless all are integers of at least 1."""
    found = [whole(value) for value in given.values()]
    lengths = [length for length in found if length is not None and length >= 1]
    if len(lengths) < len(found):
        raise InputError(f"{', '.join(given)}: got {', '.join(map(str, given.values()))}, expected at least 1 for each")
    return lengths


def _batched(*row: int | str, of: ArrayLike) -> list[tuple[int | str, ...]]:
    """Return the shape that an array must have: the leading axes of the array `of`, of any size, then the sizes `row`.

    The result is a list of one shape, for the arguments of `checks.floats`.
    """
    more = max(np.ndim(of) - len(row), 0)
    return [(*(f"axis {axis}" for axis in range(more)), *row)]


def _images(count: tuple[int, ...], image_ids: ArrayLike | None, n_images: int | None) -> tuple[int, NDArray[np.int64]]:
    """Return the number of images, and the image of each Gaussian. Raises InputError.

    count: leading sizes of the arrays: (..., N), or (M,) for packed arrays, which require image_ids and n_images.
    """
    if image_ids is None:
        images = prod(count[:-1])
        return images, np.repeat(np.arange(images), count[-1])
    given = np.asarray(image_ids)
    if given.shape != count or len(count) != 1 or given.dtype.kind not in "iu":
        raise InputError(
            f"image_ids: got {given.dtype} of shape {given.shape}, expected integers of shape {count} for packed arrays"
        )
    if n_images is None:
        raise InputError("n_images is None, expected the number of images that image_ids refer to")
    if len(given) and not 0 <= int(given.min()) <= int(given.max()) < n_images:
        raise InputError(f"image_ids: got {given.min()} to {given.max()}, expected 0 to below n_images = {n_images}")
    return n_images, given.astype(np.int64)
