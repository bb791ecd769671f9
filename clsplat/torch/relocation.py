# SPDX-License-Identifier: Apache-2.0
"""Gaussians that share the place of one: plain PyTorch, on the tensors' own device."""

from __future__ import annotations

import torch
from torch import Tensor

from clsplat.torch.arguments import check, refuse


def compute_relocation(
    opacities: Tensor, scales: Tensor, ratios: Tensor, binoms: Tensor, *, min_opacity: float = 0.0
) -> tuple[Tensor, Tensor]:
    """Opacities and scales of n Gaussians in the place of one that look like that one, as gsplat 1.5.3's function.

    opacities: (N,), in [0, 1]. scales: (N, 3). ratios: (N,), how many share each one's place, any kind of number; taken
    as at least 1 and at most n_max. binoms: (n_max, n_max), binoms[n, k] = n over k. min_opacity: the least new
    opacity, gsplat 1.6's. Returns the new opacities (N,) and scales (N, 3). Eq. (9) of Kheradmand et al. 2024,
    "3D Gaussian Splatting as Markov Chain Monte Carlo", whose sum of alternating terms is made in float64.

    Raises InputError, which names the argument, for other shapes and for NaN.
    """
    check("opacities", opacities, ("N",))
    count = len(opacities)
    check("scales", scales, (count, 3))
    check("binoms", binoms, ("n_max", binoms.shape[0] if isinstance(binoms, Tensor) and binoms.dim() else "n_max"))
    if not isinstance(ratios, Tensor) or ratios.shape != (count,):
        raise refuse("ratios", getattr(ratios, "shape", type(ratios).__name__), f"a tensor ({count},)")
    if ratios.is_floating_point():
        check("ratios", ratios, (count,))
    with torch.no_grad():
        table = binoms.to(opacities.device, torch.float64)
        most = len(table)
        shares = ratios.clamp(1, most).long()
        old = opacities.double()
        new = (1 - (1 - old) ** (1 / shares)).clamp(min=min_opacity)
        powers = torch.arange(1, most + 1, device=old.device)
        signs = 1 - 2 * ((powers - 1) % 2)
        # binoms[i - 1, k] summed over i = 1 .. n
        sums = table.cumsum(0)[shares - 1]
        denominators = (sums * signs / powers.sqrt() * new[:, None] ** powers).sum(-1)
        new_scales = (old / denominators)[:, None] * scales
        return new.to(opacities.dtype), new_scales.to(scales.dtype)
