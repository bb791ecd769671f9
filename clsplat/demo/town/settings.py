# SPDX-License-Identifier: Apache-2.0
"""Settings of the demo's town (`clsplat demo --town`), and their checks."""

from __future__ import annotations

import math
import re
from dataclasses import asdict, dataclass
from typing import Any, Literal, get_args

from clsplat.errors import InputError

TownRig = Literal["perspective", "fisheye", "panorama"]
MAX_TOWN_SIDE = 1000
"""Largest number of blocks along a side of the town."""
MAX_PHOTOS_PER_BLOCK = 1000
MIN_TOWN_PHOTO_SIDE, MAX_TOWN_PHOTO_SIDE = 16, 8192
"""Limits of a photograph's width and height in pixels."""
CAR_SLOTS = 28
"""Maximum number of moving cars in a block: seven in each direction of its two streets."""
MAX_TOWN_ORIGIN_METRES = 1e8
"""Largest coordinate of the town's corner. At this distance, float64 has steps of 15 nanometres."""


@dataclass(frozen=True)
class TownConfig:
    """A town's settings.

    columns, rows: number of photographed blocks along x and y. The town itself is endless.
    photos: number of photographs of each block.
    width, height: size of a photograph in pixels. The height of a panorama is half its width.
    seed: seed of the town, of the cameras and of all noise.
    rig: kind of camera in the streets, a `TownRig`.
    exposure: largest deviation of a photograph's exposure from the mean, in stops.
    cars: number of moving cars in each block.
    origin: world coordinates of the corner of block (0, 0), in metres.
    pose_noise: standard deviation of the random error of written camera positions, per axis, in metres.
    """

    columns: int
    rows: int
    photos: int = 60
    width: int = 640
    height: int = 400
    seed: int = 0
    rig: TownRig = "perspective"
    exposure: float = 0.0
    cars: int = 0
    origin: tuple[float, float, float] = (0.0, 0.0, 0.0)
    pose_noise: float = 0.0

    @property
    def is_fisheye(self) -> bool:
        """True if the cameras in the streets are fisheyes."""
        return self.rig == "fisheye"

    @property
    def is_panorama(self) -> bool:
        """True if the cameras in the streets take panoramas."""
        return self.rig == "panorama"

    def check(self) -> None:
        """Raise InputError naming the flag of the first invalid value."""
        sides = f"1 to {MAX_TOWN_SIDE} blocks a side, such as 3x2"
        size = f"{MIN_TOWN_PHOTO_SIDE} to {MAX_TOWN_PHOTO_SIDE} pixels a side, such as 640x400"
        shorter, longer = min(self.width, self.height), max(self.width, self.height)
        far = max(map(abs, self.origin)) if all(map(math.isfinite, self.origin)) else math.inf
        given = ",".join(f"{value:g}" for value in self.origin)
        rules: tuple[tuple[str, object, bool, str], ...] = (
            ("town", f"{self.columns}x{self.rows}", min(self.columns, self.rows) >= 1, sides),
            ("town", f"{self.columns}x{self.rows}", max(self.columns, self.rows) <= MAX_TOWN_SIDE, sides),
            (
                *("town-photos", self.photos, 1 <= self.photos <= MAX_PHOTOS_PER_BLOCK),
                f"1 to {MAX_PHOTOS_PER_BLOCK} photographs of each block",
            ),
            ("town-size", f"{self.width}x{self.height}", shorter >= MIN_TOWN_PHOTO_SIDE, size),
            ("town-size", f"{self.width}x{self.height}", longer <= MAX_TOWN_PHOTO_SIDE, size),
            ("seed", self.seed, 0 <= self.seed < 1 << 32, "a whole number of at least 0 and below 2^32"),
            ("town-rig", self.rig, self.rig in get_args(TownRig), f"one of {', '.join(get_args(TownRig))}"),
            ("town-exposure", self.exposure, 0 <= self.exposure <= 4, "0 to 4 stops"),
            ("town-cars", self.cars, 0 <= self.cars <= CAR_SLOTS, f"0 to {CAR_SLOTS} cars in each block"),
            ("town-origin", given, far <= MAX_TOWN_ORIGIN_METRES, f"numbers up to {MAX_TOWN_ORIGIN_METRES:g} metres"),
            ("town-pose-noise", self.pose_noise, 0 <= self.pose_noise <= 100, "0 to 100 metres"),
        )
        for flag, value, makes_sense, expected in rules:
            if not makes_sense:
                raise InputError(f"--{flag} {value}: expected {expected}")

    def record(self) -> dict[str, Any]:
        """Return the settings as a JSON object, for town.json."""
        return asdict(self) | {"origin": list(self.origin)}


def two_numbers(flag: str, text: str, example: str) -> tuple[int, int]:
    """Parse two numbers from the text of a flag, such as 3x2. Raises InputError, which names flag and example."""
    match = re.fullmatch(r"\s*(\d{1,9})\s*[xX]\s*(\d{1,9})\s*", text)
    if match is None:
        raise InputError(f"--{flag} {text}: expected two whole numbers, such as {example}")
    return int(match[1]), int(match[2])


def three_numbers(flag: str, text: str) -> tuple[float, float, float]:
    """Parse three coordinates from the text of a flag, such as 500000,4650000,0. Raises InputError naming the flag."""
    try:
        x, y, z = map(float, text.split(","))
    except ValueError:
        raise InputError(f"--{flag} {text}: expected three numbers, such as 500000,4650000,0") from None
    return x, y, z
