# SPDX-License-Identifier: Apache-2.0
"""Known depths for the tiny scene: tracks of its points, or depth maps."""

from __future__ import annotations

from pathlib import Path

import numpy as np
from numpy.typing import NDArray
from pictures import write_pixels
from tiny import HEIGHT, WIDTH, cameras, hidden_model

from clsplat.images.writing import write_image


def add_tracks(scene: Path, error: float = 0.5) -> None:
    """Add tracks to points3D.txt: even points are seen by even images, odd points by odd images.

    error: the reprojection error of each point.
    """
    path = scene / "sparse" / "0" / "points3D.txt"
    rows = []
    for number, line in enumerate(path.read_text().splitlines()):
        words = line.split()
        seen = " ".join(f"{image + 1} 0" for image in range(number % 2, len(cameras()), 2))
        rows.append(f"{' '.join(words[:7])} {error} {seen}\n")
    path.write_text("".join(rows))


def depth_of(index: int) -> NDArray[np.float64]:
    """Depth (H, W) of a plane through the middle of the hidden model, which faces camera `index`, with a slope.

    The left quarter has no depth: 0.
    """
    distance = float(np.linalg.norm(cameras()[index].position - hidden_model().means.mean(axis=0)))
    x = np.arange(WIDTH)[None, :] + 0.5 + np.zeros((HEIGHT, 1))
    return np.where(x < WIDTH / 4, 0.0, distance + 0.5 * (x / WIDTH - 0.5))


def add_maps(scene: Path, kind: str = ".png", folder: str = "depths") -> None:
    """Write a depth map for each picture: in thousandths as .png, in world units as .exr or .npy."""
    target = scene / folder
    target.mkdir()
    for index in range(len(cameras())):
        depth = depth_of(index)
        if kind == ".npy":
            np.save(target / f"{index:02d}.npy", depth.astype(np.float32))
        elif kind == ".exr":
            write_image(target / f"{index:02d}.exr", np.repeat(depth[:, :, None], 3, axis=2).astype(np.float32))
        else:
            write_pixels(target / f"{index:02d}.png", np.rint(1000 * depth[:, :, None]).astype(np.uint16))
