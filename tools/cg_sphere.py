#!/usr/bin/env python3
# SPDX-License-Identifier: Apache-2.0
"""A CG sphere as another renderer would make it of a shot, for docs/shot.md: beauty, depth and deep EXR of each frame.

    .venv/bin/python tools/cg_sphere.py shot.json --centre 0,0,0 --radius 0.5 -o cg

The cameras are perspective ones of any file that `clsplat render --cameras` takes; centre and radius are in their
world. Writes cg/beauty.####.exr (R G B A, associated, linear Rec.709), cg/depth.####.exr (Z alone, the nearest) and
cg/deep.####.exr (a sample with A and Z in each pixel that the sphere covers a part of).
"""

from __future__ import annotations

import argparse
import sys
from pathlib import Path
from typing import Any

import numpy as np
import OpenImageIO as oiio
from numpy.typing import NDArray

sys.path.insert(0, str(Path(__file__).resolve().parents[1]))

from clsplat.camera import Camera
from clsplat.shots import choose_shot

FINE = 8
"""Rays of a pixel across and down."""
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
        beauty, depth, near = cast(frame.camera, centre, asked.radius)
        size, number = (frame.camera.width, frame.camera.height), f"{frame.number:04d}.exr"
        write(asked.output / f"beauty.{number}", size, ("R", "G", "B", "A"), beauty)
        write(asked.output / f"depth.{number}", size, ("Z",), near[:, :, None])
        write_deep(asked.output / f"deep.{number}", size, beauty[:, :, 3], depth)
    return 0


def cast(camera: Camera, centre: NDArray[Any], radius: float) -> tuple[NDArray[Any], NDArray[Any], NDArray[Any]]:
    """(beauty (H, W, 4), the mean depth of what is hit in a pixel, the nearest), infinite where nothing is."""
    middle = camera.rotation @ centre + camera.translation
    fine = camera.resized(camera.width * FINE, camera.height * FINE)
    x, y = (np.arange(fine.width) + 0.5 - fine.cx) / fine.fx, (np.arange(fine.height) + 0.5 - fine.cy) / fine.fy
    rays = np.stack(np.broadcast_arrays(x, y[:, None], 1.0), axis=2)
    along, square = rays @ middle, (rays**2).sum(axis=2)
    root = along**2 - square * (middle @ middle - radius**2)
    hit = root > 0
    depth = np.where(hit, (along - np.sqrt(np.maximum(root, 0))) / square, np.inf)
    normal = (rays * np.where(hit, depth, 0)[:, :, None] - middle) / radius
    shade = 0.15 + 0.85 * np.maximum(normal @ LIGHT, 0)
    picture = np.concatenate([shade[:, :, None] * COLOUR, np.ones((*hit.shape, 1))], axis=2) * hit[:, :, None]

    def blocks(values: NDArray[Any]) -> NDArray[Any]:
        return (
            values.reshape(camera.height, FINE, camera.width, FINE, -1)
            .swapaxes(1, 2)
            .reshape(camera.height, camera.width, FINE * FINE, -1)
        )

    beauty, hits, depths = blocks(picture).mean(axis=2), blocks(hit)[..., 0], blocks(depth)[..., 0]
    count = hits.sum(axis=2)
    mean = np.where(hits, depths, 0).sum(axis=2) / np.maximum(count, 1)
    return beauty, np.where(count > 0, mean, np.inf), depths.min(axis=2)


def specification(size: tuple[int, int], names: tuple[str, ...]) -> Any:
    """OpenImageIO's, of floats."""
    spec = oiio.ImageSpec(*size, len(names), oiio.FLOAT)
    spec.channelnames = names
    return spec


def write(path: Path, size: tuple[int, int], names: tuple[str, ...], pixels: NDArray[Any]) -> None:
    """Write a flat EXR."""
    output = oiio.ImageOutput.create(str(path))
    if not output.open(str(path), specification(size, names)) or not output.write_image(np.float32(pixels)):
        raise SystemExit(f"{path}: {output.geterror()}")
    output.close()


def write_deep(path: Path, size: tuple[int, int], alpha: NDArray[Any], depth: NDArray[Any]) -> None:
    """Write a deep EXR with one sample where alpha is above 0."""
    spec = specification(size, ("A", "Z"))
    spec.deep = True
    data = oiio.DeepData()
    data.init(alpha.size, 2, [oiio.TypeDesc("float")] * 2, ["A", "Z"])
    covered = np.nonzero(alpha.ravel() > 0)[0].tolist()
    for pixel in covered:
        data.set_samples(pixel, 1)
    for pixel in covered:
        data.set_deep_value(pixel, 0, 0, float(alpha.ravel()[pixel]))
        data.set_deep_value(pixel, 1, 0, float(depth.ravel()[pixel]))
    output = oiio.ImageOutput.create(str(path))
    if not output.open(str(path), spec) or not output.write_deep_image(data):
        raise SystemExit(f"{path}: {output.geterror()}")
    output.close()


if __name__ == "__main__":
    sys.exit(main(sys.argv[1:]))
