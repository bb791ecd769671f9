# SPDX-License-Identifier: Apache-2.0
"""Writing of COLMAP models as text (https://colmap.github.io/format.html)."""

from __future__ import annotations

from collections.abc import Sequence
from pathlib import Path

import numpy as np

from clsplat.arrays import Float32, Float64
from clsplat.camera import Camera
from clsplat.files.atomic import atomic_write
from clsplat.rotations import quaternion_of
from clsplat.scenes.dataset import Lens


def write_model(folder: Path, images: Sequence[tuple[str, Lens, Camera]], points: Float64, colors: Float32) -> None:
    """Create the folder and write cameras.txt, images.txt and points3D.txt into it, without observations.

    images: (name, lens, camera) of each image. The lens has the intrinsics, and the camera the pose.
    points: (N, 3), world coordinates. Their tracks are empty and errors 0.
    colors: (N, 3) in [0, 1].
    """
    folder.mkdir(parents=True, exist_ok=True)
    numbers: dict[Lens, int] = {}
    for _, lens, _ in images:
        numbers.setdefault(lens, len(numbers) + 1)
    cameras = [
        f"{number} {lens.model} {lens.width} {lens.height} {_numbers(lens.params)}\n"
        for lens, number in numbers.items()
    ]
    poses = [
        f"{index} {_numbers((*quaternion_of(camera.rotation), *camera.translation))} {numbers[lens]} {name}\n\n"
        for index, (name, lens, camera) in enumerate(images, 1)
    ]
    levels = np.rint(np.clip(colors, 0, 1) * 255).astype(int).tolist()
    places = [
        f"{index} {_numbers(point)} {' '.join(map(str, level))} 0\n"
        for index, (point, level) in enumerate(zip(points.tolist(), levels, strict=True), 1)
    ]
    for stem, lines in (("cameras", cameras), ("points3D", places), ("images", poses)):
        atomic_write(folder / f"{stem}.txt", "".join(lines).encode())


def _numbers(values: Sequence[float]) -> str:
    return " ".join(repr(float(value)) for value in values)
