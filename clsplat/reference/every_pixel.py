# SPDX-License-Identifier: Apache-2.0
"""Pictures by cameras of any projection in float64. Every Gaussian is evaluated at every pixel, without tiles.

Equation numbers refer to docs/gradients.md (14 to 16) and docs/channels.md (60 to 64).
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, replace

import numpy as np

from clsplat.arrays import Float64
from clsplat.camera import Camera
from clsplat.gaussians import Gaussians
from clsplat.reference import render as on_plane
from clsplat.reference.blend import blend, blend_grad
from clsplat.reference.channels import ChannelsTwin, channels
from clsplat.reference.depth import nearness_grad
from clsplat.reference.project import Footprint, ProjectedTwin, Seen
from clsplat.reference.rays import pixel_sides, tangents, tangents_grad
from clsplat.reference.render import BLACK_BACKGROUND, GradientsTwin, parameters, project_model


@dataclass(frozen=True, eq=False)
class Picture(ChannelsTwin):
    """A picture and its channels.

    image, alpha: (H, W, 3) and (H, W).
    margin, nearness: (H, W), as in `reference.blend.BlendedTwin`.
    """

    image: Float64
    alpha: Float64
    margin: Float64
    nearness: Float64


class _Unbounded(ProjectedTwin):
    """Gaussians on the image plane, each with the whole image as its box."""

    def footprint(self, gaussian: int, width: int, height: int) -> Footprint:
        pixels = np.stack(np.meshgrid(np.arange(width) + 0.5, np.arange(height) + 0.5), axis=2).reshape(-1, 2)
        sxx, sxy, syy = self.covariances[gaussian]
        d = pixels - self.means2d[gaussian]
        q = np.einsum("ni,ij,nj->n", d, np.linalg.inv(np.array([[sxx, sxy], [sxy, syy]])), d)
        falloff = np.exp(-0.5 * q).reshape(height, width)
        dx, dy = d.T.reshape(2, height, width)
        return Footprint((slice(height), slice(width)), dx, dy, falloff, self.opacities[gaussian] * falloff)


def render(
    gaussians: Gaussians,
    camera: Camera,
    background: Sequence[float] | Float64 = BLACK_BACKGROUND,
    after: Camera | None = None,
) -> Picture:
    """Render a picture and its channels. A pixel without a ray shows the background.

    after: the camera after the motion, for the channel `motion`; None for no motion.
    """
    seen: Seen
    if not camera.model.along_rays:
        seen = _Unbounded(**vars(project_model(gaussians, camera, gaussians.sh_degree)))
    else:
        seen = tangents(gaussians, camera)
    blended = blend(seen, camera.width, camera.height, background)
    others = channels(seen, gaussians, camera, after or camera)
    if (of_distances := camera.depths_of_distances()) is not None:
        depth, median, first = (each * of_distances for each in (others.features["depth"], others.median, others.first))
        others = replace(others, features=others.features | {"depth": depth}, median=median, first=first)
    alpha, margin, nearness = 1 - blended.transmittance, blended.margin, blended.nearness
    return Picture(**vars(others), image=blended.image, alpha=alpha, margin=margin, nearness=nearness)


def render_grad(
    gaussians: Gaussians,
    camera: Camera,
    d_image: Float64,
    background: Sequence[float] | Float64 = BLACK_BACKGROUND,
    d_nearness: Float64 | None = None,
) -> GradientsTwin:
    """Return the gradients of a loss with respect to the Gaussians, for a camera of any projection.

    For camera models along rays, `means2d` and `abs_means2d` are per pixel, not per radian as in `BlendGradients`.

    d_image: (H, W, 3), gradient of the loss with respect to the image.
    d_nearness: (H, W), gradient with respect to the nearness; None for 0.
    """
    if not camera.model.along_rays:
        return on_plane.render_grad(gaussians, camera, d_image, background, d_nearness=d_nearness)
    seen = tangents(gaussians, camera)
    screen = blend_grad(seen, camera.width, camera.height, background, d_image, d_nearness=d_nearness)
    by_parameter = tangents_grad(gaussians, camera, seen, screen)
    by_parameter["means"] += nearness_grad(parameters(gaussians)["means"], camera, screen.nearness)
    sides = pixel_sides(camera.model.footprints(camera, seen.directions)[2])
    screen = replace(screen, means2d=sides * screen.means2d, abs_means2d=sides * screen.abs_means2d)
    return GradientsTwin(**vars(screen), parameters=by_parameter, visible=seen.visible)
