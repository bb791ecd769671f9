# SPDX-License-Identifier: Apache-2.0
"""Slow reference of `clsplat.torch.rasterization` in float64 PyTorch, which evaluates every Gaussian at every pixel.

It shares no code with gsplat, and with clsplat only constants of spherical harmonics.
"""

from __future__ import annotations

import math
from dataclasses import dataclass

import torch
from torch import Tensor

from clsplat.spherical_harmonics import SH_C0, SH_C1, SH_C2, SH_C3

ALPHA_LEAST, STOP = 1 / 255, 1e-4
NEAR_EDGE = 1e-3
"""Relative distance of an alpha from a threshold within which a pixel is not steady; ten times that of a transmittance.

At an exponent of about 10, alpha has a relative error of about 1e-4 in float32.
"""


@dataclass
class Projected:
    """Splats of C cameras: means2d (C, N, 2), conics (C, N, 3), depths, compensations (C, N), radii (C, N, 2) int."""

    means2d: Tensor
    conics: Tensor
    depths: Tensor
    compensations: Tensor
    radii: Tensor


@dataclass
class Dense:
    """Images (C, H, W, X), alphas (C, H, W, 1), and the projected splats.

    steady: (C, H, W), True for pixels where no value is close to a threshold.
    """

    images: Tensor
    alphas: Tensor
    steady: Tensor
    splats: Projected


def rotations(quats: Tensor) -> Tensor:
    """Rotation matrices (..., 3, 3) of quaternions (..., 4), w x y z, of any length."""
    w, x, y, z = (quats / quats.norm(dim=-1, keepdim=True)).unbind(-1)
    rows = [
        [1 - 2 * (y * y + z * z), 2 * (x * y - w * z), 2 * (x * z + w * y)],
        [2 * (x * y + w * z), 1 - 2 * (x * x + z * z), 2 * (y * z - w * x)],
        [2 * (x * z - w * y), 2 * (y * z + w * x), 1 - 2 * (x * x + y * y)],
    ]
    return torch.stack([torch.stack(row, -1) for row in rows], -2)


def covariances(quats: Tensor, scales: Tensor) -> Tensor:
    """Covariances (..., 3, 3)."""
    half = rotations(quats) * scales[..., None, :]
    return half @ half.mT


def harmonics(degree: int, directions: Tensor, coefficients: Tensor) -> Tensor:
    """Colours (..., 3) from directions (..., 3) of any length and coefficients (..., K, 3)."""
    x, y, z = (directions / directions.norm(dim=-1, keepdim=True)).unbind(-1)
    basis = [torch.full_like(x, SH_C0)]
    if degree > 0:
        basis += [-SH_C1 * y, SH_C1 * z, -SH_C1 * x]
    if degree > 1:
        basis += [SH_C2[0] * x * y, SH_C2[1] * y * z, SH_C2[2] * (2 * z * z - x * x - y * y), SH_C2[3] * x * z]
        basis += [SH_C2[4] * (x * x - y * y)]
    if degree > 2:
        basis += [SH_C3[0] * y * (3 * x * x - y * y), SH_C3[1] * x * y * z, SH_C3[2] * y * (4 * z * z - x * x - y * y)]
        basis += [SH_C3[3] * z * (2 * z * z - 3 * x * x - 3 * y * y), SH_C3[4] * x * (4 * z * z - x * x - y * y)]
        basis += [SH_C3[5] * z * (x * x - y * y), SH_C3[6] * x * (x * x - 3 * y * y)]
    if degree > 3:  # by Legendre's functions of z, times the sines and cosines of m times the azimuth
        square = z * z
        sines, cosines = [y, 2 * x * y], [x, x * x - y * y]
        for _ in range(2):
            sines, cosines = [*sines, x * sines[-1] + y * cosines[-1]], [*cosines, x * cosines[-1] - y * sines[-1]]
        of_z = [z * (7 * square - 3), 7 * square - 1, z, torch.ones_like(z)]
        sizes = [-3 / 4 * (5 / (2 * math.pi)) ** 0.5, 3 / 8 * (5 / math.pi) ** 0.5]
        sizes += [-3 / 4 * (35 / (2 * math.pi)) ** 0.5, 3 / 16 * (35 / math.pi) ** 0.5]
        basis += [size * value * sine for size, value, sine in zip(sizes[::-1], of_z[::-1], sines[::-1], strict=True)]
        basis += [3 / 16 / math.pi**0.5 * (35 * square * square - 30 * square + 3)]
        basis += [size * value * cosine for size, value, cosine in zip(sizes, of_z, cosines, strict=True)]
    return (torch.stack(basis, -1)[..., None] * coefficients[..., : len(basis), :]).sum(-2)


def _jacobian(model: str, at: Tensor, Ks: Tensor, width: int, height: int) -> tuple[Tensor, Tensor]:
    """Pixels (C, N, 2) of points `at` (C, N, 3) in the camera's space, and the projection's derivative (C, N, 2, 3)."""
    fx, fy, cx, cy = (Ks[:, row, column, None] for row, column in ((0, 0), (1, 1), (0, 2), (1, 2)))
    x, y, z = at.unbind(-1)
    none = torch.zeros_like(z)
    if model == "ortho":
        rows = [[fx + none, none, none], [none, fy + none, none]]
        means2d = torch.stack([fx * x + cx, fy * y + cy], -1)
    elif model == "fisheye":
        across2 = x * x + y * y
        across = across2.sqrt()
        angle = torch.atan2(across, z)
        whole = across2 + z * z
        means2d = torch.stack([fx * x * angle / across + cx, fy * y * angle / across + cy], -1)
        radial, round_ = z / (whole * across2), angle / (across * across2)
        rows = [
            [fx * (x * x * radial + y * y * round_), fx * x * y * (radial - round_), -fx * x / whole],
            [fy * x * y * (radial - round_), fy * (y * y * radial + x * x * round_), -fy * y / whole],
        ]
    else:
        means2d = torch.stack([fx * x / z + cx, fy * y / z + cy], -1)
        margin_x, margin_y = 0.15 * width / fx, 0.15 * height / fy
        slope_x = (x / z).clamp(-cx / fx - margin_x, (width - cx) / fx + margin_x)
        slope_y = (y / z).clamp(-cy / fy - margin_y, (height - cy) / fy + margin_y)
        rows = [[fx / z, none, -fx * slope_x / z], [none, fy / z, -fy * slope_y / z]]
    return means2d, torch.stack([torch.stack(row, -1) for row in rows], -2)


def project(
    means: Tensor,
    covars: Tensor,
    opacities: Tensor | None,
    viewmats: Tensor,
    Ks: Tensor,
    width: int,
    height: int,
    *,
    near_plane: float = 0.01,
    far_plane: float = 1e10,
    radius_clip: float = 0.0,
    eps2d: float = 0.3,
    camera_model: str = "pinhole",
    antialiased: bool = False,
) -> Projected:
    """Project means (N, 3), covars (N, 3, 3) and opacities (N,) by viewmats (C, 4, 4) and Ks (C, 3, 3)."""
    turn = viewmats[:, :3, :3]
    at = means @ turn.mT + viewmats[:, None, :3, 3]
    means2d, jacobian = _jacobian(camera_model, at, Ks, width, height)
    whole = jacobian @ turn[:, None]
    sharp = whole @ covars @ whole.mT
    blurred = sharp + eps2d * torch.eye(2, dtype=sharp.dtype)
    xx, xy, yy = blurred[..., 0, 0], blurred[..., 0, 1], blurred[..., 1, 1]
    determinant = xx * yy - xy * xy
    conics = torch.stack([yy, -xy, xx], -1) / determinant[..., None]
    share = (sharp[..., 0, 0] * sharp[..., 1, 1] - sharp[..., 0, 1] ** 2) / determinant
    compensations = share.clamp(min=0).sqrt()
    with torch.no_grad():
        extent = torch.full_like(xx, 3.33)
        keep = (at[..., 2] >= near_plane) & (at[..., 2] <= far_plane) & (determinant > 0)
        if opacities is not None:
            opacity = opacities * compensations if antialiased else opacities.expand_as(xx)
            keep &= opacity >= ALPHA_LEAST
            extent = extent.minimum((2 * (opacity / ALPHA_LEAST).clamp(min=1).log()).sqrt())
        radii = (extent[..., None] * torch.stack([xx, yy], -1).sqrt()).ceil()
        size = torch.tensor([width, height])
        keep &= ((means2d + radii > 0) & (means2d - radii < size)).all(-1) & (radii > radius_clip).any(-1)
        radii = torch.where(keep[..., None], radii, 0).int()
    return Projected(means2d, conics, at[..., 2], compensations, radii)


def composite(
    splats: Projected, colors: Tensor, opacities: Tensor, width: int, height: int, alpha_max: float
) -> tuple[Tensor, Tensor, Tensor]:
    """Blend colors (C, N, D) with opacities (C, N).

    Returns images without background, transmittances, and the steady pixels.
    """
    y, x = torch.meshgrid(torch.arange(height) + 0.5, torch.arange(width) + 0.5, indexing="ij")
    pixels = torch.stack([x, y], -1).reshape(-1, 2).double()
    images, left, steady = [], [], []
    for camera in range(len(colors)):
        seen = (splats.radii[camera] > 0).all(-1).nonzero()[:, 0]
        order = seen[splats.depths[camera, seen].argsort(stable=True)]
        dx, dy = (pixels[:, None] - splats.means2d[camera, order]).unbind(-1)
        a, b, c = splats.conics[camera, order].unbind(-1)
        sigma = 0.5 * (a * dx * dx + c * dy * dy) + b * dx * dy
        alpha = (opacities[camera, order] * torch.exp(-sigma)).clamp(max=alpha_max)
        alpha = torch.where(alpha >= ALPHA_LEAST, alpha, 0)
        after = (1 - alpha).cumprod(-1)
        with torch.no_grad():
            raw = opacities[camera, order] * torch.exp(-sigma)
            edge = ((raw / ALPHA_LEAST - 1).abs() < NEAR_EDGE) | ((raw / alpha_max - 1).abs() < NEAR_EDGE)
            edge |= (after / STOP - 1).abs() < 10 * NEAR_EDGE
        steady.append(~edge.any(-1))
        alpha = torch.where(after > STOP, alpha, 0)
        after = (1 - alpha).cumprod(-1)
        before = torch.cat([torch.ones_like(after[:, :1]), after[:, :-1]], -1)
        images.append((alpha * before) @ colors[camera, order])
        left.append(after[:, -1:] if len(order) else torch.ones(len(pixels), 1, dtype=pixels.dtype))
    shape = (len(colors), height, width)
    return (
        torch.stack(images).reshape(*shape, -1),
        torch.stack(left).reshape(*shape, 1),
        torch.stack(steady).reshape(shape),
    )


def rasterize(
    means: Tensor,
    quats: Tensor | None,
    scales: Tensor | None,
    opacities: Tensor,
    colors: Tensor,
    viewmats: Tensor,
    Ks: Tensor,
    width: int,
    height: int,
    *,
    sh_degree: int | None = None,
    backgrounds: Tensor | None = None,
    render_mode: str = "RGB",
    rasterize_mode: str = "classic",
    covars: Tensor | None = None,
    alpha_max: float = 0.999,
    camera_model: str = "pinhole",
    **limits: float,
) -> Dense:
    """Render with the arguments of `clsplat.torch.rasterization`, without batches. covars: (N, 3, 3)."""
    antialiased = rasterize_mode == "antialiased"
    if covars is None:
        assert quats is not None
        assert scales is not None
        covars = covariances(quats, scales)
    splats = project(
        means, covars, opacities, viewmats, Ks, width, height,
        camera_model=camera_model, antialiased=antialiased, **limits,
    )  # fmt: skip
    opacity = opacities * splats.compensations if antialiased else opacities.expand_as(splats.depths)
    if sh_degree is None:
        values = colors if colors.dim() == 3 else colors.expand(len(viewmats), *colors.shape)
    else:
        centres = torch.linalg.inv(viewmats)[:, None, :3, 3]
        values = (harmonics(sh_degree, means - centres, colors) + 0.5).clamp(min=0)
    depth = splats.depths[..., None]
    if render_mode != "RGB":
        values = torch.cat([values, depth], -1) if "+" in render_mode else depth
    images, left, steady = composite(splats, values, opacity, width, height, alpha_max)
    if backgrounds is not None:
        if render_mode != "RGB":
            backgrounds = torch.cat([backgrounds, torch.zeros_like(backgrounds[:, :1])], -1)
            backgrounds = backgrounds if "+" in render_mode else backgrounds[:, -1:]
        images = images + left * backgrounds[:, None, None]
    if "ED" in render_mode:
        images = torch.cat([images[..., :-1], images[..., -1:] / (1 - left).clamp(min=1e-10)], -1)
    return Dense(images, 1 - left, steady, splats)
