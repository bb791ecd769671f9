#!/usr/bin/env python3
# SPDX-License-Identifier: Apache-2.0
"""Render a CG sphere for a shot's cameras, in place of another renderer, for docs/shot.md.

Each frame has three EXR files: beauty, depth and deep samples.

    .venv/bin/python tools/bench/cg_sphere.py shot.json --centre 0,0,0 --radius 0.5 -o cg

The cameras may come from any file that `clsplat render --cameras` takes, and must be perspective; centre and radius are
in their world. Writes cg/beauty.####.exr (R G B A, premultiplied, linear Rec.709), cg/depth.####.exr (nearest Z) and
cg/deep.####.exr (a sample with A and Z in each pixel that the sphere covers at least partly).
"""

from __future__ import annotations

import argparse
import sys
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import NDArray

sys.path.insert(0, str(Path(__file__).resolve().parents[2]))
sys.path.insert(0, str(Path(__file__).resolve().parents[2] / "tests" / "support"))

from cg import sphere, sphere_samples, write_flat, write_samples

from clsplat.camera import Camera
from clsplat.shots import choose_shot

FINE = 8
"""Number of rays in a pixel, across and down."""
LIGHT = np.array([-0.4, -0.7, -0.6]) / np.linalg.norm([0.4, 0.7, 0.6])
"""Direction to the light, in the camera's space: from the upper left, behind the camera."""
COLOUR = np.array([0.8, 0.25, 0.05])


def main(arguments: list[str]) -> int:
    """Write the files of every frame."""
    parser = argparse.ArgumentParser(description="A CG sphere of a shot, as beauty, depth and deep EXR.")
    parser.add_argument("cameras", type=Path)
    parser.add_argument("--centre", required=True, help="X,Y,Z in the cameras' world")
    parser.add_argument("--radius", type=float, required=True)
    parser.add_argument("-o", "--output", type=Path, required=True, help="folder")
    asked = parser.parse_args(arguments)
    asked.output.mkdir(parents=True, exist_ok=True)
    centre = np.array([float(word) for word in asked.centre.split(",")])
    for frame in choose_shot(asked.cameras).frames:
        beauty, samples, near = cast(frame.camera, centre, asked.radius)
        size, number = (frame.camera.width, frame.camera.height), f"{frame.number:04d}.exr"
        write_flat(asked.output / f"beauty.{number}", dict(zip("RGBA", np.moveaxis(beauty, 2, 0), strict=True)))
        write_flat(asked.output / f"depth.{number}", {"Z": near})
        write_samples(asked.output / f"deep.{number}", size, samples)
    return 0


def cast(
    camera: Camera, centre: NDArray[Any], radius: float
) -> tuple[NDArray[Any], list[list[list[float]]], NDArray[Any]]:
    """Beauty (H, W, 4), deep samples and nearest depths (H, W) of a sphere.

    A pixel in which a ray hits the sphere has one deep sample [alpha, mean depth]; others have none and infinite depth.
    """
    middle = camera.rotation @ centre + camera.translation
    fine = camera.resized(camera.width * FINE, camera.height * FINE)
    x, y = (np.arange(fine.width) + 0.5 - fine.cx) / fine.fx, (np.arange(fine.height) + 0.5 - fine.cy) / fine.fy
    rays = np.stack(np.broadcast_arrays(x, y[:, None], 1.0), axis=2)
    depth = sphere(fine, middle, radius)
    hit = np.isfinite(depth)
    normal = (rays * np.where(hit, depth, 0)[:, :, None] - middle) / radius
    shade = 0.15 + 0.85 * np.maximum(normal @ LIGHT, 0)
    picture = np.concatenate([shade[:, :, None] * COLOUR, np.ones((*hit.shape, 1))], axis=2) * hit[:, :, None]
    beauty = picture.reshape(camera.height, FINE, camera.width, FINE, 4).mean(axis=(1, 3))
    depths = depth.reshape(camera.height, FINE, camera.width, FINE)
    return beauty, sphere_samples(camera, middle, radius, FINE), depths.min(axis=(1, 3))


if __name__ == "__main__":
    sys.exit(main(sys.argv[1:]))
