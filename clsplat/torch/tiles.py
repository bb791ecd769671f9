# SPDX-License-Identifier: Apache-2.0
"""`isect_tiles` and `isect_offset_encode`: the tiles that splats reach, by gsplat's calls."""

from __future__ import annotations

import torch
from torch import Tensor

from clsplat.library import tiles
from clsplat.torch.arguments import as_array, check_shape, refuse
from clsplat.torch.graphs import outside_graphs


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
    """Pairs of a tile and a splat whose box, its mean plus and minus the radii, overlaps it, as gsplat 1.5.3's
    function.

    means2d: (..., N, 2), pixels. radii: (..., N, 2), pixels; where one is 0 there is no pair. depths: (..., N). With
    `packed` (nnz, 2), (nnz, 2), (nnz,), image_ids (nnz,) of integers below n_images, and gaussian_ids (nnz,), which
    change nothing. tile_size: pixels. tile_width, tile_height: tiles across and down. sort: by id. segmented changes
    nothing. conics, opacities: None; gsplat 1.6 leaves tiles out by them.

    Returns tiles_per_gauss (..., N) or (nnz,) int32; isect_ids (n_isects,) int64, the image's number, the tile's, row
    by row, and the depth's 32 bits, from the high bits down; flatten_ids (n_isects,) int32, the splat's number among
    those of all images. None has a gradient. Raises InputError, which names the argument.
    """
    for name, value in (("conics", conics), ("opacities", opacities)):
        if value is not None:
            raise refuse(name, "given", "None: clsplat.torch has the tiles of a box alone")
    leading = tuple(means2d.shape[:-1]) if isinstance(means2d, Tensor) and means2d.dim() > 1 else ("N",)
    check_shape("means2d", means2d, (*leading, 2))
    if not isinstance(radii, Tensor) or radii.shape != means2d.shape:
        raise refuse("radii", tuple(getattr(radii, "shape", ())), f"a tensor {tuple(means2d.shape)}")
    check_shape("depths", depths, leading)
    images = None
    if packed:
        for name, value in (("n_images", n_images), ("image_ids", image_ids), ("gaussian_ids", gaussian_ids)):
            if value is None:
                raise refuse(name, None, "given where packed is True")
        assert image_ids is not None
        images = image_ids.cpu().numpy()
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


@outside_graphs
def isect_offset_encode(isect_ids: Tensor, n_images: int, tile_width: int, tile_height: int) -> Tensor:
    """The places (n_images, tile_height, tile_width) int32 at which each tile's pairs begin in sorted `isect_ids`
    (n_isects,) int64 of `isect_tiles`, as gsplat 1.5.3's function. Raises InputError for other images or tiles."""
    if not isinstance(isect_ids, Tensor):
        raise refuse("isect_ids", f"a {type(isect_ids).__name__}", "a tensor (n_isects,) of int64")
    found = tiles.isect_offset_encode(isect_ids.cpu().numpy(), n_images, tile_width, tile_height)
    return torch.from_numpy(found).to(isect_ids.device)
