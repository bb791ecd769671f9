# SPDX-License-Identifier: Apache-2.0
"""Photographs of the demo's town by ray casting: pixels, masks of moving cars, and observations of points."""

from __future__ import annotations

import math
from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray
from scipy import ndimage

from clsplat.arrays import Bool, Float32, Float64
from clsplat.camera import Camera
from clsplat.demo.town.blocks import (
    BLOCK_METRES,
    CAR_PAINTS,
    DRIVEN_METRES,
    GROUND_FACE,
    POINTS_PER_BLOCK,
    CityBlock,
    block_generator,
    car,
)
from clsplat.demo.town.flights import TownPhotograph
from clsplat.demo.town.settings import CAR_SLOTS, TownConfig
from clsplat.demo.town.shading import Shader
from clsplat.demo.town.solids import FACES_PER_SOLID, Builder
from clsplat.demo.town.textures import textures
from clsplat.demo.town.view_rays import SAMPLES, world_rays
from clsplat.demo.town.visibility import Caster, Sight, blocks_in_sight

BAND_PIXELS = 1 << 16
"""Number of pixels whose rays are cast at a time. It limits the memory."""
POINT_METRES = 130.0
"""Largest distance in metres between a camera and a point that it observes."""
FREE_METRES = 9.0
"""Smallest distance of moving cars from the camera, in metres."""
TONE = np.float32(1 / 1.6)
"""Exponent of the tone curve, which maps linear colours in [0, 1] to the pixels of a photograph."""


@dataclass(eq=False)
class Observations:
    """Points of the town's surfaces that a photograph shows.

    blocks: (n, 2) int32, indices of the points' blocks.
    points: (n,) int32, indices of the points in their blocks.
    pixels: (n, 2) float64, exact positions of the points in the photograph, in pixels.
    colours: (n, 3) uint8, colours of the pixels there.
    """

    blocks: NDArray[np.int32]
    points: NDArray[np.int32]
    pixels: Float64
    colours: NDArray[np.uint8]


@dataclass(eq=False)
class TakenPhotograph:
    """A photograph of the town.

    pixels: (height, width, 3) float32 in [0, 1].
    mask: (height, width), False for pixels of moving cars and their neighbours; None without moving cars.
    seen: points that the photograph shows.
    """

    pixels: Float32
    mask: Bool | None
    seen: Observations


def take(config: TownConfig, photograph: TownPhotograph) -> TakenPhotograph:
    """Take a planned photograph. A pixel is the mean of four rays, or is shaded once if all meet the same surface."""
    camera = photograph.camera
    blocks = blocks_in_sight(config.seed, camera)
    moving = len(blocks)
    if config.cars:
        blocks = [*blocks, _moving_cars(config, photograph)]
    caster = Caster(camera, blocks)
    shader = Shader(camera, blocks, caster.starts, textures(config.seed), config.seed)
    candidates = _Candidates(caster, moving)
    pixels = np.empty((camera.height, camera.width, 3), np.float32)
    mask = np.ones((camera.height, camera.width), np.bool_)
    band = max(1, BAND_PIXELS // camera.width)
    for first in range(0, camera.height, band):
        last = min(first + band, camera.height)
        sight = caster.sight(first, last)
        surfaces = sight.surfaces
        pixels[first:last] = _shaded(camera, shader, sight, first, last)
        candidates.see(surfaces, first, last)
        mask[first:last] = (surfaces < caster.starts[moving] * FACES_PER_SOLID).all(axis=0)
    pixels = np.clip(pixels * np.float32(photograph.gain), 0, 1) ** TONE
    kept = ndimage.binary_erosion(mask, np.ones((3, 3)), border_value=1) if config.cars else None
    return TakenPhotograph(pixels, kept, candidates.observations(pixels, kept))


def _shaded(camera: Camera, shader: Shader, sight: Sight, first: int, last: int) -> Float32:
    """Return the linear colours (rows, width, 3) of the picture's rows [first, last).

    sight: surfaces that the rays of these rows meet.
    """
    centres = world_rays(camera, first, last, ((0.0, 0.0),))
    directions = np.stack([np.broadcast_to(axis, (1, last - first, camera.width)).ravel() for axis in centres], axis=1)
    flat = sight.surfaces.reshape(len(SAMPLES), -1)
    mixed = (flat[0] != flat[1]) | (flat[0] != flat[2]) | (flat[0] != flat[3])
    ground = np.flatnonzero((flat[0] == GROUND_FACE) & ~mixed)
    mixed[ground] = shader.near_ground_seam(directions.take(ground, axis=0))
    whole, parts = np.flatnonzero(~mixed), np.flatnonzero(mixed)
    samples = np.stack(
        [axis.reshape(len(SAMPLES), -1).take(parts, axis=1).ravel() for axis in sight.directions], axis=1
    )
    rays = np.concatenate([directions.take(whole, axis=0), samples])
    shaded = shader.colours(rays, np.concatenate([flat[0].take(whole), flat.take(parts, axis=1).ravel()]))
    result = np.empty((flat.shape[1], 3), np.float32)
    result[whole] = shaded[: len(whole)]
    result[parts] = shaded[len(whole) :].reshape(len(SAMPLES), -1, 3).mean(axis=0)
    return result.reshape(last - first, camera.width, 3)


def _moving_cars(config: TownConfig, photograph: TownPhotograph) -> CityBlock:
    """Place the moving cars of a photograph in the streets of its block and of the eight blocks around it.

    Returns a block whose only solids are these cars.
    """
    generator = block_generator(config.seed, 5, photograph.i, photograph.j, photograph.index)
    builder = Builder()
    corner = np.array([photograph.i, photograph.j]) * BLOCK_METRES
    away = photograph.camera.position[:2] - corner
    for x, y in np.stack(np.meshgrid((-1, 0, 1), (-1, 0, 1)), axis=-1).reshape(-1, 2) * BLOCK_METRES:
        for slot in generator.choice(CAR_SLOTS, config.cars, replace=False).tolist():
            upright, forward, along = slot % 2, slot // 2 % 2, 12.0 + 6.0 * (slot // 4) + generator.uniform(-0.7, 0.7)
            painted = generator.choice(CAR_PAINTS)
            side = DRIVEN_METRES * (1 if forward == upright else -1)
            place = np.array([x + side, y + along] if upright else [x + along, y + side])
            turn = (math.pi / 2 if upright else 0.0) + (0.0 if forward else math.pi)
            if np.linalg.norm(place - away) > FREE_METRES:
                car(builder, float(place[0]), float(place[1]), turn, painted)
    solids = builder.build()
    low, high = solids.bounds()
    none = np.zeros(0, np.int64)
    low, high = (low.min(axis=0), high.max(axis=0)) if len(solids) else (np.zeros(3), np.zeros(3))
    return CityBlock(photograph.i, photograph.j, solids, low, high, np.zeros((0, 3)), none, none, np.zeros((0, 3)))


class _Candidates:
    """Points that a photograph's camera may see. The method `see` marks the points that no solid hides.

    blocks: number of the caster's blocks that have points. A block of moving cars comes after them.
    """

    def __init__(self, caster: Caster, blocks: int) -> None:
        camera, position = caster.camera, caster.position
        near = [
            index
            for index, block in enumerate(caster.blocks[:blocks])
            if np.linalg.norm(_away(block, position)) < POINT_METRES
        ]
        chosen = [caster.blocks[index] for index in near]
        starts = np.repeat(caster.starts[near], POINTS_PER_BLOCK)
        solid = np.concatenate([block.solid_of_point for block in chosen])
        face = np.concatenate([block.face_of_point for block in chosen])
        surfaces = np.where(solid < 0, GROUND_FACE, (starts + solid) * FACES_PER_SOLID + face)
        places = np.concatenate([block.points + block.corner for block in chosen])
        normals = np.concatenate([block.normals for block in chosen])
        away = places - position
        faces_camera = np.einsum("ij,ij->i", away, normals) < 0
        a, b, _ = camera.model.places_of(camera, away @ camera.rotation.T)
        pixels = np.stack([camera.cx + camera.fx * a, camera.cy + camera.fy * b], axis=1)
        ahead = faces_camera & (np.einsum("ij,ij->i", away, away) < POINT_METRES**2)
        if camera.model.flat:
            ahead &= away @ camera.rotation[2] > 0.1
        with np.errstate(invalid="ignore"):
            ahead &= ((pixels >= 0) & (pixels < [camera.width, camera.height])).all(axis=1)
        rows = np.flatnonzero(ahead)
        self._numbers = np.array([[block.i, block.j] for block in chosen], np.int32)[rows // POINTS_PER_BLOCK]
        self._points, self._surfaces = (rows % POINTS_PER_BLOCK).astype(np.int32), surfaces[rows]
        self._pixels = pixels[rows]
        self._seen = np.zeros(len(rows), np.bool_)

    def see(self, surfaces: NDArray[np.int32], first: int, last: int) -> None:
        """Mark each point in the picture's rows [first, last) as visible if the ray nearest to it meets its surface.

        surfaces: (4, rows, columns), the surfaces that the rays meet, as in `Sight`.
        """
        y = self._pixels[:, 1]
        rows = np.flatnonzero((y >= first) & (y < last))
        x, y = self._pixels[rows].T
        column, row = np.floor(x).astype(np.int64), np.floor(y).astype(np.int64)
        sample = (x - column >= 0.5).astype(np.int64) + 2 * (y - row >= 0.5)
        self._seen[rows] = surfaces[sample, row - first, column] == self._surfaces[rows]

    def observations(self, pixels: Float32, mask: Bool | None) -> Observations:
        """Return the visible points where `mask` is True.

        pixels: (height, width, 3), colours of the photograph.
        mask: (height, width), False for pixels of moving cars; None without moving cars.
        """
        column, row = np.floor(self._pixels).astype(np.int64).T
        seen = self._seen if mask is None else self._seen & mask[row, column]
        colours = np.rint(pixels[row[seen], column[seen]] * 255).astype(np.uint8)
        return Observations(self._numbers[seen], self._points[seen], self._pixels[seen], colours)


def _away(block: CityBlock, position: Float64) -> Float64:
    """Return the horizontal vector (2,) from the nearest point of a block's ground to a position, in metres."""
    low = block.corner[:2]
    return np.asarray(position[:2] - np.clip(position[:2], low, low + BLOCK_METRES))
