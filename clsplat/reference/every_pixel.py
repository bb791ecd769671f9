# SPDX-License-Identifier: Apache-2.0
"""Pictures of any projection in float64, every Gaussian at every pixel: no tiles, no boxes, no bounds. Equation numbers
are those of docs/gradients.md (14 to 16) and docs/channels.md (60 to 64)."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass

import numpy as np

from clsplat.arrays import Float64
from clsplat.camera import Camera
from clsplat.gaussians import Gaussians
from clsplat.reference.blend import ALPHA_MAX, TRANSMITTANCE_MIN
from clsplat.reference.cameras import cam_from_pixel, pixel_grid
from clsplat.reference.channels import motions, normals
from clsplat.reference.project import ALPHA_MIN, Projected, project
from clsplat.reference.rays import Tangents, ray_alphas, tangents
from clsplat.reference.render import parameters
from clsplat.reference.sort import depth_order


@dataclass(frozen=True, eq=False)
class Picture:
    """image (H, W, 3), alpha, depth (H, W), normal, position (H, W, 3), motion (H, W, 2): 0 where nothing is; margin
    (H, W): as of `reference.blend`."""

    image: Float64
    alpha: Float64
    depth: Float64
    normal: Float64
    position: Float64
    motion: Float64
    margin: Float64


def render(
    gaussians: Gaussians,
    camera: Camera,
    background: Float64 | tuple[float, float, float] = (0.0, 0.0, 0.0),
    after: Camera | None = None,
) -> Picture:
    """Front to back by depth. after: the camera that motion goes to. A pixel without a ray shows the background."""
    arrays = parameters(gaussians)
    projected, alphas = _alphas(gaussians, arrays, camera)
    means = arrays["means"]
    rows = np.concatenate(
        [
            projected.colors,
            projected.depths[:, None],
            normals(means, arrays["quaternions"], arrays["log_scales"], camera),
            means,
            motions(means, camera, after or camera),
        ],
        axis=1,
    )
    count = camera.width * camera.height
    sums, total = np.zeros((count, rows.shape[1])), np.zeros(count)
    transmittance, alive, margin = np.ones(count), np.ones(count, np.bool_), np.full(count, 0.05)
    for gaussian in depth_order(projected.depths, projected.visible):
        raw = alphas(int(gaussian))
        alpha = np.minimum(ALPHA_MAX, raw)
        seen = alive & (alpha >= ALPHA_MIN)
        left = transmittance * (1 - alpha)
        added = seen & (left > TRANSMITTANCE_MIN)
        near = np.minimum(np.abs(raw / ALPHA_MIN - 1), np.abs(raw / ALPHA_MAX - 1))
        near = np.minimum(near, np.where(seen, np.abs(left / TRANSMITTANCE_MIN - 1), np.inf))
        margin = np.where(alive, np.minimum(margin, near), margin)
        weight = np.where(added, transmittance * alpha, 0.0)
        sums += weight[:, None] * rows[gaussian]
        total += weight
        transmittance = np.where(added, left, transmittance)
        alive &= added | ~seen
    mean_rows = sums / np.where(total > 0, total, 1.0)[:, None]
    length = np.linalg.norm(sums[:, 4:7], axis=1, keepdims=True)

    def plane(values: Float64) -> Float64:
        return values.reshape(camera.height, camera.width, *values.shape[1:])

    return Picture(
        image=plane(sums[:, :3] + transmittance[:, None] * np.asarray(background, np.float64)),
        alpha=plane(1 - transmittance),
        depth=plane(mean_rows[:, 3]),
        normal=plane(sums[:, 4:7] / np.where(length > 0, length, 1.0)),
        position=plane(mean_rows[:, 7:10]),
        motion=plane(mean_rows[:, 10:12]),
        margin=plane(margin),
    )


def _alphas(
    gaussians: Gaussians, arrays: dict[str, Float64], camera: Camera
) -> tuple[Projected | Tangents, Callable[[int], Float64]]:
    """The projected Gaussians, and a function of a Gaussian: opacity times falloff at each pixel (P,), not yet
    clamped."""
    pixels = pixel_grid(camera)
    if not camera.kind.flat:
        t = tangents(gaussians, camera)
        rays = np.nan_to_num(cam_from_pixel(camera, pixels)[1])
        return t, lambda gaussian: ray_alphas(t, gaussian, rays)
    if camera.window is not None:
        pixels -= [camera.window.x, camera.window.y]  # as the means are counted
    p = project(**arrays, camera=camera, sh_degree=gaussians.sh_degree)

    def on_the_plane(gaussian: int) -> Float64:
        sxx, sxy, syy = p.covariances[gaussian]
        d = pixels - p.means2d[gaussian]
        q = np.einsum("ni,ij,nj->n", d, np.linalg.inv(np.array([[sxx, sxy], [sxy, syy]])), d)
        raw: Float64 = p.opacities[gaussian] * np.exp(-0.5 * q)
        return raw

    return p, on_the_plane
