# SPDX-License-Identifier: Apache-2.0
"""Pictures of any projection in float64, every Gaussian at every pixel: no tiles, no boxes, no bounds. Equation numbers
are those of docs/gradients.md (14 to 16) and docs/channels.md (60 to 64)."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, replace

import numpy as np

from clsplat.arrays import Float64
from clsplat.camera import Camera
from clsplat.gaussians import Gaussians
from clsplat.reference import render as on_plane
from clsplat.reference.blend import blend, blend_grad
from clsplat.reference.channels import Channels, channels
from clsplat.reference.depth import nearness_grad
from clsplat.reference.project import Footprint, Projected, Seen, project
from clsplat.reference.rays import footprints, pixel_sides, tangents, tangents_grad
from clsplat.reference.render import BLACK, Gradients, parameters


@dataclass(frozen=True, eq=False)
class Picture(Channels):
    """image (H, W, 3), alpha (H, W); margin, nearness (H, W): as of `reference.blend`."""

    image: Float64
    alpha: Float64
    margin: Float64
    nearness: Float64


class _Unbounded(Projected):
    """Gaussians on the image plane, whose boxes are the whole image."""

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
    background: Sequence[float] | Float64 = BLACK,
    after: Camera | None = None,
) -> Picture:
    """Front to back by depth. after: the camera that motion goes to. A pixel without a ray shows the background."""
    seen: Seen
    if not camera.kind.rays:
        degree, antialiased = gaussians.sh_degree, gaussians.antialiased
        projected = project(**parameters(gaussians), camera=camera, sh_degree=degree, antialiased=antialiased)
        seen = _Unbounded(**vars(projected))
    else:
        seen = tangents(gaussians, camera)
    blended = blend(seen, camera.width, camera.height, background)
    others = channels(seen, gaussians, camera, after or camera)
    if (of_distances := camera.depths_of_distances()) is not None:
        depths = {name: getattr(others, name) * of_distances for name in ("depth", "median", "first")}
        others = replace(others, **depths)
    alpha, margin, nearness = 1 - blended.transmittance, blended.margin, blended.nearness
    return Picture(**vars(others), image=blended.image, alpha=alpha, margin=margin, nearness=nearness)


def render_grad(
    gaussians: Gaussians,
    camera: Camera,
    d_image: Float64,
    background: Sequence[float] | Float64 = BLACK,
    d_nearness: Float64 | None = None,
) -> Gradients:
    """Gradients of a loss with dL/dimage = d_image (H, W, 3), and by nearness (H, W), of a
    camera of any projection; those of means on the
    image of rays are along the axes of the tangent plane, per pixel there."""
    if not camera.kind.rays:
        return on_plane.render_grad(gaussians, camera, d_image, background, d_nearness=d_nearness)
    seen = tangents(gaussians, camera)
    screen = blend_grad(seen, camera.width, camera.height, background, d_image, d_nearness=d_nearness)
    by_parameter = tangents_grad(gaussians, camera, seen, screen)
    by_parameter["means"] += nearness_grad(parameters(gaussians)["means"], camera, screen.nearness)
    sides = pixel_sides(footprints(seen.directions, camera)[2])
    on_image = {"means2d": sides * screen.means2d, "abs_means2d": sides * screen.abs_means2d}
    return Gradients(**{**vars(screen), **on_image}, parameters=by_parameter, visible=seen.visible)
