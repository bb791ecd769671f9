# SPDX-License-Identifier: Apache-2.0
"""Move Gaussians to a surface by a loss on expected depth."""

import torch

from clsplat.torch import rasterization

torch.manual_seed(0)
width, height = 80, 60
lens = torch.tensor([[[60.0, 0, 40], [0, 60, 30], [0, 0, 1]]])

# the depth map: a ball of radius 1 at distance 4 before a wall at 5, in world units along z
y, x = torch.meshgrid((torch.arange(height) + 0.5 - 30) / 60, (torch.arange(width) + 0.5 - 40) / 60, indexing="ij")
squared = x.square() + y.square() + 1
inside = 16 - squared * 15
depth = torch.where(inside > 0, (4 - inside.clamp(min=0).sqrt()) / squared, torch.tensor(5.0))

# a Gaussian for each second pixel, all at distance 4.5
rays = torch.stack([x, y, torch.ones_like(x)], -1)[::2, ::2].reshape(-1, 3)
distances = torch.full((len(rays), 1), 4.5, requires_grad=True)
optimizer = torch.optim.Adam([distances], lr=0.03)
turns = torch.tensor([1.0, 0, 0, 0]).expand(len(rays), 4)
sizes, opacities, colors = torch.full((len(rays), 3), 0.08), torch.full((len(rays),), 0.95), torch.ones(len(rays), 1)
for _ in range(150):
    images, alphas, _ = rasterization(
        rays * distances, turns, sizes, opacities, colors, torch.eye(4)[None], lens, width, height, render_mode="RGB+ED"
    )
    loss = ((images[0, :, :, -1] - depth).abs() * alphas[0, :, :, 0]).mean()
    optimizer.zero_grad()
    loss.backward()
    optimizer.step()

error = (images[0, :, :, -1] - depth).abs()
print(f"median error of depth {error.median():.4f}, at first {(4.5 - depth).abs().median():.4f}")
