# SPDX-License-Identifier: Apache-2.0
"""Shading of the rays that photograph the demo's town: textures, light, street markings and haze."""

from __future__ import annotations

from collections.abc import Sequence
from typing import Final

import numpy as np
from numpy.typing import NDArray

from clsplat.arrays import Bool, Float32
from clsplat.camera import Camera
from clsplat.demo.town import solids as table
from clsplat.demo.town import textures as paint
from clsplat.demo.town.blocks import (
    BLOCK_METRES,
    CARRIAGEWAY_METRES,
    GROUND_FACE,
    LOT_METRES,
    PAVEMENT_METRES,
    SKY_FACE,
    CityBlock,
)
from clsplat.demo.town.solids import FACES_PER_SOLID, SOLID_BALL, light_on
from clsplat.demo.town.textures import GROUND_METRES, HAZE_COLOUR, TEXTURE_SIDE, Textures
from clsplat.demo.town.visibility import SIGHT_METRES

HAZE_METRES = 150.0
"""Distance from the camera at which haze begins, in metres."""
SLANT_BLUR = np.float32(0.7)
"""Blurs surfaces seen at a slant: this times log2(1 / cosine of the slant) is added to their mip level."""
LOT_COVERS: Final = np.array([paint.GRASS] * 9 + [paint.SOIL] * 3 + [paint.GRAVEL] * 2 + [paint.PAVING] * 2, np.int32)
"""Textures from which each lot's ground gets one at random. Repeated ones are more probable."""
GROUND_DENSITY = np.float32(np.log2(TEXTURE_SIDE / GROUND_METRES))
"""log2 of the number of texels per metre of ground."""


class Shader:
    """Shades the rays of one photograph.

    blocks, starts: blocks in sight of the camera, and the number of each block's first solid, as in `Caster`.
    """

    def __init__(
        self, camera: Camera, blocks: Sequence[CityBlock], starts: NDArray[np.int64], textures: Textures, seed: int
    ) -> None:
        self.blocks, self.starts, self.textures, self.seed = blocks, starts, textures, seed
        self.position = camera.position
        self.pixel = np.float32(1 / max(camera.fx, camera.fy))

    def colours(self, directions: Float32, surfaces: NDArray[np.int32]) -> Float32:
        """Return the linear colours (n, 3) that rays see.

        directions: (n, 3), directions of the rays, as from `world_rays`.
        surfaces: (n,), numbers of the surfaces that the rays meet, as in `Sight`.
        """
        result = np.empty((len(surfaces), 3), np.float32)
        for surface, shade in ((SKY_FACE, self.textures.sky), (GROUND_FACE, self._ground)):
            some = np.flatnonzero(surfaces == surface)
            if len(some):
                result[some] = shade(directions.take(some, axis=0))
        rest = np.flatnonzero(surfaces >= 0)
        if len(rest):
            rows, faces, balls = self._faces(surfaces.take(rest))
            is_ball = balls.take(rows)
            for of_solid, chosen in ((self._flat, ~is_ball), (self._ball, is_ball)):
                here = np.flatnonzero(chosen)
                if len(here):
                    some = rest.take(here)
                    result[some] = of_solid(directions.take(some, axis=0), faces.take(rows.take(here), axis=0))
        return result

    def _faces(self, surfaces: NDArray[np.int32]) -> tuple[NDArray[np.int64], Float32, Bool]:
        """Collect the rows of `Solids.faces` of all faces among `surfaces` (n,), in metres relative to the camera.

        Returns the index (n,) of each surface's row, the rows, and a mask of the rows of balls. The row of a ball has
        the ball's centre and radius in place of the plane.
        """
        seen = np.zeros(self.starts[-1] * FACES_PER_SOLID, np.bool_)
        seen[surfaces] = True
        numbers = np.flatnonzero(seen)
        place = np.zeros(len(seen), np.int64)
        place[numbers] = np.arange(len(numbers))
        faces = np.empty((len(numbers), table.FACE_VALUES))
        balls = np.empty(len(numbers), np.bool_)
        solid, face = numbers // FACES_PER_SOLID, numbers % FACES_PER_SOLID
        ends = np.searchsorted(solid, self.starts)
        for index in np.flatnonzero(ends[1:] > ends[:-1]).tolist():
            rows, block = slice(ends[index], ends[index + 1]), self.blocks[index]
            own, away = solid[rows] - self.starts[index], block.corner - self.position
            part = block.solids.faces[own, face[rows]]
            balls[rows] = block.solids.kinds[own] == SOLID_BALL
            part[:, table.PLANE_AT + 3] += part[:, :3] @ away
            for start in (table.U_AT, table.V_AT):
                part[:, start + 3] -= part[:, start : start + 3] @ away
            ball = balls[rows]
            part[ball, :3] = (block.solids.centres[own] + away)[ball]
            part[ball, 3] = block.solids.halves[own, 0][ball]
            faces[rows] = part
        return place[surfaces], faces.astype(np.float32), balls

    def _flat(self, directions: Float32, faces: Float32) -> Float32:
        x, y, z = directions.T
        slope = faces[:, 0] * x + faces[:, 1] * y + faces[:, 2] * z
        depth = faces[:, 3] / slope
        points = depth[:, None] * directions
        u = np.einsum("ij,ij->i", faces[:, 4:7], points) + faces[:, 7]
        v = np.einsum("ij,ij->i", faces[:, 8:11], points) + faces[:, 11]
        length = np.sqrt(x * x + y * y + z * z)
        level = self._level(depth, faces[:, table.DENSITY_AT], np.abs(slope) / length)
        colours = self.textures.colours(faces[:, table.TEXTURE_AT].astype(np.int32), u, v, level)
        height = points[:, 2] + np.float32(self.position[2])
        shade = 1 - faces[:, table.DARKNESS_AT] * np.exp(-np.maximum(height, 0) * np.float32(0.5))
        colours = colours * faces[:, table.LIGHT_AT : table.LIGHT_AT + 3]
        colours *= shade[:, None]
        return _hazy(colours, depth * length)

    def _ball(self, directions: Float32, faces: Float32) -> Float32:
        centre, radius = faces[:, :3], faces[:, 3]
        square = np.einsum("ij,ij->i", directions, directions)
        along = np.einsum("ij,ij->i", directions, centre)
        rest = along * along - square * (np.einsum("ij,ij->i", centre, centre) - radius * radius)
        depth = (along - np.sqrt(np.maximum(rest, 0))) / square
        normals = (depth[:, None] * directions - centre) / radius[:, None]
        u, v = _cube_coordinates(normals, radius)
        level = self._level(depth, faces[:, table.DENSITY_AT], np.full(len(depth), 0.7, np.float32))
        shift_u, shift_v = faces[:, table.U_AT + 3], faces[:, table.V_AT + 3]
        side = np.float32(1 / paint.LEAF_METRES)
        texture = faces[:, table.TEXTURE_AT].astype(np.int32)
        colours = self.textures.colours(texture, u * side + shift_u, v * side + shift_v, level)
        inner = 0.72 + 0.28 * normals[:, 2:]
        tint = faces[:, table.LIGHT_AT : table.LIGHT_AT + 3]
        return _hazy(colours * light_on(normals) * tint * inner, depth * np.sqrt(square))

    def _ground(self, directions: Float32) -> Float32:
        x, y, z = directions.T
        depth = np.float32(-self.position[2]) / z
        first = np.floor(self.position[:2] / BLOCK_METRES)
        inner = (self.position[:2] - first * BLOCK_METRES).astype(np.float32)
        px, py = depth * x + inner[0], depth * y + inner[1]
        length = np.sqrt(x * x + y * y + z * z)
        level = self._level(depth, GROUND_DENSITY, -z / length)
        width = depth * self.pixel
        texture, tint = self._ground_cover(px, py, first.astype(np.int64))
        side = np.float32(1 / GROUND_METRES)
        origin = np.asarray(first * BLOCK_METRES / GROUND_METRES % 1, np.float32)
        colours = self.textures.colours(texture, px * side + origin[0], py * side + origin[1], level) * tint
        _mark_streets(colours, px % BLOCK_METRES, py % BLOCK_METRES, width / np.sqrt(-z / length))
        return _hazy(colours * light_on(np.array([[0, 0, 1]], np.float32)), depth * length)

    def _ground_cover(self, px: Float32, py: Float32, first: NDArray[np.int64]) -> tuple[NDArray[np.int32], Float32]:
        """Choose textures (n,) and tints (n, 3) of points on the ground.

        px, py: (n,), coordinates x and y of the points, in metres from the corner of the block `first`.
        first: (2,), the two indices of a block.
        """
        column, row = np.floor(px / BLOCK_METRES), np.floor(py / BLOCK_METRES)
        fx, fy = px - column * BLOCK_METRES, py - row * BLOCK_METRES
        inner = np.minimum(_to_street(fx), _to_street(fy))
        lot_x, lot_y = ((place - PAVEMENT_METRES) * np.float32(1 / LOT_METRES) for place in (fx, fy))
        lot = np.clip(lot_x, 0, 2.5).astype(np.int64) + 3 * np.clip(lot_y, 0, 2.5).astype(np.int64)
        far = np.abs(column) + np.abs(row) > 1e6  # near the horizon haze hides the ground, so any block will do
        column, row = (
            np.where(far, 0, column).astype(np.int64) + first[0],
            np.where(far, 0, row).astype(np.int64) + first[1],
        )
        mark = (column * 0x9E3779B1) ^ (row * 0x85EBCA77) ^ (lot * 0xC2B2AE3D) ^ (self.seed * 0x27D4EB2F)
        mark = (mark ^ (mark >> 15)) * 0x2C1B3C6D & 0xFFFFFFFF
        mark ^= mark >> 13
        texture = LOT_COVERS[mark & 15]
        texture = np.where(inner < CARRIAGEWAY_METRES, np.int32(paint.ASPHALT), texture)
        pavement = (inner >= CARRIAGEWAY_METRES) & (inner < PAVEMENT_METRES)
        texture = np.where(pavement, np.int32(paint.PAVEMENT), texture)
        tint = np.stack([((mark >> shift) & 15).astype(np.float32) for shift in (4, 8, 12)], axis=1)
        tint = np.float32(0.88) + tint * np.float32(0.016)
        tint[inner < PAVEMENT_METRES] = 1
        return texture.astype(np.int32), tint

    def near_ground_seam(self, directions: Float32) -> Bool:
        """Return True (n,) for rays that meet the ground within a pixel's width of a seam between two materials."""
        x, y, z = directions.T
        with np.errstate(divide="ignore", invalid="ignore", over="ignore"):
            depth = np.float32(-self.position[2]) / z
            inner = (self.position[:2] % BLOCK_METRES).astype(np.float32)
            fx, fy = (depth * x + inner[0]) % BLOCK_METRES, (depth * y + inner[1]) % BLOCK_METRES
            away_x, away_y = _to_street(fx), _to_street(fy)
            away = np.minimum(away_x, away_y)
            seam = np.minimum(np.abs(away - CARRIAGEWAY_METRES), np.abs(away - PAVEMENT_METRES))
            for place in (fx, fy):
                lot = (place - PAVEMENT_METRES) % LOT_METRES
                seam = np.minimum(seam, np.minimum(lot, LOT_METRES - lot))
            slant = -z / np.sqrt(x * x + y * y + z * z)
            return np.asarray(seam * slant < depth * self.pixel)

    def _level(self, depth: Float32, density: Float32 | np.float32, slant: Float32) -> Float32:
        """Compute the mip level (n,) at the points that rays meet.

        depth: (n,), factor by which a ray's direction is multiplied to reach the point.
        density: log2 of the texture's texels per metre.
        slant: (n,), cosine of the angle between the ray and the surface's normal.
        """
        return np.asarray(
            np.log2(np.maximum(depth * self.pixel, 1e-6)) + density - SLANT_BLUR * np.log2(np.maximum(slant, 0.03))
        )


def _hazy(colours: Float32, distance: Float32) -> Float32:
    """Blend colours (n, 3) with the haze at distances (n,) in metres."""
    share = np.clip((distance - HAZE_METRES) * np.float32(1 / (SIGHT_METRES - HAZE_METRES)), 0, 1)
    if not share.any():
        return colours
    share = share * share * (3 - 2 * share)
    return np.asarray(colours + share[:, None] * (HAZE_COLOUR - colours))


def _to_street(place: Float32) -> Float32:
    """Return distances (n,) in metres to the middle of the nearest street that crosses an axis.

    place: (n,), coordinates along the axis, relative to the block, in [0, BLOCK_METRES).
    """
    return np.asarray(np.minimum(place, np.float32(BLOCK_METRES) - place))


def _cube_coordinates(normals: Float32, radius: Float32) -> tuple[Float32, Float32]:
    """Return texture coordinates u and v (n,) in metres on balls: the two smaller components of normals times radius.

    normals: (n, 3), unit normals. radius: (n,), radii of the balls in metres.
    """
    x, y, z = normals.T
    ax, ay, az = np.abs(normals).T
    along_z, along_x = (az >= ax) & (az >= ay), ax > ay
    u = np.where(along_z, x, np.where(along_x, y + 3, x + 5))
    v = np.where(along_z, y, z)
    return u * radius, v * radius


def _mark_streets(colours: Float32, fx: Float32, fy: Float32, width: Float32) -> None:
    """Paint kerbs, dashes and zebra crossings over the ground's colours, in place.

    colours: (n, 3), the ground's colours.
    fx, fy: (n,), the pixels' coordinates x and y relative to the block, in metres.
    width: (n,), width of a pixel on the ground, in metres.
    """
    away_x, away_y = _to_street(fx), _to_street(fy)
    near, far = np.minimum(away_x, away_y), np.maximum(away_x, away_y)
    along = np.where(away_x < away_y, fy, fx)
    kerb = _band(near, CARRIAGEWAY_METRES, 0.12, width)
    colours += kerb[:, None] * (np.float32(0.55) - colours)
    outside = np.clip((far - 9.5) / width + 0.5, 0, 1)
    white = _band(near, 0.0, 0.09, width) * _band(along % np.float32(4.0), 2.0, 1.0, width) * outside
    zebra = _band(far, 8.6, 1.3, width) * _band(near % np.float32(1.0), 0.5, 0.27, width)
    white = np.maximum(white, zebra * np.clip((4.6 - near) / width + 0.5, 0, 1))
    colours += (0.85 * white)[:, None] * (np.float32(0.75) - colours)


def _band(place: Float32, middle: float, half: float, width: Float32) -> Float32:
    """Return the fraction (n,) of each pixel that a band from `middle` - `half` to `middle` + `half` covers.

    place, width: (n,), centre and width of the pixels. All arguments have the same unit.
    """
    away = np.abs(place - np.float32(middle))
    low = np.maximum(away - width / 2, -half)
    return np.asarray(np.clip((np.minimum(away + width / 2, half) - low) / width, 0, 1))
