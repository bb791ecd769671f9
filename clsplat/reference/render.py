# SPDX-License-Identifier: Apache-2.0
"""The whole forward pass and its gradient in float64: what the kernels are held against."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from clsplat.arrays import Float64
from clsplat.camera import Camera
from clsplat.gaussians import GROUPS, Gaussians
from clsplat.reference.blend import Blended, BlendGradients, blend, blend_grad
from clsplat.reference.depth import nearness_grad
from clsplat.reference.project import Projected, covariance_grad, lens_grad, project, project_grad

BLACK = (0.0, 0.0, 0.0)


@dataclass(frozen=True, eq=False)
class Forward:
    """Everything the forward pass made."""

    projected: Projected
    blended: Blended


@dataclass(frozen=True, eq=False)
class Gradients(BlendGradients):
    """Those on the image, and parameters: by the name of the array in `Gaussians`, same shapes; visible (N,)."""

    parameters: dict[str, Float64]
    visible: NDArray[np.bool_]


def parameters(gaussians: Gaussians) -> dict[str, Float64]:
    """The five arrays by name, in float64; means in the world."""
    fields = dict.fromkeys(group.field for group in GROUPS.values())
    arrays = {name: np.asarray(getattr(gaussians, name), np.float64) for name in fields}
    return {**arrays, "means": arrays["means"] + gaussians.origin}


def forward(
    gaussians: Gaussians,
    camera: Camera,
    background: Sequence[float] | Float64 = BLACK,
    sh_degree: int | None = None,
) -> Forward:
    """Project, sort, blend; sh_degree None uses all bands there are."""
    degree, camera = gaussians.sh_degree if sh_degree is None else sh_degree, camera.before(gaussians.near)
    projected = project(**parameters(gaussians), camera=camera, sh_degree=degree, antialiased=gaussians.antialiased)
    return Forward(projected, blend(projected, camera.width, camera.height, background))


def render(
    gaussians: Gaussians,
    camera: Camera,
    background: Sequence[float] | Float64 = BLACK,
    sh_degree: int | None = None,
) -> tuple[Float64, Float64]:
    """image (H, W, 3) over the background, alpha (H, W) = 1 - transmittance."""
    blended = forward(gaussians, camera, background, sh_degree).blended
    return blended.image, 1 - blended.transmittance


def render_grad(
    gaussians: Gaussians,
    camera: Camera,
    d_image: Float64,
    background: Sequence[float] | Float64 = BLACK,
    sh_degree: int | None = None,
    d_transmittance: Float64 | None = None,
    d_nearness: Float64 | None = None,
) -> Gradients:
    """Gradients of a loss with dL/dimage = d_image (H, W, 3), and by the transmittance at the end and nearness, each
    (H, W)."""
    degree, camera = gaussians.sh_degree if sh_degree is None else sh_degree, camera.before(gaussians.near)
    arrays = parameters(gaussians)
    projected = project(**arrays, camera=camera, sh_degree=degree, antialiased=gaussians.antialiased)
    screen = blend_grad(projected, camera.width, camera.height, background, d_image, d_transmittance, d_nearness)
    by_parameter = project_grad(
        **arrays,
        camera=camera,
        sh_degree=degree,
        projected=projected,
        d_means2d=screen.means2d,
        d_covariances=covariance_grad(projected.conics, screen.conics),
        d_opacities=screen.opacities,
        d_colors=screen.colors,
        antialiased=gaussians.antialiased,
    )
    by_parameter["means"] = by_parameter["means"] + nearness_grad(arrays["means"], camera, screen.nearness)
    return Gradients(**vars(screen), parameters=by_parameter, visible=projected.visible)


def render_lens_grad(
    gaussians: Gaussians, camera: Camera, d_image: Float64, background: Sequence[float] | Float64 = BLACK
) -> Float64:
    """Gradient (4,) of a loss with dL/dimage = d_image (H, W, 3) by ln fx, ln fy, cx and cy."""
    arrays, camera = parameters(gaussians), camera.before(gaussians.near)
    projected = project(**arrays, camera=camera, sh_degree=gaussians.sh_degree, antialiased=gaussians.antialiased)
    screen = blend_grad(projected, camera.width, camera.height, background, d_image)
    by_covariance = covariance_grad(projected.conics, screen.conics)
    return lens_grad(
        arrays["means"],
        arrays["quaternions"],
        arrays["log_scales"],
        camera,
        projected,
        screen.means2d,
        by_covariance,
        screen.opacities,
        antialiased=gaussians.antialiased,
    )
