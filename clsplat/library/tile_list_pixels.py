# SPDX-License-Identifier: Apache-2.0
"""Pixels from given tile lists of projected Gaussians, with the conventions of gsplat's `rasterize_to_pixels`."""

from __future__ import annotations

from dataclasses import dataclass
from math import prod

import numpy as np
from numpy.typing import ArrayLike, NDArray

from clsplat.arrays import Float32, Int64
from clsplat.device.buffers import Workspace, from_host, upload
from clsplat.device.context import Device
from clsplat.errors import InputError
from clsplat.layouts.columns import TILE
from clsplat.library.checks import floats, gradient, number, whole
from clsplat.library.pixels import Listed, ListedPixels
from clsplat.library.session import LibrarySession, session_of
from clsplat.rendering.build_flags import DEFAULT_ALPHA_MAX
from clsplat.stages.duplicate import Band
from clsplat.stages.project import Projected
from clsplat.stages.ranges import TileLists
from clsplat.stages.scan import Elements
from clsplat.stages.splats import ScreenGaussians, splats


@dataclass(frozen=True, eq=False)
class RasterizedPixels:
    """Images blended by `rasterize_to_pixels`.

    Attributes
    ----------
    colors : (..., H, W, D) float32
        Colours over the background.
    alphas : (..., H, W, 1) float32
        0 to 1.
    """

    colors: Float32
    alphas: Float32
    _views: tuple[tuple[slice, ListedPixels], ...]
    _batch: tuple[int, ...]

    def vjp(
        self, colors: ArrayLike | None = None, alphas: ArrayLike | None = None, *, absolute: bool = False
    ) -> dict[str, Float32]:
        """Compute the vector-Jacobian product.

        Parameters
        ----------
        colors, alphas : array_like, optional
            Gradients of the loss with respect to the attributes of these names. None means 0.
        absolute : bool
            Also compute sums over pixels of the absolute gradients with respect to means2d.

        Returns
        -------
        dict
            float32 gradients in the arguments' shapes: "means2d", "conics", "colors", "opacities", and "backgrounds" if
            they were given. With `absolute` also "absolute", in the shape of means2d.

        Raises
        ------
        InputError
            If a shape is wrong.
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
    alpha_max: float = DEFAULT_ALPHA_MAX,
    device: Device | str | None = None,
) -> RasterizedPixels:
    """Blend projected Gaussians in the tile lists of `isect_tiles`.

    Parameters
    ----------
    means2d : (..., N, 2) array_like
        Pixels; the first pixel's centre is at 0.5. In packed arrays, here and below, M replaces "..., N": they list the
        Gaussians of all images one after the other.
    conics : (..., N, 3) array_like
        a, b, c of the inverse covariance, 1 / px^2.
    colors : (..., N, D) array_like
        D at least 1.
    opacities : (..., N) array_like
        0 to 1.
    image_width, image_height : int
        Pixels.
    tile_size : int
        16, the only size that the kernels support.
    isect_offsets : (..., tile_height, tile_width) array_like of int
        Start of each tile's list in flatten_ids.
    flatten_ids : (pairs,) array_like of int
        Indices of Gaussians, counted over all images. In each list they are front to back.
    backgrounds : (..., D) array_like, optional
        Black if None.
    masks : (..., tile_height, tile_width) array_like of bool, optional
        Tiles that are False show only the background.
    alpha_max : float
        Maximum of a Gaussian's alpha at a pixel, between 0 and 1.
    device : Device or str, optional
        An open device, or a name as `clsplat devices` lists them.

    Returns
    -------
    RasterizedPixels
        The images, with their `vjp`.

    Raises
    ------
    InputError
        If the tile size, a shape or a number is wrong. The message names the argument.
    DeviceError
        If there is no such device.

    Notes
    -----
    Kerbl et al. 2023; conventions of gsplat 1.5.3.
    """
    given = _GivenSplats.checked(means2d, conics, colors, opacities)
    size = _checked_size(tile_size, image_width, image_height)
    cap = number("alpha_max", alpha_max, 0)
    if not 0 < cap < 1:
        raise InputError(f"alpha_max: got {cap}, expected between 0 and 1")
    lists = _GivenLists.checked(isect_offsets, flatten_ids, size, given.batch)
    behind = None
    if backgrounds is not None:
        behind = floats("backgrounds", backgrounds, (*lists.images, given.depth)).reshape(-1, given.depth)
    shown = _masks(masks, lists.offsets.shape)
    session, views = session_of(device), []
    for image in range(prod(lists.images)):
        listed = lists.of_image(image, shown[image])
        own = _own_of(listed.gaussians, given.batch, image)
        background = None if behind is None else behind[image]
        views.append((own, _pixels(session, given.rows(own), listed.from_row(own.start), size, background, cap)))
    shape = (*lists.images, size[1], size[0])
    pictures = np.stack([pixels.image for _, pixels in views]) if views else np.zeros(0, np.float32)
    alphas = np.stack([pixels.alpha for _, pixels in views]) if views else np.zeros(0, np.float32)
    return RasterizedPixels(pictures.reshape(*shape, given.depth), alphas.reshape(*shape, 1), tuple(views), given.batch)


@dataclass(frozen=True, eq=False)
class _GivenSplats:
    """Checked splats of all images, with the leading axes of each array flattened to one axis of rows.

    batch: the sizes of these axes, (..., N), or (M,) for packed arrays.
    """

    batch: tuple[int, ...]
    means2d: Float32
    conics: Float32
    colors: Float32
    opacities: Float32

    @classmethod
    def checked(cls, means2d: ArrayLike, conics: ArrayLike, colors: ArrayLike, opacities: ArrayLike) -> _GivenSplats:
        """Check the splats of a call of `rasterize_to_pixels`. Raises InputError, which names the argument."""
        means = floats("means2d", means2d, *_shapes_of(means2d, 2))
        batch = means.shape[:-1]
        shapes = floats("conics", conics, (*batch, 3)).reshape(-1, 3)
        values = floats("colors", colors, (*batch, "D"))
        covers = floats("opacities", opacities, batch).reshape(-1)
        if (depth := values.shape[-1]) < 1:
            raise InputError(f"colors has {depth} channels, expected 1 or more")
        return cls(batch, means.reshape(-1, 2), shapes, values.reshape(-1, depth), covers)

    @property
    def depth(self) -> int:
        """Number D of a splat's colour channels."""
        return int(self.colors.shape[1])

    def rows(self, own: slice) -> _GivenSplats:
        """Return the splats of one image. own: the rows of these splats."""
        arrays = (self.means2d[own], self.conics[own], self.colors[own], self.opacities[own])
        return _GivenSplats((len(arrays[0]),), *arrays)


@dataclass(frozen=True, eq=False)
class _ImageLists:
    """The tile lists of an image.

    begins, counts: start and length of each list in `gaussians`.
    gaussians: rows of the listed Gaussians, one list after the other.
    """

    begins: Int64
    counts: Int64
    gaussians: Int64

    def from_row(self, first: int) -> _ImageLists:
        """Return a copy of the lists with `first` subtracted from the row numbers of Gaussians."""
        return _ImageLists(self.begins, self.counts, self.gaussians - first)


@dataclass(frozen=True, eq=False)
class _GivenLists:
    """Checked tile lists of all images.

    offsets: (..., tile_height, tile_width), where each tile's list starts in `ids`.
    ids: (pairs,), rows of the listed Gaussians.
    """

    offsets: Int64
    ids: Int64

    @classmethod
    def checked(
        cls, isect_offsets: ArrayLike, flatten_ids: ArrayLike, size: tuple[int, int], batch: tuple[int, ...]
    ) -> _GivenLists:
        """Check the tile lists of a call of `rasterize_to_pixels`. Raises InputError, which names the argument.

        size: width and height of an image in pixels. batch: leading sizes of the splats' arrays, (..., N) or (M,).
        """
        tiles = (-(-size[1] // TILE), -(-size[0] // TILE))
        lists = cls(*_lists(isect_offsets, flatten_ids, tiles, prod(batch)))
        if len(batch) > 1 and batch[:-1] != lists.images:
            raise InputError(f"isect_offsets: got leading sizes {lists.images}, expected {batch[:-1]} as in means2d")
        return lists

    @property
    def images(self) -> tuple[int, ...]:
        """Sizes of the axes of `offsets` before the two of the tiles. Their product is the number of images."""
        return self.offsets.shape[:-2]

    def of_image(self, image: int, shown: NDArray[np.bool_]) -> _ImageLists:
        """Return the tile lists of the image with this index.

        shown: (tiles,), True for tiles that are drawn. The lists of other tiles become empty.
        """
        tiles = prod(self.offsets.shape[-2:])
        flat, end = self.offsets.reshape(-1), (image + 1) * tiles
        starts = np.append(flat[end - tiles : end], flat[end] if end < len(flat) else len(self.ids))
        counts, listed = np.diff(starts), self.ids[starts[0] : starts[-1]]
        if not shown.all():
            listed = listed[np.repeat(shown, counts)]
            counts = np.where(shown, counts, 0)
        return _ImageLists(np.cumsum(counts) - counts, counts, listed)


def _checked_size(tile_size: int, image_width: int, image_height: int) -> tuple[int, int]:
    """Check the tile size, and return the image's width and height in pixels. Raises InputError."""
    if whole(tile_size) != TILE:
        raise InputError(f"tile_size: got {tile_size}, expected {TILE}, the only size that the kernels support")
    size = whole(image_width) or 0, whole(image_height) or 0
    if min(size) < 1:
        raise InputError(
            f"image_width, image_height: got {image_width} x {image_height}, expected at least 1 x 1 pixels"
        )
    return size


def _pixels(
    session: LibrarySession,
    given: _GivenSplats,
    lists: _ImageLists,
    size: tuple[int, int],
    background: Float32 | None,
    alpha_max: float,
) -> ListedPixels:
    """Blend the splats `given` into one image, in the order of its tiles' lists.

    size: (width, height) in pixels. background: (D,), or None for black.
    """
    with session.lock:
        device, n = session.device, len(given.means2d)
        arrays = (given.means2d, given.conics, given.opacities, given.opacities, given.colors)
        on_device = [from_host(device, array) for array in arrays]
        gaussians = ScreenGaussians(from_host(device, np.ones((n, 2), np.int32)), *on_device)

        def listing(work: Workspace) -> Listed:
            return _listed(device, work, gaussians, lists, size)

        return ListedPixels(session, gaussians, listing, size, background, alpha_max, backward=True)


def _listed(
    device: Device, work: Workspace, gaussians: ScreenGaussians, lists: _ImageLists, size: tuple[int, int]
) -> Listed:
    """Upload the caller's tile lists of one image, and number the (tile, Gaussian) pairs by Gaussian.

    size: width and height of the image in pixels.
    """
    drawn, listed = splats(device, work, gaussians, *size, listed=True), lists.gaussians
    by_gaussian = np.bincount(listed, minlength=gaussians.count)
    slots = np.empty(len(listed), np.uint32)
    slots[np.argsort(listed, kind="stable")] = np.arange(len(listed), dtype=np.uint32)
    ranges = np.stack([lists.begins, lists.begins + lists.counts], axis=1)
    first_slots = np.cumsum(by_gaussian) - by_gaussian
    words = (np.ascontiguousarray(of, np.uint32) for of in (ranges, listed, slots, by_gaussian, first_slots))
    ranges_, listed_, slots_, counts_, first_ = (upload(device, word) for word in words)
    tile_lists = TileLists(Band(0, len(lists.begins)), ranges_, listed_, slots_, Elements(len(listed)))
    return Listed(Projected(drawn.splats, counts_), tile_lists, first_)


def _shapes_of(values: ArrayLike, last: int) -> list[tuple[int | str, ...]]:
    """Return the shape that an array must have: as many axes as `values`, of any size except the last axis.

    last: required size of the last axis. The result is a list of one shape, for the arguments of `checks.floats`.
    """
    return [(*(f"axis {axis}" for axis in range(max(np.ndim(values) - 1, 1))), last)]


def _lists(isect_offsets: ArrayLike, flatten_ids: ArrayLike, tiles: tuple[int, int], count: int) -> tuple[Int64, Int64]:
    """Check the caller's tile lists, and return isect_offsets and flatten_ids as int64. Raises InputError.

    tiles: numbers of tiles down and across an image. count: number of Gaussians of all images.
    """
    offsets, ids = np.asarray(isect_offsets), np.asarray(flatten_ids)
    if offsets.ndim < 2 or offsets.shape[-2:] != tiles or offsets.dtype.kind not in "iu":
        wanted = f"integers (..., {tiles[0]}, {tiles[1]})"
        raise InputError(f"isect_offsets: got {offsets.dtype} of shape {offsets.shape}, expected {wanted}")
    if ids.ndim != 1 or ids.dtype.kind not in "iu":
        raise InputError(f"flatten_ids: got {ids.dtype} of shape {ids.shape}, expected integers (pairs,)")
    if len(ids) and not 0 <= int(ids.min()) <= int(ids.max()) < count:
        raise InputError(f"flatten_ids: got {ids.min()} to {ids.max()}, expected 0 to {count - 1}, the rows of means2d")
    steps = np.diff(np.concatenate([[0], offsets.reshape(-1).astype(np.int64), [len(ids)]]))
    if (steps < 0).any():
        raise InputError(
            f"isect_offsets: got decreasing numbers or some outside 0 to {len(ids)}, expected ascending numbers from 0 "
            "to the number of pairs"
        )
    return offsets.astype(np.int64), ids.astype(np.int64)


def _masks(masks: ArrayLike | None, shape: tuple[int, ...]) -> NDArray[np.bool_]:
    """Check the argument `masks`, and return it as an array (images, tiles), True for tiles that are drawn.

    shape: the required shape, (..., tile_height, tile_width).
    """
    tiles = prod(shape[-2:])
    if masks is None:
        return np.ones((prod(shape[:-2]), tiles), np.bool_)
    given = np.asarray(masks)
    if given.shape != shape or given.dtype != np.bool_:
        raise InputError(f"masks: got {given.dtype} of shape {given.shape}, expected bool of shape {shape}")
    return given.reshape(-1, tiles)


def _own_of(listed: Int64, batch: tuple[int, ...], image: int) -> slice:
    """Return the range of rows that holds an image's Gaussians.

    listed: the rows in the image's tile lists. In packed arrays, the range spans the lowest to the highest of them.
    batch: leading sizes of the splats' arrays: (..., N), or (M,) for packed arrays.
    image: index of the image.
    """
    if len(batch) > 1:
        return slice(image * batch[-1], (image + 1) * batch[-1])
    return slice(int(listed.min()), int(listed.max()) + 1) if len(listed) else slice(0, 0)
