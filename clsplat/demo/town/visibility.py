# SPDX-License-Identifier: Apache-2.0
"""Ray casting of the demo's town: finds the surface that each ray meets first. Near solids are tested before far ones.

A solid is tested only against the rays in a rectangle of the picture that contains it. A solid, or a whole block, is
skipped if all rays of its rectangle have met nearer surfaces.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from typing import NamedTuple

import numpy as np
from numpy.typing import NDArray

from clsplat.arrays import Bool, Float32, Float64
from clsplat.camera import Camera
from clsplat.demo.town.blocks import (
    BLOCK_METRES,
    BLOCK_REACH_METRES,
    GROUND_FACE,
    MAX_HEIGHT_METRES,
    SKY_FACE,
    CityBlock,
    city_block,
)
from clsplat.demo.town.solids import FACES_PER_SOLID, SOLID_BALL, SOLID_BOX
from clsplat.demo.town.view_rays import rectangles, world_rays

SIGHT_METRES = 300.0
"""Distance from the camera beyond which blocks are left out, because haze hides them."""


def blocks_in_sight(seed: int, camera: Camera) -> list[CityBlock]:
    """Return the blocks within SIGHT_METRES of a camera that its picture may show, nearest first."""
    position, reach = camera.position, int(np.ceil(SIGHT_METRES / BLOCK_METRES))
    i, j = (int(np.floor(value / BLOCK_METRES)) for value in position[:2])
    around = np.arange(-reach, reach + 1)
    numbers = np.stack(np.meshgrid(around + i, around + j, indexing="ij"), axis=-1).reshape(-1, 2)
    corners = np.append(numbers * BLOCK_METRES, np.zeros((len(numbers), 1)), axis=1) - position
    size = np.array([BLOCK_METRES, BLOCK_METRES, 0.0])
    distance = np.hypot(*np.maximum(np.maximum(corners, -corners - size), 0).T[:2])
    beyond = np.array([BLOCK_REACH_METRES, BLOCK_REACH_METRES, 0.0])
    high = corners + size + beyond + np.array([0.0, 0.0, MAX_HEIGHT_METRES])
    parts = rectangles(camera, corners - beyond - [0.0, 0.0, 1.1], high)
    seen = np.flatnonzero((parts[:, 0] < parts[:, 1]) & (parts[:, 2] < parts[:, 3]) & (distance <= SIGHT_METRES))
    order = seen[np.argsort(distance[seen], kind="stable")]
    return [city_block(seed, int(column), int(row)) for column, row in numbers[order]]


@dataclass(eq=False)
class Sight:
    """The surfaces that the rays of some rows of a picture meet.

    directions: x, y and z of the rays' directions, (4, rows, columns) each, as from `world_rays`.
    surfaces: (4, rows, columns) int32, the surface of each ray: FACES_PER_SOLID times the number of the solid, plus the
        face; or GROUND_FACE or SKY_FACE. Solids are numbered through all blocks.
    """

    directions: tuple[Float32, Float32, Float32]
    surfaces: NDArray[np.int32]


Slices = tuple[slice, slice, slice]


class _Part(NamedTuple):
    """A rectangle of the picture that contains a box. A box that a panorama's edge divides has two parts.

    box: index of the box.
    near: distance of the box from the camera, in metres.
    top, bottom, left, right: the rectangle has the rows [top, bottom) and the columns [left, right).
    """

    box: int
    near: float
    top: int
    bottom: int
    left: int
    right: int


class Caster:
    """Casts the rays of one photograph against the solids of blocks.

    starts: number of each block's first solid, then the number of all solids. Solids are numbered through all blocks.
    """

    def __init__(self, camera: Camera, blocks: Sequence[CityBlock]) -> None:
        self.camera, self.blocks = camera, blocks
        self.position = camera.position
        counts = [len(block.solids) for block in blocks]
        self.starts = np.concatenate([[0], np.cumsum(counts)]).astype(np.int64)
        low = np.stack([block.corner + block.low for block in blocks]) - self.position
        high = np.stack([block.corner + block.high for block in blocks]) - self.position
        self._blocks = _placed(camera, low, high)
        self._inner: dict[int, list[_Part]] = {}

    def sight(self, first: int, last: int) -> Sight:
        """Find the surfaces that the rays of the picture's rows [first, last) meet."""
        directions = world_rays(self.camera, first, last)
        rays = _Rays(directions, self.position, first)
        done = set()
        for place in self._blocks:
            if place.box not in done and rays.is_open(place):
                done.add(place.box)
                block, start = self.blocks[place.box], int(self.starts[place.box])
                for part in self._solids_of(place.box):
                    if rays.is_open(part):
                        rays.cast(block, part.box, start + part.box, rays.slices(part))
        return Sight(directions, rays.surfaces)

    def _solids_of(self, index: int) -> list[_Part]:
        """Return rectangles of the picture that contain the solids of block `index`, from near to far."""
        if index not in self._inner:
            block = self.blocks[index]
            low, high = (corner + (block.corner - self.position) for corner in block.solids.bounds())
            self._inner[index] = _placed(self.camera, low, high)
        return self._inner[index]


def _placed(camera: Camera, low: Float64, high: Float64) -> list[_Part]:
    """Return rectangles of the picture that contain boxes, from near to far.

    low, high: (n, 3), lowest and highest corners of the boxes, relative to the camera's centre, along the world's axes.
    """
    bounds, near = rectangles(camera, low, high), _nearest(low, high)
    width, wraps = camera.width, camera.model.wraps
    order = np.argsort(near, kind="stable")
    parts = []
    for index, distance, (top, bottom, left, right) in zip(
        order.tolist(), near[order].tolist(), bounds[order].tolist(), strict=True
    ):
        if top < bottom:
            shifts = (0, width, -width) if wraps and right - left < width else (0,)
            pieces = ((max(left + shift, 0), min(right + shift, width)) for shift in shifts)
            parts += [_Part(index, distance, top, bottom, begin, end) for begin, end in pieces if begin < end]
    return parts


def _nearest(low: Float64, high: Float64) -> Float64:
    """Return the distances (n,) of boxes from the origin. low, high: (n, 3), corners of the boxes."""
    return np.asarray(np.linalg.norm(np.maximum(np.maximum(low, -high), 0), axis=1))


class _Rays:
    """Rays of a picture's rows from `first` on, with the nearest surface that each ray has met so far."""

    def __init__(self, directions: tuple[Float32, Float32, Float32], position: Float64, first: int) -> None:
        self.position, self.first = position, first
        self.x, self.y, self.z = directions
        with np.errstate(divide="ignore", over="ignore"):
            self.over_x, self.over_y, self.over_z = (np.reciprocal(axis) for axis in directions)
            ground = np.float32(-position[2]) * self.over_z
        falls = self.z < 0
        self.distance = np.where(falls, ground, np.float32(np.inf))
        self.surfaces = np.where(falls, np.int32(GROUND_FACE), np.int32(SKY_FACE))
        x, y, z = (axis[:, :: max(axis.shape[1] - 1, 1), :: max(axis.shape[2] - 1, 1)] for axis in directions)
        self._longest = float(np.sqrt((x**2 + y**2 + z**2).max()))  # directions are longest in the corners

    def slices(self, part: _Part) -> Slices:
        """Return slices of samples, rows and columns, which select the rays in a part of the picture."""
        rows = slice(max(part.top - self.first, 0), max(part.bottom - self.first, 0))
        return slice(None), rows, slice(part.left, part.right)

    def is_open(self, part: _Part) -> bool:
        """Return False if all rays in a part of the picture have met surfaces nearer than the part's box."""
        if part.bottom <= self.first or part.top >= self.first + self.distance.shape[1]:
            return False
        return bool(self.distance[self.slices(part)].max() * self._longest > part.near)

    def cast(self, block: CityBlock, solid: int, number: int, part: Slices) -> None:
        """Cast the rays of a part of the picture against a solid, and keep the hits that are nearest so far.

        solid: index of the solid in its block.
        number: number of the solid, counted over all blocks.
        part: slices of the part's rays, as from `slices`.
        """
        solids = block.solids
        centre = (self.position - block.corner - solids.centres[solid]).astype(np.float32)
        half, kind = solids.halves[solid].astype(np.float32), int(solids.kinds[solid])
        turn = solids.turns[solid].astype(np.float32)
        base = number * FACES_PER_SOLID
        with np.errstate(divide="ignore", invalid="ignore", over="ignore"):
            if kind == SOLID_BALL:
                self._ball(part, centre, half[0], base)
            else:
                self._polyhedron(part, centre, half, turn, kind, base)

    def _ball(self, part: Slices, start: Float32, radius: np.float32, base: int) -> None:
        x, y, z = self.x[part], self.y[part], self.z[part]
        square = x * x
        square += y * y
        square += z * z
        along = x * start[0]
        along += y * start[1]
        along += z * start[2]
        rest = along * along
        rest -= square * (start @ start - radius * radius)
        enter = -along
        enter -= np.sqrt(np.maximum(rest, 0))
        enter /= square
        hit = (rest > 0) & (enter > 0) & (enter < self.distance[part])
        self._meet(part, hit, enter, base)

    def _polyhedron(self, part: Slices, start: Float32, half: Float32, turn: Float32, kind: int, base: int) -> None:
        over_x, over_y, y = self._turned(part, turn)
        start = np.array([turn[0] * start[0] + turn[1] * start[1], turn[0] * start[1] - turn[1] * start[0], start[2]])
        begin, end = _slab(over_x, start[0], half[0])
        codes = [(begin, 0 if start[0] < 0 else 1)]
        if kind == SOLID_BOX:
            begin_y, end_y = _slab(over_y, start[1], half[1])
            begin_z, end_z = _slab(self.over_z[part], start[2], half[2])
            codes += [(begin_y, 2 if start[1] < 0 else 3), (begin_z, 4 if start[2] < 0 else 5)]
            np.minimum(end, end_y, out=end)
            np.minimum(end, end_z, out=end)
        else:
            floor = -start[2] * self.over_z[part]
            rises = self.z[part] > 0
            codes += [(np.where(rises, floor, -np.inf), 4)]
            np.minimum(end, np.where(rises, np.float32(np.inf), floor), out=end)
            steep = np.float32(np.hypot(half[1], half[2]))
            across, up = half[2] / steep, half[1] / steep
            for code, sign in ((6, across), (7, -across)):
                fall = sign * y
                fall += up * self.z[part]
                reach = np.float32(-(sign * start[1] + up * (start[2] - half[2]))) / fall
                inward = fall < 0
                codes += [(np.where(inward, reach, np.float32(-np.inf)), code)]
                np.minimum(end, np.where(inward, np.float32(np.inf), reach), out=end)
        enter = codes[0][0]
        for other, _ in codes[1:]:
            enter = np.maximum(enter, other)
        hit = enter < end
        hit &= enter < self.distance[part]
        hit &= enter > 0
        if hit.any():
            face: NDArray[np.int32] | int = base + codes[0][1]
            for other, code in codes[1:]:
                face = np.where(enter == other, np.int32(base + code), face)
            self._meet(part, hit, enter, face)

    def _turned(self, part: Slices, turn: Float32) -> tuple[Float32, Float32, Float32]:
        """Return 1 / x, 1 / y and y of rays' directions in a solid's own axes.

        part: slices of the rays, as from `slices`. turn: (2,), cosine and sine of the solid's rotation about z.
        """
        x, y = self.x[part], self.y[part]
        if turn[1] == 0:
            return self.over_x[part], self.over_y[part], y
        turned_x = turn[0] * x
        turned_x += turn[1] * y
        turned_y = turn[0] * y
        turned_y -= turn[1] * x
        np.reciprocal(turned_x, out=turned_x)
        return turned_x, np.reciprocal(turned_y), turned_y

    def _meet(self, part: Slices, hit: Bool, enter: Float32, face: NDArray[np.int32] | int) -> None:
        np.copyto(self.distance[part], enter, where=hit)
        np.copyto(self.surfaces[part], face, where=hit)


def _slab(over: Float32, start: np.float32, half: np.float32) -> tuple[Float32, Float32]:
    """Return the distances at which rays enter and leave the space between two planes, at -half and +half on an axis.

    over: reciprocals of the rays' directions along this axis.
    start: coordinate of the rays' origin on this axis.
    """
    middle = over * -start
    reach = np.abs(over)
    reach *= half
    end = middle + reach
    middle -= reach
    return middle, end
