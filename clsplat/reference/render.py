# SPDX-License-Identifier: Apache-2.0
"""Rendering of a model (projection, sorting, blending) and its gradient in float64, to which kernels are compared."""

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
    """Results of the forward pass: the projected Gaussians and the blended picture."""

    projected: ProjectedTwin
    blended: BlendedTwin


@dataclass(frozen=True, eq=False)
class GradientsTwin(BlendGradients):
    """Gradients with respect to the projected Gaussians and to the model's parameters.

    parameters: gradients with respect to the arrays of `Gaussians`, by their names and in their shapes.
    visible: (N,), False for culled Gaussians.
    """

    parameters: dict[str, Float64]
    visible: NDArray[np.bool_]


def parameters(gaussians: Gaussians) -> dict[str, Float64]:
    """Return the model's five parameter arrays by name, in float64, with means in world coordinates."""
    fields = dict.fromkeys(group.field for group in PARAMETER_GROUPS.values())
    arrays = {name: np.asarray(getattr(gaussians, name), np.float64) for name in fields}
    return {**arrays, "means": arrays["means"] + gaussians.origin}


def project_model(gaussians: Gaussians, camera: Camera, sh_degree: int) -> ProjectedTwin:
    """Project a model to the image plane, with the low-pass that it was trained with."""
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
    """Project, sort and blend a model. sh_degree: degree of the SH to use; None for the model's degree."""
    degree, camera = gaussians.sh_degree if sh_degree is None else sh_degree, camera.before(gaussians.near)
    projected = project_model(gaussians, camera, degree)
    return Forward(projected, blend(projected, camera.width, camera.height, background))


def render(
    gaussians: Gaussians,
    camera: Camera,
    background: Sequence[float] | Float64 = BLACK_BACKGROUND,
    sh_degree: int | None = None,
) -> tuple[Float64, Float64]:
    """Render a model to an image (H, W, 3) over the background, and alpha (H, W). sh_degree: as for `forward`."""
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
    """Return the gradients of a loss with respect to the Gaussians of a rendered picture.

    d_image: (H, W, 3), gradient of the loss with respect to the image.
    sh_degree: as for `forward`.
    d_transmittance: (H, W), gradient with respect to the transmittance behind all Gaussians; None for 0.
    d_nearness: (H, W), gradient with respect to the nearness; None for 0.
    """
    degree, camera = gaussians.sh_degree if sh_degree is None else sh_degree, camera.before(gaussians.near)
    projected = project_model(gaussians, camera, degree)
    screen = blend_grad(projected, camera.width, camera.height, background, d_image, d_transmittance, d_nearness)
    arrays, on_image = parameters(gaussians), projected_gradients(projected, screen)
    by_parameter = project_grad(arrays, camera, degree, projected, on_image, antialiased=gaussians.antialiased)
    by_parameter["means"] = by_parameter["means"] + nearness_grad(arrays["means"], camera, screen.nearness)
    return GradientsTwin(**vars(screen), parameters=by_parameter, visible=projected.visible)


def projected_gradients(projected: ProjectedTwin, screen: BlendGradients) -> ProjectedGradients:
    """Convert the gradients of blending to the input of `project_grad`, with covariances in place of conics."""
    by_covariance = covariance_grad(projected.conics, screen.conics)
    return ProjectedGradients(screen.means2d, by_covariance, screen.opacities, screen.colors)


def render_lens_grad(
    gaussians: Gaussians, camera: Camera, d_image: Float64, background: Sequence[float] | Float64 = BLACK_BACKGROUND
) -> Float64:
    """Return the gradient (4,) of a loss with respect to a lens: ln fx, ln fy, cx and cy.

    d_image: (H, W, 3), gradient of the loss with respect to the image.
    """
    arrays, camera = parameters(gaussians), camera.before(gaussians.near)
    projected = project_model(gaussians, camera, gaussians.sh_degree)
    screen = blend_grad(projected, camera.width, camera.height, background, d_image)
    geometry = (arrays["means"], arrays["quaternions"], arrays["log_scales"], camera, projected)
    return lens_grad(*geometry, projected_gradients(projected, screen), antialiased=gaussians.antialiased)
