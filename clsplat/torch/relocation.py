# SPDX-License-Identifier: Apache-2.0
"""Relocation of Gaussians to the place of another Gaussian: pure PyTorch, on the device of the tensors."""

from __future__ import annotations

import torch
from torch import Tensor

from clsplat.torch.arguments import check, refuse, shape_or_type


def compute_relocation(
    opacities: Tensor, scales: Tensor, ratios: Tensor, binoms: Tensor, *, min_opacity: float = 0.0
) -> tuple[Tensor, Tensor]:
    """Compute the opacities and scales with which n Gaussians at the same place look like the original Gaussian.

    Follows gsplat 1.5.3's function of this name.

    Parameters
    ----------
    opacities : (N,) Tensor
        0 to 1.
    scales : (N, 3) Tensor
        Standard deviations.
    ratios : (N,) Tensor
        Number n of Gaussians that share the place of each Gaussian. Any dtype; clamped to 1 to n_max.
    binoms : (n_max, n_max) Tensor
        binoms[n, k] is the binomial coefficient n choose k.
    min_opacity : float
        Lower limit of the new opacities, an argument of gsplat 1.6.

    Returns
    -------
    opacities : (N,) Tensor
        New opacities.
    scales : (N, 3) Tensor
        New standard deviations.

    Raises
    ------
    InputError
        If a shape is wrong or there is a NaN; it names the argument.

    Notes
    -----
    Eq. (9) of Kheradmand et al. 2024, "3D Gaussian Splatting as Markov Chain Monte Carlo"; (94) of
    docs/gradients.md. The alternating sum is computed in float64.
    """
    check("opacities", opacities, ("N",))
    count = len(opacities)
    check("scales", scales, (count, 3))
    check("binoms", binoms, ("n_max", binoms.shape[0] if isinstance(binoms, Tensor) and binoms.dim() else "n_max"))
    if not isinstance(ratios, Tensor) or ratios.shape != (count,):
        raise refuse("ratios", shape_or_type(ratios), f"a tensor ({count},)")
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
        # sums[:, k] = sum of binoms[i - 1, k] over i = 1 .. n
        sums = table.cumsum(0)[shares - 1]
        denominators = (sums * signs / powers.sqrt() * new[:, None] ** powers).sum(-1)
        new_scales = (old / denominators)[:, None] * scales
        return new.to(opacities.dtype), new_scales.to(scales.dtype)
