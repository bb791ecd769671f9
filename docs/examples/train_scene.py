# SPDX-License-Identifier: Apache-2.0
"""Train a scene with a loop of one's own, and look at it from a view that was held out."""

import torch

from clsplat.demo.ray_caster import Ball, Floor, bake, cameras, render
from clsplat.torch import rasterization

torch.manual_seed(0)
width, height = 96, 72
blue = ((0.1, 0.2, 0.4), (0.9, 0.9, 0.8))
surfaces = [Floor(128, 128), Ball(64, 128, centre=(0.0, 0.0, 0.5), radius=0.5, palette=blue)]
bake(surfaces, seed=0)
poses = cameras(24, width, height, seed=0)
photos = torch.stack([torch.tensor(render(surfaces, pose)) for pose in poses])
views = torch.eye(4).repeat(len(poses), 1, 1)
for view, pose in zip(views, poses, strict=True):
    view[:3, :3], view[:3, 3] = torch.tensor(pose.rotation), torch.tensor(pose.translation)
lens = torch.tensor([[poses[0].fx, 0, width / 2], [0, poses[0].fy, height / 2], [0, 0, 1]]).float()[None]

# to start from, points on the surfaces, in place of those of structure from motion
means = torch.cat([torch.tensor(surface.grid(48, 48)[0]) for surface in surfaces])
count = len(means)
turns, log_scales, logits = torch.randn(count, 4), torch.full((count, 3), -2.3), torch.full((count,), 0.0)
parameters = [means, turns, log_scales, logits, torch.full((count, 3), 0.5)]
rates = [3e-3, 1e-2, 2e-2, 5e-2, 4e-2]
optimizer = torch.optim.Adam(
    [{"params": [each.requires_grad_()], "lr": rate} for each, rate in zip(parameters, rates, strict=True)]
)


def draw(index: int) -> torch.Tensor:
    """The image (height, width, 3) of a view."""
    means, turns, log_scales, logits, colors = parameters
    view = views[index : index + 1]
    images, _, _ = rasterization(means, turns, log_scales.exp(), logits.sigmoid(), colors, view, lens, width, height)
    return images[0]


for step in range(200):
    index = 1 + step % (len(poses) - 1)  # the first is held out
    loss = (draw(index) - photos[index]).abs().mean()
    optimizer.zero_grad()
    loss.backward()
    optimizer.step()

print(f"PSNR {-10 * (draw(0) - photos[0]).square().mean().log10():.2f} dB in the view that was held out")
