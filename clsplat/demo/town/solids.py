# SPDX-License-Identifier: Apache-2.0
"""Solids of the demo town's blocks: boxes, gabled roofs and balls, with textured faces.

Each face is a row in a table of numbers. Texture coordinates are a linear function of the position on the face, so that
a pixel needs one texture look-up.
"""

from __future__ import annotations

from dataclasses import dataclass, field

import numpy as np
from numpy.typing import NDArray

from clsplat.arrays import Float32, Float64
from clsplat.demo.ray_caster import SKY_COLOUR, SUN_COLOUR, SUN_DIRECTION
from clsplat.demo.town.textures import TEXTURE_SIDE

SOLID_BOX, SOLID_ROOF, SOLID_BALL = range(3)
FACES_PER_SOLID = 8
"""Number of rows of a solid in the table of faces. A box uses the first six, for the faces -x, +x, -y, +y, -z and +z. A
roof has the faces -x, +x and -z, and its two slopes in the last two rows. A ball uses only the first row."""
FACE_VALUES = 18
"""Number of values in a face's row. The face's plane is n p = d, its texture coordinates u = U p + u0, v = V p + v0.

The values are n (3), d, U (3), u0, V (3), v0, then red, green and blue of the face's light. The last three are the
index of its texture, log2 of texels per metre, and darkness at the ground.
"""
PLANE_AT, U_AT, V_AT, LIGHT_AT, TEXTURE_AT, DENSITY_AT, DARKNESS_AT = 0, 4, 8, 12, 15, 16, 17
"""Indices of values in the row of a face (FACE_VALUES)."""
BOUNCED_LIGHT = np.float32(0.11)
"""Light that the ground reflects to a surface that faces down."""
Triple = tuple[float, float, float]


def light_on(normals: Float32) -> Float32:
    """Return the light (n, 3) of sky, sun and ground on surfaces with unit normals (n, 3), without shadows."""
    rise = normals[:, 2:]
    sun = np.maximum(normals @ SUN_DIRECTION, 0)[:, None]
    return np.asarray(
        SKY_COLOUR * (0.60 + 0.38 * rise) + SUN_COLOUR * sun + BOUNCED_LIGHT * (1 - rise) * np.float32(0.5)
    )


@dataclass(frozen=True)
class Cover:
    """Texture and colour of a face.

    texture: index of the texture.
    metres: length of a side of the texture, in metres.
    tint: factors of the texture's red, green and blue.
    shift: offset of the texture to the right and up, as a fraction of its side.
    darkness: fraction of the light that is missing near the ground, at z = 0.
    """

    texture: int
    metres: float
    tint: Triple = (1.0, 1.0, 1.0)
    shift: tuple[float, float] = (0.0, 0.0)
    darkness: float = 0.35

    def numbers(self) -> tuple[float, ...]:
        """Return the cover as a row of 8 numbers: texture, metres, tint (3), shift (2), darkness."""
        return (self.texture, self.metres, *self.tint, *self.shift, self.darkness)


@dataclass(eq=False)
class Solids:
    """Solids of a block. Lengths are in metres, positions relative to the block's corner, and z is up.

    kinds: (n,), SOLID_BOX, SOLID_ROOF or SOLID_BALL.
    centres: (n, 3) float64. A roof's centre is in the middle of its base.
    halves: (n, 3) float64, half sizes along the solid's own axes. A roof's third value is its height. The ridge is
    along x.
    turns: (n, 2) float64, cosine and sine of each solid's rotation about z.
    faces: (n, FACES_PER_SOLID, FACE_VALUES) float64, the table of faces.
    """

    kinds: NDArray[np.int32] = field(default_factory=lambda: np.zeros(0, np.int32))
    centres: Float64 = field(default_factory=lambda: np.zeros((0, 3)))
    halves: Float64 = field(default_factory=lambda: np.zeros((0, 3)))
    turns: Float64 = field(default_factory=lambda: np.zeros((0, 2)))
    faces: Float64 = field(default_factory=lambda: np.zeros((0, FACES_PER_SOLID, FACE_VALUES)))

    def __len__(self) -> int:
        return len(self.kinds)

    def bounds(self) -> tuple[Float64, Float64]:
        """Return the lowest and highest corners, (n, 3) each, of boxes around the solids, along the block's axes."""
        c, s = np.abs(self.turns).T
        x, y, z = self.halves.T
        reach = np.stack([c * x + s * y, s * x + c * y, z], axis=1)
        low, high = self.centres - reach, self.centres + reach
        roofs = self.kinds == SOLID_ROOF
        low[roofs, 2] = self.centres[roofs, 2]
        return low, high


@dataclass(frozen=True)
class _Row:
    """A solid in a `Builder`, with a cover for its sides and another for its top."""

    kind: int
    centre: tuple[float, float, float]
    half: tuple[float, float, float]
    turn: float
    side: Cover
    top: Cover


class Builder:
    """Collects solids one by one, to make `Solids`. Lengths are in metres; `turn` is a rotation about z in radians."""

    def __init__(self) -> None:
        self._rows: list[_Row] = []

    def box(self, centre: Triple, half: Triple, side: Cover, top: Cover, turn: float = 0.0) -> None:
        """Add a box with covers for its sides and its top. The underside has the cover of the sides.

        half: half sizes along the box's own axes.
        """
        self._rows.append(_Row(SOLID_BOX, centre, half, turn, side, top))

    def roof(self, base: Triple, half: Triple, slope: Cover, gable: Cover, turn: float = 0.0) -> None:
        """Add a gabled roof. Its ridge is along x before the rotation by `turn`.

        base: middle of the roof's base.
        half: half of the roof's length, half of its width, and its height.
        """
        self._rows.append(_Row(SOLID_ROOF, base, half, turn, gable, slope))

    def ball(self, centre: Triple, radius: float, cover: Cover) -> None:
        """Add a ball. Shading computes its normals and texture coordinates where rays meet it."""
        self._rows.append(_Row(SOLID_BALL, centre, (radius, radius, radius), 0.0, cover, cover))

    def build(self) -> Solids:
        """Return all solids that were added, with their table of faces."""
        if not self._rows:
            return Solids()
        angles = np.array([row.turn for row in self._rows])
        solids = Solids(
            np.array([row.kind for row in self._rows], np.int32),
            np.array([row.centre for row in self._rows], np.float64),
            np.array([row.half for row in self._rows], np.float64),
            np.stack([np.cos(angles), np.sin(angles)], axis=1),
        )
        solids.faces = _faces(solids, [row.side for row in self._rows], [row.top for row in self._rows])
        return solids


def about_z(vectors: Float64, turns: Float64) -> Float64:
    """Rotate vectors (n, 3) about z. turns: (n, 2), cosines and sines of the angles."""
    x, y, z = vectors.T
    c, s = turns.T
    return np.stack([c * x - s * y, s * x + c * y, z], axis=1)


def slopes(halves: Float64, sign: float) -> tuple[Float64, Float64]:
    """Return the normals of one slope of each roof, and the directions in this slope to the ridge, (n, 3) each.

    halves: (n, 3), half sizes of the roofs, as in `Solids`.
    sign: 1 or -1, the sign of the normals' y. It chooses the slope.
    """
    steep = np.hypot(halves[:, 1], halves[:, 2])
    across, up, zero = halves[:, 2] / steep, halves[:, 1] / steep, np.zeros(len(halves))
    return np.stack([zero, sign * across, up], axis=1), np.stack([zero, -sign * up, across], axis=1)


def _faces(solids: Solids, sides: list[Cover], tops: list[Cover]) -> Float64:
    """Compute the table of faces of solids, (n, FACES_PER_SOLID, FACE_VALUES).

    sides, tops: covers (n,) of the solids' sides and of their tops.
    """
    table = np.zeros((len(solids), FACES_PER_SOLID, FACE_VALUES))
    of_side, of_top = (np.array([cover.numbers() for cover in covers]) for covers in (sides, tops))
    c, s = solids.turns.T
    zero, one = np.zeros(len(solids)), np.ones(len(solids))
    upward = np.stack([zero, zero, one], axis=1)
    for code in range(6):
        axis, sign = code // 2, 2.0 * (code % 2) - 1
        own = np.zeros((len(solids), 3))
        own[:, axis] = sign
        normals, at = about_z(own, solids.turns), about_z(own * solids.halves, solids.turns) + solids.centres
        if axis == 2:
            u, v, begin = np.stack([c, s, zero], axis=1), np.stack([-sign * s, sign * c, zero], axis=1), at
        else:
            u, v = np.stack([-normals[:, 1], normals[:, 0], zero], axis=1), upward
            begin = at - solids.halves[:, 1 - axis, None] * u
            begin[:, 2] = np.where(solids.kinds == SOLID_ROOF, solids.centres[:, 2], 0)
        if code == 4:
            at = np.where((solids.kinds == SOLID_ROOF)[:, None], solids.centres, at)
        _fill(table[:, code], (normals, at, begin), (u, v), of_top if code == 5 else of_side)
    ridge = solids.centres + solids.halves[:, 2:] * upward
    for code, sign in ((6, 1.0), (7, -1.0)):
        normals, up = (about_z(each, solids.turns) for each in slopes(solids.halves, sign))
        _fill(table[:, code], (normals, ridge, ridge), (np.stack([-sign * c, -sign * s, zero], axis=1), up), of_top)
    balls = solids.kinds == SOLID_BALL
    table[balls, 0, LIGHT_AT : LIGHT_AT + 3] = of_side[balls, 2:5]
    return table


def _fill(
    rows: Float64, place: tuple[Float64, Float64, Float64], along: tuple[Float64, Float64], covers: Float64
) -> None:
    """Fill `rows` (n, FACE_VALUES) of the table of faces, which are the same face of n solids.

    place: the faces' normals, points on their planes, and origins of their textures, (n, 3) each.
    along: directions to the right and up in the textures, (n, 3) each.
    covers: (n, 8), the faces' covers as from `Cover.numbers`.
    """
    normals, at, begin = place
    metres, shifts = covers[:, 1], covers[:, 5:7]
    rows[:, PLANE_AT : PLANE_AT + 3], rows[:, PLANE_AT + 3] = normals, np.einsum("ij,ij->i", normals, at)
    for start, direction, shift in zip((U_AT, V_AT), along, shifts.T, strict=True):
        rows[:, start : start + 3] = direction / metres[:, None]
        rows[:, start + 3] = shift - np.einsum("ij,ij->i", direction, begin) / metres
    rows[:, LIGHT_AT : LIGHT_AT + 3] = light_on(normals.astype(np.float32)) * covers[:, 2:5]
    rows[:, TEXTURE_AT], rows[:, DENSITY_AT], rows[:, DARKNESS_AT] = (
        covers[:, 0],
        np.log2(TEXTURE_SIDE / metres),
        covers[:, 7],
    )
