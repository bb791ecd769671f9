# SPDX-License-Identifier: Apache-2.0
"""Find the camera of a photograph by the gradient of the view matrix."""

import torch

from clsplat.torch import rasterization

torch.manual_seed(0)
count, width, height = 300, 96, 72
scene = (
    torch.rand(count, 3) * 2 - 1,  # means
    torch.randn(count, 4),  # quaternions
    torch.rand(count, 3) * 0.15 + 0.05,  # scales
    torch.rand(count) * 0.5 + 0.5,  # opacities
    torch.rand(count, 3),  # colours
)
lens = torch.tensor([[[90.0, 0, 48], [0, 90, 36], [0, 0, 1]]])


def view_of(motion: torch.Tensor) -> torch.Tensor:
    """The view matrix (1, 4, 4) of a motion (6,), a turn about the scene and a shift, from four units before it."""
    start = torch.eye(4)
    start[2, 3] = 4.0
    x, y, z, *shift = motion
    zero = torch.zeros(())
    rows = [[zero, -z, y, shift[0]], [z, zero, -x, shift[1]], [-y, x, zero, shift[2]], [zero] * 4]
    return (start @ torch.linalg.matrix_exp(torch.stack([torch.stack(row) for row in rows])))[None]


true = torch.tensor([0.10, -0.08, 0.05, 0.15, -0.10, 0.20])  # radians and world units
photo, _, _ = rasterization(*scene, view_of(true), lens, width, height)

motion = torch.zeros(6, requires_grad=True)
optimizer = torch.optim.Adam([motion], lr=0.02)
for _ in range(150):
    image, _, _ = rasterization(*scene, view_of(motion), lens, width, height)
    loss = (image - photo).square().mean()
    optimizer.zero_grad()
    loss.backward()
    optimizer.step()

print(f"off by {(motion - true).norm():.4f}, at first {true.norm():.4f}")
