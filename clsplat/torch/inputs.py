# SPDX-License-Identifier: Apache-2.0
"""Tensors and settings of a call of `rasterization`: checks, and the call of the library for each batch."""

from __future__ import annotations

import math
from dataclasses import dataclass, replace
from typing import Any

from torch import Tensor
from torch.autograd import forward_ad

from clsplat.device.context import Device
from clsplat.library.checks import degree
from clsplat.library.rasterize import Rasterization, rasterize
from clsplat.stages.harmonics import MAX_SH_BASIS_DEGREE
from clsplat.torch.arguments import check, check_shape, refuse
from clsplat.torch.autograd import Batches


@dataclass(frozen=True)
class RasterizationSettings:
    """The checked settings of a call of `rasterization`, by their names in `clsplat.rasterize`."""

    width: int
    height: int
    near_plane: float
    far_plane: float
    radius_clip: float
    eps2d: float
    alpha_max: float
    sh_degree: int | None
    render_mode: str
    rasterize_mode: str
    camera_model: str
    absolute_gradients: bool
    device: Device | str | None


@dataclass(frozen=True, eq=False)
class GivenTensors:
    """The tensors of a call of `rasterization`, by gsplat's names."""

    means: Tensor
    quats: Tensor | None
    scales: Tensor | None
    opacities: Tensor
    colors: Any
    viewmats: Tensor
    Ks: Tensor
    backgrounds: Tensor | None
    covars: Tensor | None

    @property
    def present(self) -> list[Tensor]:
        """The tensors that are not None."""
        return [each for each in vars(self).values() if each is not None]

    @property
    def require_grad(self) -> bool:
        """True if any tensor requires a gradient."""
        return any(each.requires_grad for each in self.present)

    @property
    def have_tangents(self) -> bool:
        """True if any tensor is a dual tensor of PyTorch's forward-mode differentiation."""
        return any(forward_ad.unpack_dual(each).tangent is not None for each in self.present)

    def check(self, sh_degree: int | None) -> tuple[int, ...]:
        """Check the tensors, and return the sizes of the batches.

        Raises InputError for a wrong shape, and for NaN in backgrounds.
        """
        means, viewmats, colors = self.means, self.viewmats, self.colors
        leading = means.shape[:-2] if isinstance(means, Tensor) and means.dim() >= 2 else ()
        check_shape("means", means, (*leading, "N", 3))
        batch, count = tuple(leading), means.shape[-2]
        if self.covars is None:
            check_shape("quats", self.quats, (*batch, count, 4))
            check_shape("scales", self.scales, (*batch, count, 3))
        else:
            check_shape("covars", self.covars, (*batch, count, 3, 3))
        check_shape("opacities", self.opacities, (*batch, count))
        check_shape("viewmats", viewmats, (*batch, "C", 4, 4))
        cameras = viewmats.shape[-3]
        if cameras == 0 or 0 in batch:
            raise refuse("viewmats", f"of shape {tuple(viewmats.shape)}", "at least one camera in each batch")
        check_shape("Ks", self.Ks, (*batch, cameras, 3, 3))
        _check_colors(colors, batch, cameras, count, sh_degree)
        if self.backgrounds is not None:  # the library does not check backgrounds if only depth is rendered
            shape = (*batch, cameras, colors.shape[-1])
            check_shape("backgrounds", self.backgrounds, shape)
            check("backgrounds", self.backgrounds, shape)
        return batch

    def used(self, *, depth_alone: bool) -> GivenTensors:
        """Return the tensors on which the result depends; the others become None.

        If covars are given, they replace quats and scales. depth_alone: True if no colour is rendered, so that
        backgrounds have no effect.
        """
        given = self if self.covars is None else replace(self, quats=None, scales=None)
        return replace(given, backgrounds=None) if depth_alone else given

    def rasterized(
        self, settings: RasterizationSettings, batch: tuple[int, ...], *, differentiable: bool
    ) -> list[Rasterization]:
        """Call `clsplat.rasterize` for each batch, and return the results.

        batch: sizes of the batch axes. differentiable: as for `clsplat.rasterize`.
        """
        means, quaternions, scales = Batches(self.means, batch), Batches(self.quats, batch), Batches(self.scales, batch)
        opacities, colors = Batches(self.opacities, batch), Batches(self.colors, batch)
        viewmats, intrinsics = Batches(self.viewmats, batch), Batches(self.Ks, batch)
        backgrounds, covars = Batches(self.backgrounds, batch), Batches(self.covars, batch)
        return [
            rasterize(
                means[index],
                quaternions[index],
                scales[index],
                opacities[index],
                colors[index],
                viewmats[index],
                intrinsics[index],
                settings.width,
                settings.height,
                near_plane=settings.near_plane,
                far_plane=settings.far_plane,
                radius_clip=settings.radius_clip,
                eps2d=settings.eps2d,
                sh_degree=settings.sh_degree,
                backgrounds=backgrounds[index],
                render_mode=settings.render_mode,
                rasterize_mode=settings.rasterize_mode,
                camera_model=settings.camera_model,
                covars=covars[index],
                alpha_max=settings.alpha_max,
                absolute_gradients=settings.absolute_gradients,
                differentiable=differentiable,
                device=settings.device,
            )
            for index in range(math.prod(batch))
        ]


def _check_colors(colors: Any, batch: tuple[int, ...], cameras: int, count: int, sh_degree: int | None) -> None:
    """Raise InputError if `colors` has a wrong shape, no channels, or too few SH coefficients for `sh_degree`.

    count: number of Gaussians in each batch. sh_degree: None if colors are not SH coefficients.
    """
    if sh_degree is None:
        check_shape("colors", colors, (*batch, count, "D"), (*batch, cameras, count, "D"))
        if colors.shape[-1] == 0:
            raise refuse("colors", "a tensor without channels", "at least 1 channel")
        return
    sh_degree = degree("sh_degree", sh_degree, MAX_SH_BASIS_DEGREE, ", or None for colours")
    check_shape("colors", colors, (*batch, count, "K", 3), (*batch, cameras, count, "K", 3))
    if colors.shape[-2] < (needed := (sh_degree + 1) ** 2):
        found = f"a tensor of {colors.shape[-2]} SH coefficients"
        raise refuse("colors", found, f"at least {needed} for sh_degree {sh_degree}")
