# SPDX-License-Identifier: Apache-2.0
"""Write a made-up survey of any size: a COLMAP model as binary files or as text, or a transforms.json.

Cameras fly over a plain in rows and look straight down. Each has its share of the points, its own points, in a pattern
that is the same for all cameras. A camera also observes the points of the next cameras in its row. Files are written a
part at a time, so that a survey of any size takes little memory.
"""

from __future__ import annotations

import json
import math
import struct
from collections.abc import Iterator
from dataclasses import dataclass
from functools import cached_property
from pathlib import Path
from textwrap import indent
from typing import Any

import numpy as np
from numpy.typing import NDArray

from clsplat.images.writing import write_image

WIDTH, HEIGHT, FOCAL = 6000, 4000, 5000.0
"""Size and focal length of a photograph, pixels."""
ALTITUDE = 50.0
"""Height of the cameras above the plain, metres."""
STEP = 8.0
"""Distance of neighbouring cameras in a row, metres. A photograph shows 60 x 40 metres."""
ROW_STEP = 20.0
"""Distance of rows, metres."""
PICTURE_WIDTH, PICTURE_HEIGHT = 12, 8
"""Size of the files of the photographs, pixels."""
POINT = np.dtype([("id", "<u8"), ("xyz", "<f8", 3), ("rgb", "u1", 3), ("error", "<f8"), ("length", "<u8")])
OBSERVATION = np.dtype([("xy", "<f8", 2), ("point", "<u8")])
ORIENTATION = (0.0, 1.0, 0.0, 0.0)
"""The quaternion (w x y z) of every camera: half a turn around x."""


@dataclass(frozen=True)
class Survey:
    """A survey of `images` cameras, each with `own` points, which `views` cameras observe (fewer at a row's ends)."""

    images: int
    own: int
    views: int

    @cached_property
    def columns(self) -> int:
        """Cameras in a row."""
        return max(math.ceil(math.sqrt(self.images * ROW_STEP / STEP)), 1)

    def position(self, index: int) -> tuple[float, float, float]:
        """The position of camera `index`."""
        row, column = divmod(index, self.columns)
        return STEP * column + 0.125, ROW_STEP * row + 0.375, ALTITUDE

    def translation(self, index: int) -> tuple[float, float, float]:
        """The translation of camera `index` in its pose `cam_from_world`."""
        x, y, z = self.position(index)
        return -x, y, z

    def seen_from(self, index: int) -> range:
        """The cameras whose points camera `index` observes."""
        row = index // self.columns * self.columns
        first = max(row, index - self.views // 2)
        return range(first, min(row + self.columns, self.images, index + (self.views + 1) // 2))

    def track(self, index: int) -> list[int]:
        """The cameras that observe the points of camera `index`."""
        near = range(max(index - self.views, 0), min(index + self.views + 1, self.images))
        return [other for other in near if index in self.seen_from(other)]

    @cached_property
    def pattern(self) -> NDArray[np.float64]:
        """Positions (own, 3) of a camera's points, relative to the foot of the camera, metres."""
        rng = np.random.default_rng(49)
        size = np.array([1.5 * STEP, 1.2 * ROW_STEP, 3.0])
        return np.asarray((rng.random((self.own, 3)) - np.array([0.5, 0.5, 0.0])) * size)

    @cached_property
    def colours(self) -> NDArray[np.uint8]:
        """Colours (own, 3) of a camera's points."""
        return np.random.default_rng(50).integers(0, 256, (self.own, 3), np.uint8)

    @cached_property
    def errors(self) -> NDArray[np.float64]:
        """Reprojection errors (own,) of a camera's points, pixels."""
        return np.random.default_rng(51).random(self.own)

    def points(self, index: int) -> NDArray[np.float64]:
        """Positions (own, 3) of the points of camera `index`."""
        x, y, _ = self.position(index)
        return np.asarray(self.pattern + np.array([x, y, 0.0]))

    def pixels(self, offset: int) -> NDArray[np.float64]:
        """Pixels (own, 2) of the points of the camera that is `offset` places ahead in the row; as float32, like
        COLMAP's."""
        x, y, z = (self.pattern + np.array([STEP * offset, 0.0, 0.0])).T
        depth = ALTITUDE - z
        places = np.stack([FOCAL * x / depth + WIDTH / 2, -FOCAL * y / depth + HEIGHT / 2], axis=1)
        return places.astype(np.float32).astype(np.float64)

    def name(self, index: int) -> str:
        """The name of a photograph."""
        return f"flight_{index // 1000:03d}/DJI_{index:06d}.png"


def write_pictures(survey: Survey, folder: Path) -> None:
    """Write a small file for each photograph."""
    rng = np.random.default_rng(52)
    for index in range(survey.images):
        path = folder / survey.name(index)
        path.parent.mkdir(parents=True, exist_ok=True)
        write_image(path, rng.random((PICTURE_HEIGHT, PICTURE_WIDTH, 3), np.float32))


def write_binary(survey: Survey, folder: Path) -> None:
    """Write cameras.bin, images.bin and points3D.bin."""
    folder.mkdir(parents=True, exist_ok=True)
    lens = (FOCAL, FOCAL, WIDTH / 2, HEIGHT / 2)
    (folder / "cameras.bin").write_bytes(struct.pack("<QIiQQ4d", 1, 1, 1, WIDTH, HEIGHT, *lens))
    with open(folder / "images.bin", "wb") as file:
        file.write(struct.pack("<Q", survey.images))
        for index in range(survey.images):
            homes = survey.seen_from(index)
            rows = np.empty((len(homes), survey.own), OBSERVATION)
            for row, home in zip(rows, homes, strict=True):
                row["xy"] = survey.pixels(home - index)
                row["point"] = home * survey.own + 1 + np.arange(survey.own)
            file.write(struct.pack("<I7dI", index + 1, *ORIENTATION, *survey.translation(index), 1))
            file.write(survey.name(index).encode() + b"\0" + struct.pack("<Q", rows.size))
            file.write(rows.tobytes())
    with open(folder / "points3D.bin", "wb") as file:
        file.write(struct.pack("<Q", survey.images * survey.own))
        for index in range(survey.images):
            file.write(_points(survey, index).tobytes())


def _track_of(survey: Survey, index: int) -> NDArray[np.uint32]:
    """Numbers of the images, and places in them, (k, 2), at which the first point of camera `index` is observed."""
    track = survey.track(index)
    places = [survey.seen_from(other).index(index) * survey.own for other in track]
    return np.stack([np.array(track) + 1, places], axis=1).astype("<u4")


def _points(survey: Survey, index: int) -> NDArray[Any]:
    """The records of the points of camera `index` in points3D.bin."""
    track = _track_of(survey, index)
    rows = np.empty(survey.own, np.dtype([("point", POINT), ("track", "<u4", track.shape)]))
    point = rows["point"]
    point["id"] = index * survey.own + 1 + np.arange(survey.own)
    point["xyz"], point["rgb"], point["error"] = survey.points(index), survey.colours, survey.errors
    point["length"] = len(track)
    rows["track"] = track
    rows["track"][:, :, 1] += np.arange(survey.own, dtype=np.uint32)[:, None]
    return rows


def write_text(survey: Survey, folder: Path) -> None:
    """Write cameras.txt, images.txt and points3D.txt."""
    folder.mkdir(parents=True, exist_ok=True)
    lens = f"1 PINHOLE {WIDTH} {HEIGHT} {FOCAL} {FOCAL} {WIDTH / 2} {HEIGHT / 2}\n"
    (folder / "cameras.txt").write_text(f"# Number of cameras: 1\n{lens}")
    texts: dict[int, list[str]] = {}
    with open(folder / "images.txt", "w", encoding="utf-8") as file:
        file.write(f"# Number of images: {survey.images}\n")
        for index in range(survey.images):
            pose = " ".join(map(repr, (*ORIENTATION, *survey.translation(index))))
            file.write(f"{index + 1} {pose} 1 {survey.name(index)}\n")
            parts = []
            for home in survey.seen_from(index):
                if (offset := home - index) not in texts:
                    texts[offset] = [f"{x!r} {y!r} " for x, y in survey.pixels(offset).tolist()]
                first = home * survey.own + 1
                parts += [f"{text}{first + place}" for place, text in enumerate(texts[offset])]
            file.write(" ".join(parts) + "\n")
    with open(folder / "points3D.txt", "w", encoding="utf-8") as file:
        file.write(f"# Number of points: {survey.images * survey.own}\n")
        for index in range(survey.images):
            file.writelines(_point_lines(survey, index))


def _point_lines(survey: Survey, index: int) -> Iterator[str]:
    """The lines of the points of camera `index` in points3D.txt."""
    track, first = _track_of(survey, index).tolist(), index * survey.own + 1
    rest = [
        f"{red} {green} {blue} {error!r} "
        for (red, green, blue), error in zip(survey.colours.tolist(), survey.errors.tolist(), strict=True)
    ]
    for place, ((x, y, z), end) in enumerate(zip(survey.points(index).tolist(), rest, strict=True)):
        seen = " ".join([f"{image} {start + place}" for image, start in track])
        yield f"{first + place} {x!r} {y!r} {z!r} {end}{seen}\n"


def write_transforms(survey: Survey, path: Path) -> None:
    """Write a transforms.json of the photographs, indented like nerfstudio's."""
    lens = {"w": WIDTH, "h": HEIGHT, "fl_x": FOCAL, "fl_y": FOCAL, "cx": WIDTH / 2, "cy": HEIGHT / 2}
    head = json.dumps({"camera_model": "OPENCV", **lens, "k1": 0.0, "k2": 0.0, "p1": 0.0, "p2": 0.0}, indent=4)
    with open(path, "w", encoding="utf-8") as file:
        file.write(head[:-2] + ',\n    "frames": [\n')
        for index in range(survey.images):
            x, y, z = survey.position(index)
            cos, sin = math.cos(index), math.sin(index)
            matrix = [[cos, -sin, 0.0, x], [sin, cos, 0.0, y], [0.0, 0.0, 1.0, z], [0.0, 0.0, 0.0, 1.0]]
            frame = {"file_path": f"images/{survey.name(index)}", "transform_matrix": matrix, "colmap_im_id": index + 1}
            file.write(indent(json.dumps(frame, indent=4), 8 * " ") + ("\n" if index + 1 == survey.images else ",\n"))
        file.write("    ]\n}\n")
