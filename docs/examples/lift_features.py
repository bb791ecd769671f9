# SPDX-License-Identifier: Apache-2.0
"""Lift features of pictures to the Gaussians, by gradients of any number of channels."""

import torch

from clsplat.torch import rasterization

torch.manual_seed(0)
count, channels, width, height = 500, 16, 80, 60
means = torch.rand(count, 3) * 2 - 1
shape = (means, torch.randn(count, 4), torch.rand(count, 3) * 0.15 + 0.05, torch.full((count,), 0.9))
lens = torch.tensor([[70.0, 0, 40], [0, 70, 30], [0, 0, 1]]).expand(6, 3, 3)
views = torch.eye(4).repeat(6, 1, 1)
for view, angle in zip(views, torch.arange(6) * torch.pi / 3, strict=True):
    sin, cos = torch.sin(angle), torch.cos(angle)
    view[:3] = torch.tensor([[cos, 0, sin, 0], [0, 1, 0, 0], [-sin, 0, cos, 3.5]])

# in place of a network's features of six photographs: a feature for each octant of the scene, as the cameras see it
octants = (means > 0).int() @ torch.tensor([1, 2, 4], dtype=torch.int32)
table = torch.randn(8, channels)
seen, alphas, _ = rasterization(*shape, table[octants], views, lens, width, height)

features = torch.zeros(count, channels, requires_grad=True)
optimizer = torch.optim.Adam([features], lr=0.1)
for _ in range(60):
    images, _, _ = rasterization(*shape, features, views, lens, width, height)
    loss = ((images - seen).square() * alphas).mean()
    optimizer.zero_grad()
    loss.backward()
    optimizer.step()

nearest = torch.cdist(features.detach(), table).argmin(1)
print(f"octant found of {100 * (nearest == octants).float().mean():.1f} % of the Gaussians")
