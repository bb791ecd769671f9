# SPDX-License-Identifier: Apache-2.0
"""gsplat's `spherical_harmonics`: colours from coefficients and directions, with their gradient."""

from __future__ import annotations

from typing import Any

import torch
from torch import Tensor

from clsplat.device.context import Device
from clsplat.library.harmonics import HarmonicColors
from clsplat.library.harmonics import spherical_harmonics as library_harmonics
from clsplat.torch.arguments import as_array, as_tensor, check_shape, refuse, renamed, shape_or_type
from clsplat.torch.compile_guards import differentiable_once, outside_graphs


@outside_graphs
def spherical_harmonics(
    degrees_to_use: int,
    dirs: Tensor,
    coeffs: Tensor,
    masks: Tensor | None = None,
    *,
    device: Device | str | None = None,
) -> Tensor:
    """Evaluate real spherical harmonics in given directions, like gsplat 1.5.3's function of this name.

    Parameters
    ----------
    degrees_to_use : int
        Highest degree, 0 to 4.
    dirs : (..., 3) Tensor
        Directions of any length.
    coeffs : (..., K, 3) Tensor
        K is at least (degrees_to_use + 1)^2; order and signs as in 3DGS files.
    masks : (...) Tensor of bool, optional
        Where it is False the sum and its gradient are 0.
    device : Device or str, optional
        An open OpenCL device, or a name as `clsplat devices` lists them.

    Returns
    -------
    (..., 3) Tensor
        The sums. `rasterization` also adds 0.5 to them, and clamps them at 0.

    Raises
    ------
    InputError
        If a shape or degree is wrong, or numbers are not finite; it names the argument.

    Notes
    -----
    Signs and order of the basis are in docs/conventions.md.
    """
    check_shape("dirs", dirs, (*dirs.shape[:-1], 3) if isinstance(dirs, Tensor) and dirs.dim() else ("...", 3))
    check_shape("coeffs", coeffs, (*dirs.shape[:-1], "K", 3))
    if masks is not None and (not isinstance(masks, Tensor) or masks.shape != dirs.shape[:-1]):
        raise refuse("masks", shape_or_type(masks), f"a tensor {tuple(dirs.shape[:-1])}")
    shown = None if masks is None else masks.detach().cpu().numpy()
    with renamed(directions="dirs", coefficients="coeffs", degree="degrees_to_use"):
        result = library_harmonics(degrees_to_use, as_array(dirs), as_array(coeffs), shown, device=device)
    colors: Tensor = _Harmonics.apply(result, dirs, coeffs)
    return colors


class _Harmonics(torch.autograd.Function):  # type: ignore[misc]  # torch has no types here
    @staticmethod
    def forward(ctx: Any, result: HarmonicColors, dirs: Tensor, coeffs: Tensor) -> Tensor:
        ctx.result = result
        ctx.save_for_backward(dirs, coeffs)
        return as_tensor(result.colors, dirs)

    @staticmethod
    @differentiable_once
    def backward(ctx: Any, d_colors: Tensor) -> tuple[None, Tensor, Tensor]:
        dirs, coeffs = ctx.saved_tensors
        found = ctx.result.vjp(as_array(d_colors))
        return None, as_tensor(found["directions"], dirs), as_tensor(found["coefficients"], coeffs)
