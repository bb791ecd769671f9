# SPDX-License-Identifier: Apache-2.0
"""City blocks of the demo's town: houses, flats or a park, trees, cars, and points on the surfaces.

The town is an endless grid of blocks. A block depends on the seed and its two indices alone. Its corner, at low x and
y, is the crossing of two streets, which run along x and y. The ground is z = 0.
"""

from __future__ import annotations

from dataclasses import dataclass
from functools import lru_cache
from typing import Final

import numpy as np
from numpy.typing import NDArray

from clsplat.arrays import Float64
from clsplat.demo.town import textures as paint
from clsplat.demo.town.solids import SOLID_BALL, SOLID_ROOF, Builder, Cover, Solids, about_z, slopes

BLOCK_METRES = 60.0
CARRIAGEWAY_METRES, PAVEMENT_METRES = 5.0, 7.5
"""Distances from the middle of a street to the edge of its carriageway and to the outer edge of its pavement."""
LOT_METRES = (BLOCK_METRES - 2 * PAVEMENT_METRES) / 3
PARKED_METRES, DRIVEN_METRES = 4.0, 1.7
"""Distances from the middle of a street at which cars park and at which they drive."""
STOREY_METRES, WINDOW_METRES = 3.0, 3.0
POINTS_PER_BLOCK = 1200
GROUND_POINTS = 400
"""Number of a block's points that lie on the ground."""
MAX_HEIGHT_METRES, BLOCK_REACH_METRES = 20.0, 12.0
"""Maximum height of a block's solids, and the most by which they (trees, cars) extend beyond the block's edges."""
GROUND_FACE, SKY_FACE = -1, -2
"""Numbers that stand for the ground and the sky, which are not faces of a solid."""
CAR_PAINTS: Final = np.array(
    [[0.8, 0.8, 0.8], [0.08, 0.08, 0.09], [0.5, 0.06, 0.05], [0.08, 0.16, 0.42], [0.4, 0.4, 0.4]]
)
_BLOCKS_KEPT = 512


@dataclass(eq=False)
class CityBlock:
    """A block of the town.

    i, j: indices of the block along x and y.
    solids: houses, trees and so on, in metres from the block's corner.
    low, high: corners (3,) of a box around the solids.
    points: (POINTS_PER_BLOCK, 3) float64, points on the surfaces, in metres from the block's corner.
    solid_of_point: (POINTS_PER_BLOCK,), index of the solid on which a point lies, or GROUND_FACE.
    face_of_point: (POINTS_PER_BLOCK,), index of the solid's face on which a point lies.
    normals: (POINTS_PER_BLOCK, 3), outward normals at the points.
    """

    i: int
    j: int
    solids: Solids
    low: Float64
    high: Float64
    points: Float64
    solid_of_point: NDArray[np.int64]
    face_of_point: NDArray[np.int64]
    normals: Float64

    @property
    def corner(self) -> Float64:
        """The corner (3,) of the block in the town's coordinates."""
        return np.array([self.i * BLOCK_METRES, self.j * BLOCK_METRES, 0.0])


@lru_cache(maxsize=_BLOCKS_KEPT)
def city_block(seed: int, i: int, j: int) -> CityBlock:
    """Build block (i, j) of the town with this seed, or return it from a cache."""
    generator = block_generator(seed, 0, i, j)
    builder = Builder()
    kind = generator.choice(("houses", "flats", "park"), p=(0.6, 0.28, 0.12))
    {"houses": _houses, "flats": _flats, "park": _park}[str(kind)](builder, generator)
    _street_trees(builder, generator)
    _parked_cars(builder, generator)
    solids = builder.build()
    low, high = solids.bounds()
    points = _points(solids, generator)
    return CityBlock(i, j, solids, low.min(axis=0), high.max(axis=0), *points)


def block_generator(seed: int, purpose: int, i: int, j: int, *more: int) -> np.random.Generator:
    """Return a random generator for block (i, j) of the town with this seed. The indices may be negative.

    purpose: number that gives each use (solids, photographs, cars ...) random numbers of its own.
    more: further numbers that the random numbers depend on.
    """
    return np.random.default_rng([seed, purpose, i & 0xFFFFFFFF, j & 0xFFFFFFFF, *more])


def car(builder: Builder, x: float, y: float, turn: float, paint_of_car: Float64) -> None:
    """Add a car, 4.2 metres long, at x, y in metres.

    turn: the driving direction, as an angle from x in radians.
    paint_of_car: (3,), red, green and blue of the body.
    """
    tint = (float(paint_of_car[0]), float(paint_of_car[1]), float(paint_of_car[2]))
    body, glass = Cover(paint.PLAIN, 4.0, tint), Cover(paint.PLAIN, 4.0, (0.07, 0.09, 0.11))
    back = np.array([np.cos(turn), np.sin(turn)]) * 0.25
    builder.box((x, y, 0.55), (2.1, 0.88, 0.37), body, body, turn)
    builder.box((x - back[0], y - back[1], 1.17), (1.15, 0.76, 0.27), glass, body, turn)


def _tint(generator: np.random.Generator, spread: float = 0.14) -> tuple[float, float, float]:
    grey, hue = 1 + generator.uniform(-spread, spread), generator.uniform(-0.5 * spread, 0.5 * spread, 3)
    red, green, blue = grey + hue
    return float(red), float(green), float(blue)


def _shift(generator: np.random.Generator) -> tuple[float, float]:
    u, v = generator.uniform(0, 1, 2)
    return float(u), float(v)


def _tree(builder: Builder, generator: np.random.Generator, x: float, y: float, size: float) -> None:
    height = size * generator.uniform(2.0, 2.8)
    bark = Cover(paint.BARK, 2.0)
    builder.box((x, y, height / 2 - 0.1), (0.14, 0.14, height / 2 + 0.1), bark, bark)
    leaves = Cover(
        int(generator.choice(paint.LEAVES, p=(0.75, 0.25))), paint.LEAF_METRES, _tint(generator), _shift(generator)
    )
    builder.ball((x, y, height + 0.6 * size), size, leaves)
    for _ in range(int(generator.integers(1, 3))):
        angle, less = generator.uniform(0, 2 * np.pi), generator.uniform(0.55, 0.75)
        away = 0.75 * size * np.array([np.cos(angle), np.sin(angle)])
        builder.ball((x + away[0], y + away[1], height + size * generator.uniform(0.2, 0.9)), less * size, leaves)


def _house(builder: Builder, generator: np.random.Generator, x: float, y: float, turn: float) -> None:
    """Add a detached house at x, y in metres, with a chimney and a gabled roof. turn: angle from x to the ridge."""
    half = [float(generator.integers(least, least + 2)) * WINDOW_METRES / 2 for least in (3, 2)]
    eaves = STOREY_METRES * float(generator.integers(1, 3)) + 0.15
    shift = (float(generator.integers(4)) / 4, 0.0)
    wall = Cover(int(generator.choice(paint.FACADES[:5])), paint.FACADE_METRES, _tint(generator), shift)
    tiles = Cover(int(generator.choice(paint.ROOFS[:3])), paint.ROOF_METRES, _tint(generator), _shift(generator), 0.0)
    plaster = Cover(paint.GRAVEL, 4.0, _tint(generator, 0.3), _shift(generator))
    centre = (x, y, (eaves - 1) / 2)
    builder.box(centre, (half[0], half[1], (eaves + 1) / 2 + 0.02), wall, tiles, turn)
    rise = half[1] * generator.uniform(0.55, 0.95)
    builder.roof((x, y, eaves), (half[0] + 0.4, half[1] + 0.5, rise), tiles, plaster, turn)
    along = np.array([np.cos(turn), np.sin(turn)]) * half[0] * generator.uniform(-0.7, 0.7)
    brick = Cover(9, 3.0, _tint(generator), _shift(generator))
    builder.box((x + along[0], y + along[1], eaves + rise * 0.6), (0.35, 0.3, rise * 0.4 + 0.8), brick, brick, turn)


def _houses(builder: Builder, generator: np.random.Generator) -> None:
    """Add houses on the lots along the streets, hedges, and trees in the gardens."""
    for lot in range(9):
        column, row = lot % 3, lot // 3
        x, y = (PAVEMENT_METRES + (place + 0.5) * LOT_METRES for place in (column, row))
        if lot == 4 or generator.uniform() < 0.08:
            for _ in range(3):
                dx, dy = generator.uniform(-5, 5, 2)
                _tree(builder, generator, x + dx, y + dy, generator.uniform(1.6, 2.6))
            continue
        turn = (np.pi / 2) * generator.integers(2) + generator.normal(0, 0.03)
        _house(builder, generator, x + generator.uniform(-0.6, 0.6), y + generator.uniform(-0.6, 0.6), float(turn))
        dx, dy = generator.choice((-6.2, 6.2), 2)
        _tree(builder, generator, x + dx, y + dy, generator.uniform(0.9, 1.5))
        if generator.uniform() < 0.6:
            hedge = Cover(paint.LEAVES[0], 2.0, _tint(generator), _shift(generator), 0.5)
            tall = generator.uniform(0.7, 1.3)
            x += generator.choice((-7.2, 7.2))
            builder.box((x, y, tall / 2 - 0.5), (0.3, 5.5, tall / 2 + 0.5), hedge, hedge)


def _flats(builder: Builder, generator: np.random.Generator) -> None:
    """Add two or three long buildings with flat roofs, and trees between them."""
    gravel = Cover(paint.ROOFS[3], paint.ROOF_METRES, _tint(generator), _shift(generator), 0.0)
    metal = Cover(paint.ROOFS[4], 3.0, _tint(generator), _shift(generator), 0.0)
    rows = ((9.0, 2.0), (30.0, 2.0), (51.0, 2.0)) if generator.uniform() < 0.4 else ((14.0, 3.0), (46.0, 3.0))
    upright = bool(generator.integers(2))
    for place, deep in rows:
        windows, storeys = generator.integers((9, 3), (14, 5)).tolist()
        long, wide, tall = windows * WINDOW_METRES / 2, deep * WINDOW_METRES, STOREY_METRES * storeys
        inner = PAVEMENT_METRES + 1.0 + wide
        across = float(np.clip(place, inner, BLOCK_METRES - inner))
        x, y, turn = (across, 30.0, np.pi / 2) if upright else (30.0, across, 0.0)
        wall = Cover(
            int(generator.choice(paint.FACADES[4:])), paint.FACADE_METRES, _tint(generator), (0.25 * (place % 4), 0.0)
        )
        rim = Cover(paint.GRAVEL, 4.0, (0.75, 0.75, 0.78), _shift(generator))
        builder.box((x, y, (tall - 1) / 2), (long, wide, (tall + 1) / 2), wall, gravel, turn)
        builder.box((x, y, tall + 0.1), (long + 0.3, wide + 0.3, 0.3), rim, gravel, turn)
        for _ in range(int(generator.integers(2, 5))):
            dx, dy = generator.uniform(-0.8, 0.8) * long, generator.uniform(-0.5, 0.5) * wide
            dx, dy = (dy, dx) if upright else (dx, dy)
            a, b, c = generator.uniform((0.6, 0.6, 0.5), (1.8, 1.4, 1.1)).tolist()
            builder.box((x + dx, y + dy, tall + c), (a, b, c), metal, metal)
    for _ in range(8):
        free = 30.0 + generator.uniform(-5, 5) if len(rows) == 2 else generator.choice((19.5, 40.5))
        along = generator.uniform(12, 48)
        place, other = (free, along) if upright else (along, free)
        _tree(builder, generator, float(place), float(other), generator.uniform(1.0, 2.2))


def _park(builder: Builder, generator: np.random.Generator) -> None:
    """Add the trees, the pavilion and the benches of a park."""
    places: list[Float64] = []
    while len(places) < 22:
        place = generator.uniform(11, 49, 2)
        if np.linalg.norm(place - 30) > 7 and all(np.linalg.norm(place - other) > 4.2 for other in places):
            places.append(place)
            _tree(builder, generator, float(place[0]), float(place[1]), generator.uniform(1.3, 2.9))
    _house(builder, generator, 30.0, 30.0, float(generator.uniform(0, np.pi)))
    wood = Cover(paint.BARK, 2.0, (1.4, 1.2, 1.0), _shift(generator))
    for x, y in generator.uniform(10, 50, (5, 2)):
        builder.box((x, y, 0.2), (0.9, 0.25, 0.28), wood, wood, float(generator.uniform(0, np.pi)))


def _street_trees(builder: Builder, generator: np.random.Generator) -> None:
    """Add trees and lamps on the pavements of the block's two streets."""
    metal = Cover(paint.PLAIN, 2.0, (0.22, 0.25, 0.24))
    for along_y in (False, True):
        for place in np.arange(13.0, 54.0, 8.0) + generator.uniform(-1.0, 1.0, 6):
            across = 6.7 * generator.choice((-1, 1))
            x, y = (across, place) if along_y else (place, across)
            if generator.uniform() < 0.3:
                builder.box((x, y, 2.4), (0.07, 0.07, 2.6), metal, metal)
                builder.box((x, y, 5.0), (0.3, 0.3, 0.14), metal, metal)
            else:
                _tree(builder, generator, float(x), float(y), generator.uniform(0.9, 1.4))


def _parked_cars(builder: Builder, generator: np.random.Generator) -> None:
    for along_y in (False, True):
        for place in np.arange(12.0, 52.0, 6.0):
            if generator.uniform() < 0.35:
                side = generator.choice((-1.0, 1.0))
                x, y = (side * PARKED_METRES, place) if along_y else (place, side * PARKED_METRES)
                turn = (np.pi / 2 if along_y else 0.0) + (np.pi if generator.uniform() < 0.5 else 0.0)
                car(builder, float(x), float(y), float(turn), generator.choice(CAR_PAINTS))


def _points(
    solids: Solids, generator: np.random.Generator
) -> tuple[Float64, NDArray[np.int64], NDArray[np.int64], Float64]:
    """Draw random points on the ground and the solids of a block, but not on undersides.

    Returns the points and, for each point, its solid, face and normal, as in `CityBlock`.
    """
    ground = np.zeros((GROUND_POINTS, 3))
    ground[:, :2] = generator.uniform(0, BLOCK_METRES, (GROUND_POINTS, 2))
    count = POINTS_PER_BLOCK - GROUND_POINTS
    x, y, z = solids.halves.T
    roofs, balls = solids.kinds == SOLID_ROOF, solids.kinds == SOLID_BALL
    steep = np.hypot(y, z)
    areas = np.zeros((len(solids), 8))
    areas[:, :2], areas[:, 2:4] = (4 * y * z)[:, None], (4 * x * z)[:, None]
    areas[:, 5] = 4 * x * y
    areas[roofs] = np.stack([y * z, y * z, 0 * x, 0 * x, 0 * x, 0 * x, 2 * x * steep, 2 * x * steep], axis=1)[roofs]
    areas[balls] = 0
    areas[balls, 0] = 2 * np.pi * x[balls] ** 2  # count half of a ball's area, so that foliage gets fewer points
    chosen = generator.choice(areas.size, count, p=(areas / areas.sum()).ravel())
    solid, face = chosen // 8, chosen % 8
    a, b = generator.uniform(-1, 1, (2, count))
    local, normals = np.zeros((count, 3)), np.zeros((count, 3))
    half = solids.halves[solid]
    axis, sign = np.minimum(face // 2, 2), 2.0 * (face % 2) - 1
    rows = np.arange(count)
    local[rows, (axis + 1) % 3], local[rows, (axis + 2) % 3] = a, b
    local[rows, axis], normals[rows, axis] = sign, sign
    local *= half
    _on_roofs(roofs[solid], face, a, b, half, local, normals)
    ball = balls[solid]
    normals[ball] = _on_sphere(a[ball], b[ball])
    local[ball] = normals[ball] * half[ball]
    points = np.concatenate([ground, about_z(local, solids.turns[solid]) + solids.centres[solid]])
    upward = np.tile([0.0, 0.0, 1.0], (GROUND_POINTS, 1))
    normals = np.concatenate([upward, about_z(normals, solids.turns[solid])])
    solid = np.concatenate([np.full(GROUND_POINTS, GROUND_FACE), solid])
    return points, solid, np.concatenate([np.zeros(GROUND_POINTS, np.int64), face]), normals


def _on_roofs(
    roof: NDArray[np.bool_],
    face: NDArray[np.int64],
    a: Float64,
    b: Float64,
    half: Float64,
    local: Float64,
    normals: Float64,
) -> None:
    """Move the points of roofs from the sides of a box around each roof to its gables and slopes, in place.

    roof: (n,), True for points of roofs.
    face: (n,), index of the face of each point, as in `solids.FACES_PER_SOLID`.
    a: (n,), random numbers in [-1, 1]: the position along the ridge on a slope, across the ridge on a gable.
    b: (n,), random numbers in [-1, 1]: the position from the lower edge to the ridge.
    half: (n, 3), half sizes of each point's solid.
    local, normals: (n, 3), points and normals in the solid's own axes, to be changed.
    """
    share = (b + 1) / 2  # height of each point, as a fraction of the roof's height
    gable = roof & (face < 2)
    local[gable, 1] = (a * (1 - share) * half[:, 1])[gable]
    local[gable, 2] = (share * half[:, 2])[gable]
    for code, sign in ((6, 1.0), (7, -1.0)):
        slope = roof & (face == code)
        whole = np.stack([a * half[:, 0], sign * (1 - share) * half[:, 1], share * half[:, 2]], axis=1)
        local[slope], normals[slope] = whole[slope], slopes(half, sign)[0][slope]


def _on_sphere(a: Float64, b: Float64) -> Float64:
    """Return uniformly distributed unit vectors (n, 3), from uniform random numbers a and b (n,) in [-1, 1]."""
    level, angle = np.sqrt(1 - b**2), np.pi * a
    return np.stack([level * np.cos(angle), level * np.sin(angle), b], axis=1)
