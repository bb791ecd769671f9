# SPDX-License-Identifier: Apache-2.0
"""Cameras of the photographs of the demo's town, block by block: from flights that look straight down or obliquely, and
from a car in the block's two streets.

The cameras depend on the seed, the block's indices and the number of photographs of a block, but not on the size of the
town.
"""

from __future__ import annotations

import math
from dataclasses import dataclass
from typing import Final

import numpy as np

from clsplat.arrays import Float64
from clsplat.camera import Camera
from clsplat.demo.town.blocks import BLOCK_METRES, DRIVEN_METRES, block_generator
from clsplat.demo.town.settings import TownConfig
from clsplat.scenes.dataset import Lens
from clsplat.shots.viewpoints import look_at

AIR_VIEW_RADIANS, STREET_VIEW_RADIANS = math.radians(62.0), math.radians(78.0)
"""Angles of view across the picture's longer side, of the flights' cameras and of the street cameras."""
STRAIGHT_FLIGHT_METRES, SLANTED_FLIGHT_METRES, CAR_CAMERA_METRES = 55.0, 48.0, 2.4
"""Heights above the ground of cameras that look straight down, of oblique cameras, and of cameras on a car."""
SLANT_RADIANS = math.radians(40.0)
"""Angle of the oblique cameras' axes below the horizon."""
TOWN_FISHEYE_COEFFICIENTS = (-0.02, 0.0005, 0.0, 0.0)
"""Distortion k1 to k4 of the OPENCV_FISHEYE lens, with which street cameras of the fisheye rig photograph."""
STRAIGHT_SHARE, STREET_SHARE = 0.3, 0.3
"""Fractions of a block's photographs that look straight down, and that are taken in streets. The rest is oblique."""
DIRECTIONS: Final = np.array([[0.0, 1.0, 0.0], [1.0, 0.0, 0.0], [0.0, -1.0, 0.0], [-1.0, 0.0, 0.0]])
"""Directions of view of the four oblique flights: north, east, south, west."""
_YAWS = (0.38, -0.38)
"""Angles in radians from the driving direction to the right, at which street cameras look alternately."""


@dataclass(frozen=True, eq=False)
class TownPhotograph:
    """Plan of a photograph: its name, camera and exposure.

    name: path below the folder of pictures.
    i, j, index: the two indices of the photograph's block, and its index among the block's photographs.
    camera: the camera with its exact pose, in the town's coordinates.
    lens: the camera's intrinsics, as in a COLMAP model.
    gain: exposure, as a factor of the linear colours.
    """

    name: str
    i: int
    j: int
    index: int
    camera: Camera
    lens: Lens
    gain: float


def lenses(config: TownConfig) -> tuple[Lens, Lens]:
    """Return the lens of the flights, and the lens of the street cameras."""
    width, height = config.width, config.height
    centre = (width / 2, height / 2)

    def flat(angle: float) -> Lens:
        focal = 0.5 * max(width, height) / math.tan(0.5 * angle)
        return Lens("PINHOLE", width, height, (focal, focal, *centre))

    if config.is_fisheye:  # a lens with an angle of view of 180 degrees across the longer side
        k1, k2, *_ = TOWN_FISHEYE_COEFFICIENTS
        angle = math.pi / 2
        focal = 0.5 * max(width, height) / (angle * (1 + k1 * angle**2 + k2 * angle**4))
        street = Lens("OPENCV_FISHEYE", width, height, (focal, focal, *centre, *TOWN_FISHEYE_COEFFICIENTS))
    elif config.is_panorama:
        tall = width // 2
        street = Lens("EQUIRECTANGULAR", width, tall, (float(width), float(tall)))
    else:
        street = flat(STREET_VIEW_RADIANS)
    return flat(AIR_VIEW_RADIANS), street


def photographs(config: TownConfig, i: int, j: int) -> list[TownPhotograph]:
    """Plan the photographs of block (i, j), sorted by name."""
    straight, street = round(STRAIGHT_SHARE * config.photos), round(STREET_SHARE * config.photos)
    generator = block_generator(config.seed, 3, i, j)
    poses = [
        *_straight(straight, generator),
        *_slanted(config.photos - straight - street, generator),
        *_street(street, generator),
    ]
    poses.sort(key=lambda pose: pose[0])
    air, ground = lenses(config)
    corner = np.array([i * BLOCK_METRES, j * BLOCK_METRES, 0.0])
    taken = []
    for index, (name, flight, position, forward, up) in enumerate(poses):
        lens = ground if name.startswith("street") else air
        place = position + corner
        camera = lens.camera(*look_at(place, place + forward, up), "native")
        gain = _gain(config, flight, i, j, index)
        taken.append(TownPhotograph(f"{i:04d}_{j:04d}/{name}.jpg", i, j, index, camera, lens, gain))
    return taken


Row = tuple[str, int, Float64, Float64, Float64]
"""Plan of a photograph: its name, number of the flight, camera position, direction of view and up direction."""


def _straight(count: int, generator: np.random.Generator) -> list[Row]:
    """Plan `count` photographs of a flight that looks straight down, back and forth along lines parallel to x."""
    lines, rows = max(1, round(math.sqrt(count))), []
    for index, (x, y, line) in enumerate(_over_block(count, lines)):
        place = np.array([x, y, STRAIGHT_FLIGHT_METRES]) + generator.normal(0, 0.6, 3)
        forward = np.array([0.0, 0.0, -1.0]) + np.append(generator.normal(0, 0.03, 2), 0)
        along = np.array([1.0 if line % 2 else -1.0, generator.normal(0, 0.04), 0.0])
        rows.append((f"down_{index:03d}", 0, place, forward, np.cross(along, forward)))
    return rows


def _slanted(count: int, generator: np.random.Generator) -> list[Row]:
    """Plan `count` photographs of four oblique flights, one for each of DIRECTIONS."""
    rows, down = [], math.tan(SLANT_RADIANS)
    for side, forward in enumerate(DIRECTIONS):
        some = len(range(side, count, 4))
        for index, (x, y, _) in enumerate(_over_block(some, max(1, round(math.sqrt(some))))):
            target = np.array([x, y, 4.0])
            away = (SLANTED_FLIGHT_METRES - target[2]) / down
            place = target - away * forward
            place[2] = SLANTED_FLIGHT_METRES
            place += generator.normal(0, 0.6, 3)
            look = forward - np.array([0, 0, down]) + generator.normal(0, 0.03, 3)
            rows.append((f"slant_{'nesw'[side]}_{index:03d}", 1 + side, place, look, _upright(generator)))
    return rows


def _street(count: int, generator: np.random.Generator) -> list[Row]:
    """Plan `count` photographs from a car that drives on the right, both ways along the block's two streets.

    The cameras look alternately to the right and to the left of the driving direction.
    """
    rows: list[Row] = []
    for street, begin in enumerate((0, count // 2)):
        some = (count // 2, count - count // 2)[street]
        for index in range(some):
            sign = 1.0 if index % 2 == 0 else -1.0
            ahead = sign * np.eye(3)[1 - street]
            right = np.array([ahead[1], -ahead[0], 0.0])
            place = np.eye(3)[1 - street] * (index + 0.5) / some * BLOCK_METRES + DRIVEN_METRES * right
            place[2] = CAR_CAMERA_METRES
            place += generator.normal(0, (0.15, 0.15, 0.04))
            yaw = _YAWS[(index // 2) % len(_YAWS)] + generator.normal(0, 0.05)
            look = math.cos(yaw) * ahead + math.sin(yaw) * right + np.array([0, 0, generator.normal(0.06, 0.03)])
            rows.append((f"street_{begin + index:03d}", 5 + street, place, look, _upright(generator)))
    return rows


def _over_block(count: int, lines: int) -> list[tuple[float, float, int]]:
    """Return `count` positions over a block, evenly spaced along lines parallel to x: x, y in metres, line number."""
    places = []
    for line in range(lines):
        some = len(range(line, count, lines))
        y = (line + 0.5) / lines * BLOCK_METRES
        places += [((index + 0.5) / some * BLOCK_METRES, y, line) for index in range(some)]
    return places


def _upright(generator: np.random.Generator) -> Float64:
    x, y = generator.normal(0, 0.02, 2)
    return np.array([x, y, 1.0])


def _gain(config: TownConfig, flight: int, i: int, j: int, index: int) -> float:
    """Return the exposure factor of a photograph. It differs between flights, and drifts along each flight.

    flight: number of the flight. A flight passes over all blocks with the same index `j`.
    i, index: index of the photograph's block along x, and index of the photograph in its block.
    """
    if config.exposure == 0:
        return 1.0
    level, phase, speed = block_generator(config.seed, 4, 0, j, flight).uniform(-1, 1, 3)
    place = i + index / config.photos
    drift = 0.7 * level + 0.3 * math.sin(math.pi * (phase + (0.2 + 0.1 * speed) * place))
    return float(2.0 ** (config.exposure * drift))
