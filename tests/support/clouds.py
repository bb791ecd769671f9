# SPDX-License-Identifier: Apache-2.0
"""A few Gaussians in front of a few cameras: float64 tensors for `clsplat.torch` and its reference `dense.py`."""

from __future__ import annotations

from typing import Any

import torch
from torch import Tensor

WIDTH, HEIGHT = 37, 29  # not multiples of a tile's side


def cameras(count: int) -> tuple[Tensor, Tensor]:
    """viewmats (C, 4, 4) and Ks (C, 3, 3) of cameras with slightly different poses and intrinsics."""
    viewmats, Ks = torch.eye(4).double().repeat(count, 1, 1), torch.zeros(count, 3, 3).double()
    for index in range(count):
        angle = torch.tensor(0.2 * index - 0.1).double()
        viewmats[index, 0, 0] = viewmats[index, 2, 2] = angle.cos()
        viewmats[index, 0, 2], viewmats[index, 2, 0] = angle.sin(), -angle.sin()
        viewmats[index, :3, 3] = torch.tensor([0.1 * index, -0.05, 0.2 * index])
        Ks[index] = torch.tensor([[30.0 + index, 0, 18.2], [0, 31, 14.9], [0, 0, 1]])
    return viewmats, Ks


def cloud(count: int, *, width: int = 3, degree: int | None = None, cams: int = 1, seed: int = 0) -> dict[str, Any]:
    """Arguments of `rasterization`: Gaussians at depths 2 to 6, with `width` channels or with SH of a degree."""
    draw = torch.Generator().manual_seed(seed)

    def uniform(least: float, most: float, *shape: int) -> Tensor:
        return least + (most - least) * torch.rand(*shape, generator=draw, dtype=torch.float64)

    depth = uniform(2, 6, count)
    means = torch.stack([uniform(-0.6, 0.6, count) * depth, uniform(-0.5, 0.5, count) * depth, depth], -1)
    viewmats, Ks = cameras(cams)
    colors = uniform(0, 1, count, width)
    if degree is not None:
        colors = uniform(-0.4, 0.4, count, (degree + 1) ** 2, 3)
    return {
        "means": means,
        "quats": torch.randn(count, 4, generator=draw, dtype=torch.float64),
        "scales": uniform(-3.2, -1.2, count, 3).exp(),
        "opacities": uniform(0.1, 0.95, count),
        "colors": colors,
        "viewmats": viewmats,
        "Ks": Ks,
        "width": WIDTH,
        "height": HEIGHT,
        "sh_degree": degree,
    }


def rounded(arguments: dict[str, Any]) -> dict[str, Any]:
    """The arguments with all tensors rounded to float32, but stored as float64.

    So the reference and the kernels begin with the same numbers.
    """
    return {name: value.float().double() if isinstance(value, Tensor) else value for name, value in arguments.items()}


def given(count: int = 8, **changes: Any) -> dict[str, Any]:
    """Arguments like those of `cloud`, in float32 and with these changes."""
    made = {name: value.float() if isinstance(value, Tensor) else value for name, value in cloud(count).items()}
    return {**made, **changes}
