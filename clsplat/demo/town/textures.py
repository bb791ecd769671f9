# SPDX-License-Identifier: Apache-2.0
"""Textures of the demo's town, with mip levels, and the sky with its ring of hills.

All houses share the textures, so memory does not grow with the town. Each texture repeats in both directions. A face
has the index of a texture, an offset and a tint.
"""

from __future__ import annotations

from collections.abc import Callable
from functools import lru_cache
from typing import Any, Final

import numpy as np
from numpy.typing import NDArray

from clsplat.arrays import Float32

TEXTURE_SIDE = 512
TEXTURE_LEVELS = 10
"""Number of mip levels, from TEXTURE_SIDE texels a side to one texel."""
FACADES, ROOFS = range(9), range(9, 14)
ASPHALT, PAVEMENT, GRASS, GRAVEL, SOIL, PAVING = range(14, 20)
LEAVES, BARK, PLAIN = range(20, 22), 22, 23
"""Indices of the textures of each material."""
TEXTURE_COUNT = 24
FACADE_METRES, ROOF_METRES, GROUND_METRES, LEAF_METRES = 12.0, 6.0, 8.0, 3.0
"""Length of a texture's side in the town, for facades (four storeys of four windows), roofs, ground and leaves."""
SKY_ROWS, SKY_COLUMNS = 512, 2048
"""Size of the sky's texture in texels. Rows are elevations, and columns are azimuths."""
HAZE_COLOUR: Final = np.array([0.50, 0.56, 0.63], np.float32)
"""Linear colour of the haze: of the horizon, and of everything far away."""
Colour = tuple[float, float, float]
Pixels = NDArray[np.float32]

_LEVEL_SIDES = np.array([TEXTURE_SIDE >> level for level in range(TEXTURE_LEVELS)], np.int32)
_LEVEL_STARTS = np.concatenate([[0], np.cumsum(_LEVEL_SIDES**2)]).astype(np.int32)


class Brush:
    """Random numbers and noise for one texture. All textures share the noise images, each with its own offset.

    white: Fourier transform of white noise, from which `rough` makes noise images.
    fields: cache of the noise images, keyed by the arguments of `rough`.
    """

    def __init__(
        self, generator: np.random.Generator, white: NDArray[np.complex128], fields: dict[Any, Pixels]
    ) -> None:
        self.generator, self._white, self._fields = generator, white, fields

    def rough(self, wavelength: float, falloff: float = 1.2, stretch: float = 1.0) -> Pixels:
        """Return periodic noise (h, w) with mean 0 and standard deviation 1: white noise, filtered by frequency.

        wavelength: longest wavelength, as a fraction of the texture's side.
        falloff: exponent of the amplitude's decline with the frequency.
        stretch: ratio of wavelengths along columns and rows.
        """
        key = wavelength, falloff, stretch
        if key not in self._fields:
            down, across = np.fft.fftfreq(TEXTURE_SIDE)[:, None], np.fft.rfftfreq(TEXTURE_SIDE)[None]
            frequency = np.hypot(down * stretch, across) * TEXTURE_SIDE
            least = 1 / wavelength
            gain = np.where(frequency < least, 0.0, (np.maximum(frequency, least) / least) ** -falloff)
            values = np.fft.irfft2(self._white * gain, s=(TEXTURE_SIDE, TEXTURE_SIDE))
            self._fields[key] = np.asarray(values / values.std(), np.float32)
        return np.roll(self._fields[key], self.generator.integers(TEXTURE_SIDE, size=2), axis=(0, 1))


def mixed(colours: tuple[Colour, ...], value: Pixels) -> Pixels:
    """Map values (h, w) of about [-2, 2] to colours (h, w, 3), by linear interpolation between `colours`."""
    stops = np.linspace(-1.6, 1.6, len(colours))
    channels = [np.interp(value, stops, levels) for levels in zip(*colours, strict=True)]
    return np.stack(channels, axis=-1).astype(np.float32)


def _grid(period: float, width: float, offset: float = 0.0) -> Pixels:
    """Return a row of texels (TEXTURE_SIDE,) with a soft line every `period` texels: 1 on a line, 0 elsewhere.

    width, offset: width of a line, and position of the first line's middle, in texels.
    """
    place = (np.arange(TEXTURE_SIDE) + 0.5 - offset) % period
    return np.asarray(np.clip(width / 2 + 0.5 - np.minimum(place, period - place), 0, 1), np.float32)


def _bricks(rows: int, columns: int, joint: float, generator: np.random.Generator) -> tuple[Pixels, Pixels]:
    """Lay bricks in staggered rows. Returns two images (h, w).

    The first is 1 on joints and 0 elsewhere. The second has a random value from -1 to 1 for each brick.

    rows, columns: number of bricks. joint: width of a joint in texels.
    """
    y, x = np.mgrid[0:TEXTURE_SIDE, 0:TEXTURE_SIDE].astype(np.float32) + np.float32(0.5)
    row = (y * rows / TEXTURE_SIDE).astype(int)
    place = (x / TEXTURE_SIDE * columns + 0.5 * (row % 2)) % columns
    value = generator.uniform(-1, 1, (rows, columns))[row, place.astype(int)]
    across = np.minimum(place % 1, 1 - place % 1) * TEXTURE_SIDE / columns
    down = np.minimum(y * rows / TEXTURE_SIDE % 1, 1 - y * rows / TEXTURE_SIDE % 1) * TEXTURE_SIDE / rows
    joints = np.clip(joint / 2 + 0.5 - np.minimum(across, down), 0, 1)
    return joints.astype(np.float32), value.astype(np.float32)


def _wall(kind: int, brush: Brush) -> Pixels:
    """Paint a wall without windows (h, w, 3). kind: number of the facade, which chooses brick, plaster or panels."""
    stain, grain = brush.rough(0.5, 1.2), brush.rough(0.05, 0.6)
    if kind % 3 == 0:  # brick
        joints, brick = _bricks(120, 40, 1.0, brush.generator)
        colour = mixed(((0.26, 0.11, 0.08), (0.48, 0.21, 0.14), (0.66, 0.36, 0.24)), brick + 0.4 * stain + 0.3 * grain)
        return np.asarray(colour * (1 - 0.5 * joints[..., None]) + 0.22 * joints[..., None])
    if kind % 3 == 1:  # plaster
        return mixed(((0.50, 0.45, 0.38), (0.70, 0.65, 0.56), (0.82, 0.78, 0.70)), 0.8 * stain + 0.5 * grain)
    joints, panel = _bricks(16, 8, 2.0, brush.generator)  # panels
    colour = mixed(
        ((0.34, 0.36, 0.38), (0.54, 0.55, 0.55), (0.72, 0.71, 0.68)), 0.7 * panel + 0.5 * stain + 0.4 * grain
    )
    return colour * (1 - 0.55 * joints[..., None])


def _paint(image: Pixels, box: tuple[float, float, float, float], colour: Any) -> None:
    """Fill a rectangle of an image with a colour, or with the same part of another image. Its edges are soft.

    box: left, top, right and bottom of the rectangle, in texels.
    """
    left, top, right, bottom = box
    first, last = (max(int(edge) - 1, 0) for edge in (left, top)), (int(edge) + 2 for edge in (right, bottom))
    columns, rows = (np.arange(begin, min(end, TEXTURE_SIDE)) for begin, end in zip(first, last, strict=True))
    across = np.clip(np.minimum(columns + 0.5 - left, right - columns - 0.5) + 0.5, 0, 1)
    down = np.clip(np.minimum(rows + 0.5 - top, bottom - rows - 0.5) + 0.5, 0, 1)
    cover = (down[:, None] * across[None, :])[..., None].astype(np.float32)
    part = image[rows[0] : rows[-1] + 1, columns[0] : columns[-1] + 1]
    fill = colour[rows[0] : rows[-1] + 1, columns[0] : columns[-1] + 1] if np.ndim(colour) == 3 else colour
    part += cover * (np.asarray(fill, np.float32) - part)


def _facade(kind: int, brush: Brush) -> Pixels:
    """Paint a facade (h, w, 3) of four storeys with four windows each. kind: its number; the first five have a door."""
    image = _wall(kind, brush)
    cell = TEXTURE_SIDE / 4
    wide, tall = ((0.40, 0.48), (0.52, 0.56), (0.84, 0.58))[kind // 3]
    frame: Colour = ((0.86, 0.85, 0.80), (0.30, 0.22, 0.16), (0.20, 0.21, 0.22))[(kind + kind // 3) % 3]
    generator = brush.generator
    glass = (0.045 * brush.rough(0.25, 0.9)[..., None] + np.array([0.12, 0.15, 0.19], np.float32)).clip(0.03, 0.4)
    for storey in range(4):
        for column in range(4):
            left, top = (column + 0.5 - wide / 2) * cell, (storey + 0.22) * cell
            right, bottom = left + wide * cell, top + tall * cell
            door = kind < 5 and storey == 3 and column == kind % 4
            bottom = (storey + 1) * cell if door else bottom
            _paint(image, (left - 5, top - 5, right + 5, bottom + 5), frame)
            _paint(image, (left, top, right, bottom), glass)
            if door:
                _paint(image, (left, top + 12, right, bottom), generator.uniform(0.12, 0.45, 3))
                _paint(image, (right - 12, top + 60, right - 7, top + 66), (0.8, 0.7, 0.4))
                continue
            drawn = generator.uniform(0.0, 0.7)  # height of a curtain, as a fraction of the window's height
            _paint(
                image,
                (left, top, right, top + drawn * tall * cell),
                generator.uniform(0.45, 0.85) + generator.uniform(-0.06, 0.06, 3),
            )
            middle = (left + right) / 2
            _paint(image, (middle - 2, top, middle + 2, bottom), frame)
            _paint(image, (left - 8, bottom + 4, right + 8, bottom + 9), (0.72, 0.70, 0.66))
            _paint(image, (left - 8, bottom + 9, right + 8, bottom + 13), (0.16, 0.15, 0.14))
        _paint(image, (-9, (storey + 1) * cell - 4, TEXTURE_SIDE + 9, (storey + 1) * cell), (0.55, 0.53, 0.50))
    return image


def _roof(kind: int, brush: Brush) -> Pixels:
    stain, grain = brush.rough(0.5, 1.2), brush.rough(0.05, 0.6)
    palettes: tuple[tuple[Colour, ...], ...] = (
        ((0.30, 0.10, 0.06), (0.52, 0.20, 0.12), (0.68, 0.34, 0.20)),
        ((0.14, 0.15, 0.18), (0.28, 0.30, 0.33), (0.44, 0.45, 0.47)),
        ((0.22, 0.15, 0.10), (0.40, 0.28, 0.19), (0.56, 0.43, 0.32)),
    )
    if kind < 3:  # tiles
        joints, tile = _bricks(24, 20, 2.5, brush.generator)
        colour = mixed(palettes[kind], 0.8 * tile + 0.4 * stain + 0.3 * grain)
        return colour * (1 - 0.6 * joints[..., None])
    if kind == 3:  # gravel on a flat roof, with seams of roofing felt
        colour = mixed(((0.26, 0.25, 0.24), (0.46, 0.45, 0.43), (0.66, 0.64, 0.61)), 0.7 * grain + 0.7 * stain)
        return np.asarray(colour * (1 - 0.4 * _grid(TEXTURE_SIDE / 3, 4)[None, :, None]))
    colour = mixed(((0.30, 0.38, 0.36), (0.46, 0.55, 0.52), (0.62, 0.70, 0.66)), 0.8 * stain + 0.25 * grain)  # metal
    seams = _grid(TEXTURE_SIDE / 10, 4)[None, :, None]
    return np.asarray(colour * (1 - 0.5 * seams) + 0.1 * np.roll(seams, 4, axis=1))


def _ground(kind: int, brush: Brush) -> Pixels:
    stain, grain = brush.rough(0.5, 1.2), brush.rough(0.05, 0.6)
    if kind == ASPHALT:
        cracks = np.clip(1 - np.abs(brush.rough(0.35, 1.2)) * 40, 0, 1)[..., None]
        colour = mixed(((0.12, 0.12, 0.13), (0.21, 0.21, 0.22), (0.33, 0.33, 0.33)), 0.6 * stain + 0.6 * grain)
        return np.asarray(colour * (1 - 0.5 * cracks))
    if kind in (PAVEMENT, PAVING):
        joints, slab = _bricks(10 if kind == PAVEMENT else 26, 10 if kind == PAVEMENT else 18, 3.0, brush.generator)
        warm: tuple[Colour, ...] = ((0.34, 0.26, 0.20), (0.50, 0.38, 0.30), (0.64, 0.52, 0.42))
        grey: tuple[Colour, ...] = ((0.36, 0.36, 0.35), (0.50, 0.49, 0.47), (0.64, 0.62, 0.59))
        colour = mixed(grey if kind == PAVEMENT else warm, 0.7 * slab + 0.5 * stain + 0.4 * grain)
        return colour * (1 - 0.5 * joints[..., None])
    palettes: dict[int, tuple[Colour, ...]] = {
        GRASS: ((0.07, 0.13, 0.04), (0.16, 0.28, 0.08), (0.34, 0.44, 0.16)),
        GRAVEL: ((0.38, 0.35, 0.30), (0.55, 0.51, 0.45), (0.74, 0.70, 0.63)),
        SOIL: ((0.12, 0.16, 0.06), (0.27, 0.23, 0.12), (0.42, 0.32, 0.20)),
    }
    return mixed(palettes[kind], 0.9 * stain + 0.7 * grain)


def _leaves(kind: int, brush: Brush) -> Pixels:
    clumps, leaf = brush.rough(0.25, 0.9), brush.rough(0.05, 0.6)
    palettes: tuple[tuple[Colour, ...], ...] = (
        ((0.03, 0.08, 0.02), (0.13, 0.26, 0.06), (0.38, 0.52, 0.16)),
        ((0.05, 0.08, 0.03), (0.24, 0.27, 0.07), (0.60, 0.50, 0.16)),
    )
    return mixed(palettes[kind], 0.9 * clumps + 0.7 * leaf)


def _bark(_: int, brush: Brush) -> Pixels:
    return mixed(((0.10, 0.07, 0.05), (0.26, 0.19, 0.13), (0.44, 0.35, 0.26)), brush.rough(0.2, 0.9, stretch=0.2))


def _plain(_: int, brush: Brush) -> Pixels:
    return np.asarray(0.8 + 0.05 * brush.rough(0.4, 1.5)[..., None] * np.ones(3, np.float32))


def _packed(image: Pixels) -> NDArray[np.uint32]:
    """Pack an image (h, w, 3) in [0, 1] into one integer per texel, (h, w), with a byte for each colour."""
    levels = np.zeros((*image.shape[:2], 4), np.uint8)
    levels[..., :3] = np.rint(np.clip(image, 0, 1) * 255)
    return levels.view(np.uint32)[..., 0]


def _levels(image: Pixels) -> NDArray[np.uint32]:
    """Return the packed texels of all mip levels of a texture, the finest first, as one array.

    A texel of a level is the mean of four texels of the finer level.
    """
    rows = [_packed(image).ravel()]
    while len(image) > 1:
        image = 0.25 * (image[::2, ::2] + image[1::2, ::2] + image[::2, 1::2] + image[1::2, 1::2])
        rows.append(_packed(image).ravel())
    return np.concatenate(rows)


class Textures:
    """All textures of a town with their mip levels, as packed colours in one array, and the sky."""

    def __init__(self, seed: int) -> None:
        painters: list[tuple[Callable[[int, Brush], Pixels], int]] = [
            *((_facade, index) for index in range(len(FACADES))),
            *((_roof, index) for index in range(len(ROOFS))),
            *((_ground, kind) for kind in (ASPHALT, PAVEMENT, GRASS, GRAVEL, SOIL, PAVING)),
            *((_leaves, index) for index in range(len(LEAVES))),
            *((_bark, 0), (_plain, 0)),
        ]
        fields: dict[Any, Pixels] = {}
        white = np.fft.rfft2(np.random.default_rng([seed, 1]).normal(size=(TEXTURE_SIDE, TEXTURE_SIDE)))
        brushes = [Brush(np.random.default_rng([seed, 2, index]), white, fields) for index in range(len(painters) + 1)]
        baked = [_levels(paint(kind, brush)) for (paint, kind), brush in zip(painters, brushes, strict=False)]
        self._texels = np.concatenate(baked)
        self._sky = _baked_sky(brushes[-1])

    def colours(self, texture: NDArray[np.int32], u: Float32, v: Float32, level: Float32) -> Float32:
        """Look up colours (n, 3) in [0, 1] by trilinear filtering.

        texture: (n,), index of the texture.
        u, v: (n,), texture coordinates to the right and up, in sides of the texture; they may have any value.
        level: (n,), mip level: log2 of the texels per pixel.
        """
        level = np.clip(level, 0, TEXTURE_LEVELS - 1.001)
        coarse = level.astype(np.int32)
        blend = (level - coarse)[:, None]
        u, v = u - np.floor(u), 1 - (v - np.floor(v))
        base = texture * _LEVEL_STARTS[-1]
        fine = self._bilinear(base, coarse, u, v)
        fine += blend * (self._bilinear(base, coarse + 1, u, v) - fine)
        fine *= np.float32(1 / 255)
        return fine[:, :3]

    def _bilinear(self, base: NDArray[np.int32], level: NDArray[np.int32], u: Float32, v: Float32) -> Pixels:
        side = _LEVEL_SIDES[level]
        start, mask = base + _LEVEL_STARTS[level], side - 1
        x, y = u * side.astype(np.float32) - np.float32(0.5), v * side.astype(np.float32) - np.float32(0.5)
        left, top = np.floor(x), np.floor(y)
        right_share, lower_share = (x - left)[:, None], (y - top)[:, None]
        column, row = left.astype(np.int32), top.astype(np.int32)
        columns = column & mask, (column + 1) & mask
        rows = start + (row & mask) * side, start + ((row + 1) & mask) * side
        upper = self._texel(rows[0] + columns[0])
        upper += right_share * (self._texel(rows[0] + columns[1]) - upper)
        lower = self._texel(rows[1] + columns[0])
        lower += right_share * (self._texel(rows[1] + columns[1]) - lower)
        upper += lower_share * (lower - upper)
        return upper

    def _texel(self, place: NDArray[np.int32]) -> Pixels:
        packed = np.take(self._texels, place)
        return packed.view(np.uint8).reshape(-1, 4).astype(np.float32)

    def sky(self, direction: Float32) -> Float32:
        """Return linear colours (n, 3) of the sky and the hills in directions (n, 3), which may have any length."""
        x, y, z = direction.T
        elevation = np.clip(np.arctan2(z, np.hypot(x, y)) / np.float32(np.pi / 2), 0, 1)
        row = (1 - elevation) * np.float32(SKY_ROWS - 1.001)
        column = (np.arctan2(y, x) / np.float32(2 * np.pi) + np.float32(0.5)) * SKY_COLUMNS
        top, left = row.astype(np.int32), np.floor(column).astype(np.int32)
        down, across = (row - top)[:, None], (column - left)[:, None]
        left, right = left % SKY_COLUMNS, (left + 1) % SKY_COLUMNS
        upper = self._sky[top, left] * (1 - across) + self._sky[top, right] * across
        lower = self._sky[top + 1, left] * (1 - across) + self._sky[top + 1, right] * across
        return np.asarray(upper * (1 - down) + lower * down)


def _baked_sky(brush: Brush) -> Pixels:
    """Paint a sky with clouds above a ring of hills, (SKY_ROWS, SKY_COLUMNS, 3).

    The rows are elevations from 90 degrees down to 0.
    """
    elevation = np.linspace(90, 0, SKY_ROWS, dtype=np.float32)[:, None]
    azimuth = np.linspace(0, 2 * np.pi, SKY_COLUMNS, endpoint=False)
    zenith = np.array([0.22, 0.38, 0.68], np.float32)
    rise = np.clip(elevation / 60, 0, 1)[..., None] ** 0.6
    image = (HAZE_COLOUR * 1.25 * (1 - rise) + zenith * rise) * np.ones((1, SKY_COLUMNS, 1), np.float32)
    clouds = np.clip(np.tile(brush.rough(0.4, 1.5), (1, SKY_COLUMNS // TEXTURE_SIDE)) - 0.1, 0, 1)[..., None]
    share = np.clip(elevation / 12 - 0.4, 0, 1) * np.clip((78 - elevation) / 30, 0, 1)  # no clouds at the zenith
    image += 0.8 * clouds * share[..., None] * (0.86 - image)
    rock = np.tile(brush.rough(0.2, 1.0), (1, SKY_COLUMNS // TEXTURE_SIDE))[..., None]
    for layer, (height, tint) in enumerate(((5.0, 0.55), (3.2, 0.8))):
        waves = sum(
            np.sin(azimuth * count + brush.generator.uniform(0, 2 * np.pi)) / np.sqrt(count)
            for count in (3 + layer, 7, 13, 22, 41, 67)
        )
        crest = height * (0.62 + 0.2 * np.asarray(waves))[None]
        cover = np.clip((crest - elevation) / 0.25 + 0.5, 0, 1)[..., None].astype(np.float32)
        hill = np.array([0.20, 0.27, 0.20], np.float32) * tint * (1 + 0.18 * rock)
        haze = np.clip(1 - elevation / 6, 0.35, 1)[..., None] ** 2
        image += cover * (hill * (1 - haze) + HAZE_COLOUR * haze - image)
    return np.asarray(image, np.float32)


@lru_cache(maxsize=2)
def textures(seed: int) -> Textures:
    """Return the textures of the town with this seed. They are cached."""
    return Textures(seed)
