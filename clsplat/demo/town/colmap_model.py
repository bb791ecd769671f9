# SPDX-License-Identifier: Apache-2.0
"""Writing of a COLMAP model as binary files, with observations and tracks: https://colmap.github.io/format.html."""

from __future__ import annotations

import struct
from collections.abc import Iterable, Sequence
from dataclasses import dataclass
from pathlib import Path

import numpy as np
from numpy.typing import NDArray

from clsplat.arrays import Float64
from clsplat.files.atomic import atomic_writer
from clsplat.rotations import quaternion_of
from clsplat.scenes.dataset import Lens, colmap_camera_models

UNKNOWN_POINT = np.uint64(2**64 - 1)
"""Point number that COLMAP writes for an observation without a point."""
_OBSERVATION = np.dtype([("pixel", "<f8", 2), ("point", "<u8")])
"""Layout of an observation in images.bin: its position in pixels, and the number of its point."""
_COUNT = struct.Struct("<Q")


@dataclass(eq=False)
class ModelImage:
    """An image of a COLMAP model, with its observations.

    camera: number of the image's camera, from 1.
    rotation, translation: (3, 3) and (3,) float64, `cam_from_world`.
    pixels: (n, 2) float64, position of each observation in pixels.
    points: (n,) uint64, number of each observation's point; UNKNOWN_POINT for an observation without a point.
    """

    name: str
    camera: int
    rotation: Float64
    translation: Float64
    pixels: Float64
    points: NDArray[np.uint64]


@dataclass(eq=False)
class ModelPoints:
    """The points of a COLMAP model, numbered from 1, with their tracks.

    places: (n, 3) float64, world coordinates.
    colours: (n, 3) uint8.
    tracks: (n + 1,). The observations of point k are elements tracks[k] to tracks[k + 1] - 1 of the next two arrays.
    images: (m,), the number of each observation's image, from 1.
    observations: (m,), the index of each observation in its image.
    """

    places: Float64
    colours: NDArray[np.uint8]
    tracks: NDArray[np.int64]
    images: NDArray[np.int64]
    observations: NDArray[np.int64]


def write_cameras(path: Path, lenses: Sequence[Lens]) -> None:
    """Write cameras.bin, with a camera for each lens, numbered from 1."""
    numbers = {name: number for number, (name, _) in colmap_camera_models().items()}
    with atomic_writer(path) as file:
        file.write(_COUNT.pack(len(lenses)))
        for index, lens in enumerate(lenses, 1):
            file.write(struct.pack("<IiQQ", index, numbers[lens.model], lens.width, lens.height))
            file.write(np.array(lens.params, "<f8").tobytes())


def write_images(path: Path, count: int, images: Iterable[ModelImage]) -> None:
    """Write images.bin with `count` images, which are numbered from 1."""
    with atomic_writer(path) as file:
        file.write(_COUNT.pack(count))
        for index, image in enumerate(images, 1):
            quaternion = quaternion_of(image.rotation)
            file.write(struct.pack("<I7dI", index, *quaternion, *image.translation, image.camera))
            file.write(image.name.encode() + b"\0" + _COUNT.pack(len(image.pixels)))
            rows = np.empty(len(image.pixels), _OBSERVATION)
            rows["pixel"], rows["point"] = image.pixels, image.points
            file.write(rows.tobytes())


def write_points(path: Path, points: ModelPoints) -> None:
    """Write points3D.bin. Reprojection errors are 0, because the observations are exact."""
    pairs = np.stack([points.images, points.observations], axis=1).astype("<u4")
    layout = struct.Struct("<Q3d3BdQ")
    with atomic_writer(path) as file:
        file.write(_COUNT.pack(len(points.places)))
        places, colours, tracks = points.places.tolist(), points.colours.tolist(), points.tracks.tolist()
        for index, (place, colour) in enumerate(zip(places, colours, strict=True)):
            first, last = tracks[index], tracks[index + 1]
            file.write(layout.pack(index + 1, *place, *colour, 0.0, last - first))
            file.write(pairs[first:last].tobytes())
