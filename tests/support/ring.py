# SPDX-License-Identifier: Apache-2.0
"""Data sets of a ring of cameras around a cloud of points, as other programs write them.

They have pictures, a COLMAP model in text or a transforms.json, and point files. Each picture has a grey of its own, by
which tests recognise it.
"""

from __future__ import annotations

import json
from collections.abc import Sequence
from pathlib import Path
from typing import Any

import numpy as np

from clsplat.arrays import Float64
from clsplat.images.writing import write_image
from clsplat.rotations import quaternion_of

WIDTH, HEIGHT, FOCAL = 48, 32, 40.0
COUNT = 20
NAMES = [f"view{index:02}.png" for index in range(COUNT)]
Pose = tuple[Float64, Float64]
"""`cam_from_world`: rotation (3, 3), translation (3,)."""
_FLIP = np.diag([1.0, -1.0, -1.0])


def poses(count: int = COUNT, radius: float = 4.0) -> list[Pose]:
    """Poses of cameras around the origin, which look at it from two heights, with y down."""
    found = []
    for index in range(count):
        angle = 2 * np.pi * index / count
        centre = np.array([radius * np.sin(angle), (-1.0, -2.0)[index % 2], -radius * np.cos(angle)])
        ahead = -centre / np.linalg.norm(centre)
        right = np.cross([0.0, 1.0, 0.0], ahead)
        right /= np.linalg.norm(right)
        rotation = np.stack([right, np.cross(ahead, right), ahead])
        found.append((rotation, -rotation @ centre))
    return found


def centre_of(pose: Pose) -> Float64:
    """Position (3,) of a camera in the world."""
    return np.asarray(-pose[0].T @ pose[1])


def moved(pose: Pose, centre: Float64) -> Pose:
    """The pose with another position."""
    return pose[0], -pose[0] @ centre


def points(count: int = 400, seed: int = 3) -> tuple[Float64, np.ndarray]:
    """Points (N, 3) within 1 of the origin and their colours (N, 3), uint8."""
    rng = np.random.default_rng(seed)
    return rng.uniform(-1, 1, (count, 3)), rng.integers(0, 256, (count, 3), dtype=np.uint8)


def level(index: int) -> float:
    """The grey of picture number `index`, from 0 to 1: a whole number of 8-bit levels."""
    return (20 + 9 * index) / 255


def write_pictures(folder: Path, names: Sequence[str] = NAMES, size: tuple[int, int] = (WIDTH, HEIGHT)) -> None:
    for index, name in enumerate(names):
        (folder / name).parent.mkdir(parents=True, exist_ok=True)
        write_image(folder / name, np.full((size[1], size[0], 3), level(index), np.float32))


def write_colmap(
    folder: Path,
    listed: Sequence[str] = NAMES,
    files: Sequence[str] | None = None,
    *,
    images: str = "images",
    model: str = "sparse/0",
    posed: Sequence[Pose] | None = None,
    camera: str = f"PINHOLE {WIDTH} {HEIGHT} {FOCAL} {FOCAL} {WIDTH / 2} {HEIGHT / 2}",
    cloud: tuple[Float64, np.ndarray] | None = None,
) -> Path:
    """Write a COLMAP model in text, with pictures. Returns the folder.

    listed: names of the pictures in the model.
    files: names of the pictures on the disk, if they differ.
    """
    write_pictures(folder / images, files or listed)
    (folder / model).mkdir(parents=True, exist_ok=True)
    (folder / model / "cameras.txt").write_text(f"1 {camera}\n")
    lines = []
    for index, (name, (rotation, translation)) in enumerate(zip(listed, posed or poses(), strict=True), 1):
        numbers = " ".join(repr(float(value)) for value in (*quaternion_of(rotation), *translation))
        lines.append(f"{index} {numbers} 1 {name}\n\n")
    (folder / model / "images.txt").write_bytes("".join(lines).encode("utf-8", "surrogateescape"))
    xyz, rgb = points() if cloud is None else cloud
    rows = zip(xyz.tolist(), rgb.tolist(), strict=True)
    text = "".join(f"{index} {' '.join(map(repr, [*p, *c]))} 0.5 1 0 2 0\n" for index, (p, c) in enumerate(rows, 1))
    (folder / model / "points3D.txt").write_text(text)
    return folder


def matrix_of(pose: Pose) -> list[list[float]]:
    """`world_from_camera` (4, 4) in OpenGL's axes."""
    matrix = np.eye(4)
    matrix[:3, :3], matrix[:3, 3] = pose[0].T @ _FLIP, centre_of(pose)
    return matrix.tolist()


def write_transforms(
    folder: Path,
    listed: Sequence[str] | None = None,
    files: Sequence[str] | None = None,
    *,
    matrices: Sequence[list[list[float]]] | None = None,
    name: str = "transforms.json",
    **keys: Any,
) -> Path:
    """Write a transforms.json with pictures. Returns the folder.

    listed, files: as in `write_colmap`.
    keys: keys of the file; None leaves a key out.
    """
    listed = listed or [f"images/{each}" for each in NAMES]
    write_pictures(folder, files or listed)
    matrices = matrices or [matrix_of(pose) for pose in poses()]
    frames = [{"file_path": each, "transform_matrix": matrix} for each, matrix in zip(listed, matrices, strict=True)]
    lens = {"w": WIDTH, "h": HEIGHT, "fl_x": FOCAL, "fl_y": FOCAL, "cx": WIDTH / 2, "cy": HEIGHT / 2}
    document = {key: value for key, value in {**lens, **keys, "frames": frames}.items() if value is not None}
    (folder / name).write_text(json.dumps(document), "utf-8")
    return folder


PLY_TYPES = {"uchar": "u1", "ushort": "<u2", "int": "<i4", "float": "<f4", "double": "<f8"}


def write_cloud(
    path: Path,
    xyz: Float64,
    colours: np.ndarray | None = None,
    kind: str = "uchar",
    names: Sequence[str] = ("red", "green", "blue"),
) -> None:
    """Write points to a binary PLY. colours: (N, 3), stored without conversion as the PLY type `kind`."""
    properties = [("x", "float"), ("y", "float"), ("z", "float")]
    columns = [*np.asarray(xyz, float).T]
    if colours is not None:
        properties += [(name, kind) for name in names]
        columns += [*np.asarray(colours).T]
    rows = np.empty(len(xyz), [(name, PLY_TYPES[kind]) for name, kind in properties])
    for (name, _), column in zip(properties, columns, strict=True):
        rows[name] = column
    head = ["ply", "format binary_little_endian 1.0", f"element vertex {len(xyz)}"]
    head += [f"property {kind} {name}" for name, kind in properties] + ["end_header", ""]
    path.parent.mkdir(parents=True, exist_ok=True)
    path.write_bytes("\n".join(head).encode() + rows.tobytes())
