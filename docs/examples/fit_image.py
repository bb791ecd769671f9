# SPDX-License-Identifier: Apache-2.0
"""Fit a picture with Gaussians that lie flat in one plane."""

import torch

from clsplat.torch import rasterization

torch.manual_seed(0)
count, width, height = 400, 96, 64

# the picture: a disc and a stripe on a slow gradient
y, x = torch.meshgrid(torch.arange(height) + 0.5, torch.arange(width) + 0.5, indexing="ij")
disc, stripe = (x - 34).hypot(y - 30) < 18, ((x + y) % 40 < 12) & (x > 56)
picture = torch.stack([x / width, y / height, 0.3 + 0.4 * disc], -1)
picture[stripe] = torch.tensor([0.9, 0.8, 0.1])

# an orthographic camera of a unit a pixel looks at the plane z = 1 along z
view, lens = torch.eye(4)[None], torch.eye(3)[None]
means = (torch.rand(count, 2) * torch.tensor([width, height])).requires_grad_()
log_scales = torch.full((count, 2), 1.0).requires_grad_()
angles, logits, colors = torch.zeros(count, 1), torch.zeros(count), torch.rand(count, 3)
parameters = [means, log_scales, *(each.requires_grad_() for each in (angles, logits, colors))]
optimizer = torch.optim.Adam([{"params": [means], "lr": 0.3}, {"params": parameters[1:], "lr": 0.05}])

for _ in range(200):
    places = torch.cat([means, torch.ones(count, 1)], 1)
    turns = torch.cat([torch.cos(angles), torch.zeros(count, 2), torch.sin(angles)], 1)  # about z
    sizes = torch.cat([log_scales.exp(), torch.full((count, 1), 1e-3)], 1)
    images, _, _ = rasterization(
        places, turns, sizes, logits.sigmoid(), colors, view, lens, width, height, camera_model="ortho"
    )
    loss = (images[0] - picture).abs().mean()
    optimizer.zero_grad()
    loss.backward()
    optimizer.step()

print(f"PSNR {-10 * (images[0] - picture).square().mean().log10():.2f} dB")
