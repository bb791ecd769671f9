# SPDX-License-Identifier: Apache-2.0
"""gsplat's `isect_tiles` and `isect_offset_encode`: the tiles that splats reach."""

from __future__ import annotations

from typing import Any

import torch
from numpy.typing import NDArray
from torch import Tensor

from clsplat.library import tiles
from clsplat.torch.arguments import as_array, check_shape, refuse, shape_or_type
from clsplat.torch.compile_guards import outside_graphs


@outside_graphs
def isect_tiles(
    means2d: Tensor,
    radii: Tensor,
    depths: Tensor,
    tile_size: int,
    tile_width: int,
    tile_height: int,
    sort: bool = True,
    segmented: bool = False,  # noqa: ARG001
    packed: bool = False,
    n_images: int | None = None,
    image_ids: Tensor | None = None,
    gaussian_ids: Tensor | None = None,
    *,
    conics: Tensor | None = None,
    opacities: Tensor | None = None,
) -> tuple[Tensor, Tensor, Tensor]:
    """List the (tile, splat) pairs in which the tile overlaps the splat's bounding box, like gsplat 1.5.3.

    The box is the mean plus and minus the radii. The results have no gradient.

    Parameters
    ----------
    means2d : (..., N, 2) Tensor
        Pixels. With `packed` (nnz, 2).
    radii : (..., N, 2) Tensor
        Pixels; a splat with a radius of 0 has no pairs. With `packed` (nnz, 2).
    depths : (..., N) Tensor
        World units. With `packed` (nnz,).
    tile_size : int
        Side of a tile in pixels.
    tile_width, tile_height : int
        Number of tiles across and down.
    sort : bool
        Sort the pairs by id.
    segmented : bool
        Ignored; it changes no result.
    packed : bool
        True if a single axis holds the splats of all images. Then image_ids, gaussian_ids and n_images are required.
    n_images : int, optional
        Number of images. Required with `packed`.
    image_ids : (nnz,) Tensor of int, optional
        Image of each splat, below n_images.
    gaussian_ids : (nnz,) Tensor of int, optional
        Not used.
    conics, opacities : None
        Only None is supported. gsplat 1.6 uses these arguments to skip tiles.

    Returns
    -------
    tiles_per_gauss : (..., N) or (nnz,) Tensor of int32
        Number of tiles of each splat.
    isect_ids : (n_isects,) Tensor of int64
        From high to low bits: the image, the tile in row-major order, and the 32 bits of the depth.
    flatten_ids : (n_isects,) Tensor of int32
        Index of the splat, counted over all images.

    Raises
    ------
    InputError
        If a shape is wrong, or an argument is not supported; it names the argument.

    Notes
    -----
    Kerbl et al. 2023, section 6; gsplat 1.5.3's function of this name.
    """
    for name, value in (("conics", conics), ("opacities", opacities)):
        if value is not None:
            raise refuse(name, "given", "None: clsplat.torch lists all tiles of a splat's box")
    _check_splats(means2d, radii, depths)
    images = _checked_ids(n_images, image_ids, gaussian_ids) if packed else None
    found = tiles.isect_tiles(
        as_array(means2d),
        radii.cpu().numpy(),
        as_array(depths),
        tile_size,
        tile_width,
        tile_height,
        sort,
        image_ids=images,
        n_images=n_images if packed else None,
    )
    first, second, third = (torch.from_numpy(each).to(means2d.device) for each in found)
    return first, second, third


def _check_splats(means2d: Tensor, radii: Tensor, depths: Tensor) -> None:
    """Raise InputError unless the shapes of the splats' tensors fit together."""
    leading = tuple(means2d.shape[:-1]) if isinstance(means2d, Tensor) and means2d.dim() > 1 else ("N",)
    check_shape("means2d", means2d, (*leading, 2))
    if not isinstance(radii, Tensor) or radii.shape != means2d.shape:
        raise refuse("radii", shape_or_type(radii), f"a tensor {tuple(means2d.shape)}")
    check_shape("depths", depths, leading)


def _checked_ids(n_images: int | None, image_ids: Tensor | None, gaussian_ids: Tensor | None) -> NDArray[Any]:
    """The image of each packed splat, from `image_ids`. Raises InputError if an argument is None."""
    for name, value in (("n_images", n_images), ("image_ids", image_ids), ("gaussian_ids", gaussian_ids)):
        if value is None:
            raise refuse(name, None, "a value, as packed is True")
    assert image_ids is not None
    images: NDArray[Any] = image_ids.cpu().numpy()
    return images


@outside_graphs
def isect_offset_encode(isect_ids: Tensor, n_images: int, tile_width: int, tile_height: int) -> Tensor:
    """Find the start of each tile's pairs in the sorted ids of `isect_tiles`, like gsplat 1.5.3.

    Parameters
    ----------
    isect_ids : (n_isects,) Tensor of int64
        Sorted ids of `isect_tiles`.
    n_images : int
        Number of images.
    tile_width, tile_height : int
        Number of tiles across and down.

    Returns
    -------
    (n_images, tile_height, tile_width) Tensor of int32
        Index of the first id of each tile.

    Raises
    ------
    InputError
        If an id names an image that is not below `n_images`, or a tile outside `tile_width` x `tile_height`.
    """
    if not isinstance(isect_ids, Tensor):
        raise refuse("isect_ids", f"a {type(isect_ids).__name__}", "a tensor (n_isects,) of int64")
    found = tiles.isect_offset_encode(isect_ids.cpu().numpy(), n_images, tile_width, tile_height)
    return torch.from_numpy(found).to(isect_ids.device)
