# SPDX-License-Identifier: Apache-2.0
"""gsplat's `rasterize_to_pixels`: images of splats from tile lists, with their gradient."""

from __future__ import annotations

from typing import Any

import torch
from torch import Tensor

from clsplat.device.context import Device
from clsplat.library.tile_list_pixels import RasterizedPixels
from clsplat.library.tile_list_pixels import rasterize_to_pixels as library_pixels
from clsplat.torch.arguments import as_array, as_tensor, check_shape, check_size, refuse, shape_or_type
from clsplat.torch.compile_guards import differentiable_once, outside_graphs

PIXEL_INPUTS = ("means2d", "conics", "colors", "opacities", "backgrounds")


@outside_graphs
def rasterize_to_pixels(
    means2d: Tensor,
    conics: Tensor,
    colors: Tensor,
    opacities: Tensor,
    image_width: int,
    image_height: int,
    tile_size: int,
    isect_offsets: Tensor,
    flatten_ids: Tensor,
    backgrounds: Tensor | None = None,
    masks: Tensor | None = None,
    packed: bool = False,
    absgrad: bool = False,
    *,
    alpha_max: float = 0.999,
    device: Device | str | None = None,
) -> tuple[Tensor, Tensor]:
    """Blend splats in tile lists to images, like gsplat 1.5.3's function of this name.

    Parameters
    ----------
    means2d : (..., N, 2) Tensor
        Pixels; the first pixel's centre is at 0.5. With `packed`, nnz replaces "..., N" in all tensors.
    conics : (..., N, 3) Tensor
        xx, xy, yy of the inverse covariance, 1 / px^2.
    colors : (..., N, D) Tensor
        D at least 1.
    opacities : (..., N) Tensor
        0 to 1.
    image_width, image_height : int
        Pixels.
    tile_size : int
        16, the only size that clsplat supports.
    isect_offsets : (..., tile_height, tile_width) Tensor of int
        Start of each tile's list in flatten_ids, from `isect_offset_encode`.
    flatten_ids : (n_isects,) Tensor of int
        Splats of the lists, front to back, from `isect_tiles`.
    backgrounds : (..., D) Tensor, optional
        Black if None.
    masks : (..., tile_height, tile_width) Tensor of bool, optional
        Tiles that are False show only the background.
    packed : bool
        True if a single axis holds the splats of all images.
    absgrad : bool
        Let the backward pass set `means2d.absgrad` to the sums over pixels of absolute gradients.
    alpha_max : float
        Maximum of a splat's alpha at a pixel.
    device : Device or str, optional
        An open OpenCL device, or a name as `clsplat devices` lists them.

    Returns
    -------
    images : (..., H, W, D) Tensor
        Colours over the background.
    alphas : (..., H, W, 1) Tensor
        0 to 1.

    Raises
    ------
    InputError
        If a shape or the tile size is wrong, or numbers are not finite; it names the argument.

    Notes
    -----
    Kerbl et al. 2023; gsplat 1.5.3's function of this name.
    """
    image_width, image_height = check_size("image_width", image_width), check_size("image_height", image_height)
    _check_splats(means2d, conics, colors, opacities, packed=packed)
    for name, value in (("isect_offsets", isect_offsets), ("flatten_ids", flatten_ids)):
        if not isinstance(value, Tensor):
            raise refuse(name, f"a {type(value).__name__}", "a tensor of integers")
    if backgrounds is not None:
        check_shape("backgrounds", backgrounds, (*isect_offsets.shape[:-2], colors.shape[-1]))
    result = library_pixels(
        as_array(means2d),
        as_array(conics),
        as_array(colors),
        as_array(opacities),
        image_width,
        image_height,
        tile_size,
        isect_offsets.cpu().numpy(),
        flatten_ids.cpu().numpy(),
        None if backgrounds is None else as_array(backgrounds),
        None if masks is None else masks.cpu().numpy(),
        alpha_max=alpha_max,
        device=device,
    )
    images, alphas = _Pixels.apply(result, absgrad, means2d, conics, colors, opacities, backgrounds)
    return images, alphas


def _check_splats(means2d: Tensor, conics: Tensor, colors: Tensor, opacities: Tensor, *, packed: bool) -> None:
    """Raise InputError unless the shapes of the splats' tensors fit together."""
    leading = tuple(means2d.shape[:-1]) if isinstance(means2d, Tensor) and means2d.dim() > 1 else ("N",)
    if packed and len(leading) != 1:
        raise refuse("means2d", shape_or_type(means2d), "of shape (nnz, 2), as packed is True")
    check_shape("means2d", means2d, (*leading, 2))
    check_shape("conics", conics, (*leading, 3))
    check_shape("colors", colors, (*leading, "D"))
    check_shape("opacities", opacities, leading)


class _Pixels(torch.autograd.Function):  # type: ignore[misc]  # torch has no types here
    @staticmethod
    def forward(
        ctx: Any, result: RasterizedPixels, absgrad: bool, means2d: Tensor, *others: Tensor | None
    ) -> tuple[Tensor, Tensor]:
        ctx.result, ctx.absgrad = result, absgrad
        images, alphas = as_tensor(result.colors, means2d), as_tensor(result.alphas, means2d)
        ctx.save_for_backward(means2d, *others)
        ctx.set_materialize_grads(False)
        return images, alphas

    @staticmethod
    @differentiable_once
    def backward(ctx: Any, d_images: Tensor | None, d_alphas: Tensor | None) -> tuple[Any, ...]:
        inputs = dict(zip(PIXEL_INPUTS, ctx.saved_tensors, strict=True))
        if d_images is None and d_alphas is None:
            return (None,) * (2 + len(inputs))
        given = [None if each is None else as_array(each) for each in (d_images, d_alphas)]
        found = ctx.result.vjp(*given, absolute=ctx.absgrad)
        if ctx.absgrad:
            inputs["means2d"].absgrad = as_tensor(found["absolute"], inputs["means2d"])
        gradients = [None if like is None else as_tensor(found[name], like) for name, like in inputs.items()]
        return (None, None, *gradients)
