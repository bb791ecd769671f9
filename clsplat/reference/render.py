# SPDX-License-Identifier: Apache-2.0
"""The forward pass and its gradient in float64, to which the kernels are compared."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from clsplat.arrays import Float64
from clsplat.camera import Camera
from clsplat.gaussians import PARAMETER_GROUPS, Gaussians
from clsplat.reference.blend import BlendedTwin, BlendGradients, blend, blend_grad
from clsplat.reference.depth import nearness_grad
from clsplat.reference.project import (
    ProjectedGradients,
    ProjectedTwin,
    covariance_grad,
    lens_grad,
    project,
    project_grad,
)

BLACK_BACKGROUND = (0.0, 0.0, 0.0)


@dataclass(frozen=True, eq=False)
class Forward:
    """The results of the forward pass."""

    projected: ProjectedTwin
    blended: BlendedTwin


@dataclass(frozen=True, eq=False)
class GradientsTwin(BlendGradients):
    """Gradients with respect to the projected Gaussians and to the parameters.

    parameters: gradients by the names of the arrays in `Gaussians`, with their shapes.
    visible: (N,).
    """

    parameters: dict[str, Float64]
    visible: NDArray[np.bool_]


def parameters(gaussians: Gaussians) -> dict[str, Float64]:
    """The five parameter arrays by name, in float64, with means in world coordinates."""
    fields = dict.fromkeys(group.field for group in PARAMETER_GROUPS.values())
    arrays = {name: np.asarray(getattr(gaussians, name), np.float64) for name in fields}
    return {**arrays, "means": arrays["means"] + gaussians.origin}


def project_model(gaussians: Gaussians, camera: Camera, sh_degree: int) -> ProjectedTwin:
    """Project a model, with the low-pass that it was trained with."""
    arrays = parameters(gaussians)
    return project(
        arrays["means"],
        arrays["quaternions"],
        arrays["log_scales"],
        arrays["opacity_logits"],
        arrays["sh"],
        camera,
        sh_degree,
        antialiased=gaussians.antialiased,
    )


def forward(
    gaussians: Gaussians,
    camera: Camera,
    background: Sequence[float] | Float64 = BLACK_BACKGROUND,
    sh_degree: int | None = None,
) -> Forward:
    """Project, sort and blend. sh_degree: None uses all bands of the model."""
    degree, camera = gaussians.sh_degree if sh_degree is None else sh_degree, camera.before(gaussians.near)
    projected = project_model(gaussians, camera, degree)
    return Forward(projected, blend(projected, camera.width, camera.height, background))


def render(
    gaussians: Gaussians,
    camera: Camera,
    background: Sequence[float] | Float64 = BLACK_BACKGROUND,
    sh_degree: int | None = None,
) -> tuple[Float64, Float64]:
    """Render to image (H, W, 3) over the background, and alpha (H, W) = 1 - transmittance."""
    blended = forward(gaussians, camera, background, sh_degree).blended
    return blended.image, 1 - blended.transmittance


def render_grad(
    gaussians: Gaussians,
    camera: Camera,
    d_image: Float64,
    background: Sequence[float] | Float64 = BLACK_BACKGROUND,
    sh_degree: int | None = None,
    d_transmittance: Float64 | None = None,
    d_nearness: Float64 | None = None,
) -> GradientsTwin:
    """Gradients of a loss.

    d_image: (H, W, 3), dL/dimage.
    d_transmittance: (H, W), dL/dT with T the transmittance behind all Gaussians.
    d_nearness: (H, W), dL/dN with N the nearness.
    """
    degree, camera = gaussians.sh_degree if sh_degree is None else sh_degree, camera.before(gaussians.near)
    projected = project_model(gaussians, camera, degree)
    screen = blend_grad(projected, camera.width, camera.height, background, d_image, d_transmittance, d_nearness)
    arrays, on_image = parameters(gaussians), projected_gradients(projected, screen)
    by_parameter = project_grad(arrays, camera, degree, projected, on_image, antialiased=gaussians.antialiased)
    by_parameter["means"] = by_parameter["means"] + nearness_grad(arrays["means"], camera, screen.nearness)
    return GradientsTwin(**vars(screen), parameters=by_parameter, visible=projected.visible)


def projected_gradients(projected: ProjectedTwin, screen: BlendGradients) -> ProjectedGradients:
    """The gradients of blending, as the input of projection's gradient: covariances replace conics."""
    by_covariance = covariance_grad(projected.conics, screen.conics)
    return ProjectedGradients(screen.means2d, by_covariance, screen.opacities, screen.colors)


def render_lens_grad(
    gaussians: Gaussians, camera: Camera, d_image: Float64, background: Sequence[float] | Float64 = BLACK_BACKGROUND
) -> Float64:
    """Gradient (4,) of a loss with respect to ln fx, ln fy, cx and cy. d_image: (H, W, 3), dL/dimage."""
    arrays, camera = parameters(gaussians), camera.before(gaussians.near)
    projected = project_model(gaussians, camera, gaussians.sh_degree)
    screen = blend_grad(projected, camera.width, camera.height, background, d_image)
    geometry = (arrays["means"], arrays["quaternions"], arrays["log_scales"], camera, projected)
    return lens_grad(*geometry, projected_gradients(projected, screen), antialiased=gaussians.antialiased)
