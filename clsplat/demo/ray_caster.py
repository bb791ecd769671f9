# SPDX-License-Identifier: Apache-2.0
"""Photographs of a small textured still life, rendered by a plain NumPy ray caster without splats.

The demo and the tests of structure from motion need photos that have no licence and no poses, and that no splat
renderer has made.

The scene is diffuse, apart from a mild highlight on the two balls. So its light (sun with soft shadows, sky) is baked
into one texture per object, and a photo needs only the nearest hit and a texture look-up for each ray.

In the world, z is up and units are metres. The scene is a paved floor inside a round wall. The wall hides the sky, for
which there would be no initial points: training might place the sky's Gaussians in front of another camera.
"""

from __future__ import annotations

from abc import ABC, abstractmethod
from collections.abc import Sequence
from concurrent.futures import ThreadPoolExecutor
from dataclasses import dataclass, field
from functools import partial
from pathlib import Path

import numpy as np
import OpenImageIO as oiio
from scipy import ndimage

from clsplat.arrays import Float32
from clsplat.camera import Camera
from clsplat.images.writing import write_spec
from clsplat.progress import Progress, no_progress
from clsplat.shots.viewpoints import look_at

Palette = tuple[tuple[float, float, float], ...]

SUN_DIRECTION = np.array([0.45, -0.35, 0.82], np.float32) / np.float32(np.sqrt(0.45**2 + 0.35**2 + 0.82**2))
SUN_COLOUR = np.array([0.80, 0.74, 0.64], np.float32)
SKY_COLOUR = np.array([0.36, 0.40, 0.47], np.float32)
SHADOW_RAYS_PER_TEXEL = 24
HIGHLIGHT_STRENGTH = 0.25
"""Strength of the highlight on the balls."""
WALL_RADIUS_METRES, WALL_HEIGHT_METRES = 3.4, 2.8
SCENE_CENTRE = np.array([0.0, 0.0, 0.35], np.float32)
FIELD_OF_VIEW_RADIANS = np.deg2rad(62.0)


class Noise:
    """Smooth periodic 3D noise: cubic B-splines over random lattices, one per octave."""

    def __init__(self, seed: int) -> None:
        self._lattices = np.random.default_rng(seed).uniform(-1.0, 1.0, (6, 24, 24, 24)).astype(np.float32)

    def __call__(self, points: Float32, wavelength: float, octaves: int, gain: float = 0.65) -> Float32:
        """Sum octaves of noise at points (n, 3). Returns values (n,) of about [-1, 1].

        wavelength: wavelength of the first octave, in metres. It halves from octave to octave.
        gain: factor of the amplitude from octave to octave.
        A B-spline without prefilter removes frequencies that the lattice cannot represent, so octaves are band limited.
        """
        total, weight = np.zeros(len(points), np.float32), 1.0
        for octave in range(octaves):
            coordinates = (points * np.float32(2.0 * 2**octave / wavelength)).T
            sample = ndimage.map_coordinates(
                self._lattices[octave], coordinates, order=3, mode="grid-wrap", prefilter=False
            )
            total += np.float32(weight) * sample
            weight *= gain
        # amplify the sum, because the B-spline reduces the range of the lattice's values to about a third
        return np.asarray(np.tanh(2.2 * total).astype(np.float32))


def smooth_square(phase: Float32, softness: float) -> Float32:
    """Return a square wave with period 1 and values in [0, 1] at phases (n,). Edges are soft, to avoid aliasing.

    softness: near 0 for hard edges, 1 for almost a sine wave.
    """
    return np.asarray(0.5 + 0.5 * np.tanh(np.sin(2 * np.pi * phase) / softness))


def palette_colour(value: Float32, colours: Palette) -> Float32:
    """Map values (n,) in [0, 1] to colours (n, 3), by linear interpolation between equally spaced colours."""
    stops = np.linspace(0.0, 1.0, len(colours))
    channels = [np.interp(value, stops, levels) for levels in zip(*colours, strict=True)]
    return np.stack(channels, axis=-1).astype(np.float32)


def speckled(colour: Float32, points: Float32, noise: Noise, wavelength: float) -> Float32:
    """Add soft dark and light specks to colours (n, 3) at points (n, 3), since SIFT finds and matches small blobs.

    noise, wavelength: the noise from which specks are made, and the longest wavelength in it, in metres.
    """
    fine = noise(points + 11, wavelength, 2, gain=0.8)[:, None]
    dark, light = np.clip(-1.7 * fine - 0.5, 0, 1), np.clip(1.7 * fine - 0.5, 0, 1)
    return np.asarray(colour * (1 - 0.55 * dark) + (0.97 - colour) * (0.45 * light))


def dot(a: Float32, b: Float32) -> Float32:
    """Row-wise dot product of (n, 3) with (n, 3) or (3,)."""
    return np.asarray(a[:, 0] * b[..., 0] + a[:, 1] * b[..., 1] + a[:, 2] * b[..., 2])


@dataclass
class Surface(ABC):
    """An object of the scene, with its intersections with rays, its texture mapping and its baked colours.

    rows, columns: size of the texture in texels. A texel is about a pixel wide in the photos.
    """

    rows: int
    columns: int
    texture: Float32 = field(default_factory=lambda: np.zeros((1, 1, 3), np.float32))

    @abstractmethod
    def distance(self, origin: Float32, direction: Float32) -> Float32:
        """Return the distance (n,) at which each ray first meets the surface; infinite for a miss.

        origin: (n, 3) or (3,), the rays' origins.
        direction: (n, 3), the rays' directions.
        """

    @abstractmethod
    def texture_coordinates(self, points: Float32) -> tuple[Float32, Float32]:
        """Return texture coordinates of points (n, 3) on the surface: row and column, (n,) each, in [0, 1]."""

    @abstractmethod
    def point(self, row: Float32, column: Float32) -> tuple[Float32, Float32]:
        """Return positions and normals, (n, 3) each, at texture coordinates (n,). Inverts `texture_coordinates`."""

    @abstractmethod
    def albedo(self, points: Float32, noise: Noise) -> Float32:
        """Return the diffuse colour (n, 3), from 0 to 1, at points (n, 3) of the surface.

        noise: 3D noise function, from which the material's irregular pattern is computed.
        """

    def colour(self, points: Float32) -> Float32:
        """Return colours (n, 3) at points (n, 3), by a bilinear look-up in the baked texture."""
        row, column = self.texture_coordinates(points)
        y = np.clip(row * np.float32(self.rows) - 0.5, 0, self.rows - 1.001)
        x = np.clip(column * np.float32(self.columns) - 0.5, 0, self.columns - 1.001)
        y0, x0 = y.astype(np.int32), x.astype(np.int32)
        fy, fx = (y - y0)[:, None], (x - x0)[:, None]
        flat = self.texture.reshape(-1, 3)
        corner = y0 * self.columns + x0
        top = flat[corner] * (1 - fx) + flat[corner + 1] * fx
        bottom = flat[corner + self.columns] * (1 - fx) + flat[corner + self.columns + 1] * fx
        return np.asarray(top * (1 - fy) + bottom * fy)

    def grid(self, rows: int, columns: int) -> tuple[Float32, Float32]:
        """Return positions and normals, (rows * columns, 3) each, at the cell centres of a grid over the texture."""
        row, column = np.meshgrid((np.arange(rows) + 0.5) / rows, (np.arange(columns) + 0.5) / columns, indexing="ij")
        return self.point(row.ravel().astype(np.float32), column.ravel().astype(np.float32))


class Floor(Surface):
    """Disc at z = 0 that reaches to the wall, paved with a warm, soft-edged checker of stone."""

    def distance(self, origin: Float32, direction: Float32) -> Float32:
        with np.errstate(divide="ignore", invalid="ignore"):
            t = -origin[..., 2] / direction[:, 2]
        return np.where(t > 1e-4, t, np.inf).astype(np.float32)

    def texture_coordinates(self, points: Float32) -> tuple[Float32, Float32]:
        scale = np.float32(0.5 / WALL_RADIUS_METRES)
        return points[:, 1] * scale + np.float32(0.5), points[:, 0] * scale + np.float32(0.5)

    def point(self, row: Float32, column: Float32) -> tuple[Float32, Float32]:
        side = 2 * WALL_RADIUS_METRES
        points = np.stack([(column - 0.5) * side, (row - 0.5) * side, np.zeros_like(row)], axis=-1)
        return points.astype(np.float32), np.broadcast_to(np.array([0, 0, 1], np.float32), points.shape)

    def albedo(self, points: Float32, noise: Noise) -> Float32:
        wobble = points[:, :2] + np.float32(0.03) * noise(points + 5, 0.8, 1)[:, None]
        squares = [smooth_square((wobble[:, axis] / 1.1).astype(np.float32), 0.08) for axis in range(2)]
        stone = 0.5 + 0.5 * noise(points, 0.55, 4)
        warm = palette_colour(stone, ((0.36, 0.25, 0.17), (0.66, 0.50, 0.36), (0.93, 0.83, 0.66)))
        cool = palette_colour(stone, ((0.20, 0.25, 0.27), (0.42, 0.47, 0.47), (0.72, 0.74, 0.68)))
        blend = np.abs(squares[0] - squares[1])[:, None].astype(np.float32)
        mixed = warm * blend + cool * (1 - blend)
        return speckled(mixed, points, noise, 0.13)


class Wall(Surface):
    """Inside of an upright cylinder around the floor, painted in broad bands."""

    def distance(self, origin: Float32, direction: Float32) -> Float32:
        a = direction[:, 0] ** 2 + direction[:, 1] ** 2
        b = origin[..., 0] * direction[:, 0] + origin[..., 1] * direction[:, 1]
        c = origin[..., 0] ** 2 + origin[..., 1] ** 2 - np.float32(WALL_RADIUS_METRES**2)
        with np.errstate(divide="ignore", invalid="ignore"):
            t = (-b + np.sqrt(np.maximum(b * b - a * c, 0))) / a  # rays start inside, so the larger root is ahead
            z = origin[..., 2] + t * direction[:, 2]
        return np.where((t > 1e-3) & (z < WALL_HEIGHT_METRES) & (z > 0), t, np.inf).astype(np.float32)

    def texture_coordinates(self, points: Float32) -> tuple[Float32, Float32]:
        angle = np.arctan2(points[:, 1], points[:, 0]) / np.float32(2 * np.pi)
        return points[:, 2] / np.float32(WALL_HEIGHT_METRES), (angle + 0.5).astype(np.float32)

    def point(self, row: Float32, column: Float32) -> tuple[Float32, Float32]:
        angle = (column - 0.5) * 2 * np.pi
        normals = np.stack([-np.cos(angle), -np.sin(angle), np.zeros_like(angle)], axis=-1).astype(np.float32)
        points = -WALL_RADIUS_METRES * normals
        points[:, 2] = row * WALL_HEIGHT_METRES
        return points.astype(np.float32), normals

    def albedo(self, points: Float32, noise: Noise) -> Float32:
        plaster = 0.5 + 0.5 * noise(points + 3, 0.9, 4)
        band = smooth_square(points[:, 2] / 0.9 + 0.12 * noise(points, 1.6, 1), 0.2)[:, None]
        upper = palette_colour(plaster, ((0.30, 0.40, 0.36), (0.60, 0.70, 0.58), (0.88, 0.90, 0.74)))
        lower = palette_colour(plaster, ((0.40, 0.20, 0.16), (0.74, 0.44, 0.30), (0.93, 0.72, 0.50)))
        mixed = upper * band + lower * (1 - band)
        return speckled(mixed, points, noise, 0.20)


@dataclass
class Ball(Surface):
    """Sphere with marbling in the palette's colours. Texture columns are longitudes, and rows are polar angles."""

    centre: tuple[float, float, float] = (0.0, 0.0, 0.0)
    radius: float = 1.0
    palette: Palette = ()

    def distance(self, origin: Float32, direction: Float32) -> Float32:
        offset = origin - np.asarray(self.centre, np.float32)
        b = dot(direction, offset)
        c = (offset * offset).sum(-1) - np.float32(self.radius**2)
        discriminant = b * b - c
        t = -b - np.sqrt(np.maximum(discriminant, 0))
        return np.where((discriminant > 0) & (t > 1e-3), t, np.inf).astype(np.float32)

    def texture_coordinates(self, points: Float32) -> tuple[Float32, Float32]:
        local = (points - np.asarray(self.centre, np.float32)) / np.float32(self.radius)
        row = np.arccos(np.clip(local[:, 2], -1, 1)) / np.float32(np.pi)
        return row, np.arctan2(local[:, 1], local[:, 0]) / np.float32(2 * np.pi) + np.float32(0.5)

    def point(self, row: Float32, column: Float32) -> tuple[Float32, Float32]:
        polar, angle = row * np.pi, (column - 0.5) * 2 * np.pi
        normals = np.stack([np.sin(polar) * np.cos(angle), np.sin(polar) * np.sin(angle), np.cos(polar)], axis=-1)
        normals = normals.astype(np.float32)
        return normals * np.float32(self.radius) + np.asarray(self.centre, np.float32), normals

    def albedo(self, points: Float32, noise: Noise) -> Float32:
        veins = np.sin(9.0 * points[:, 2] / self.radius + 3.5 * noise(points, 0.7, 2))
        value = 0.5 + 0.30 * veins + 0.28 * noise(points + 7, 0.3, 3)
        marbled = palette_colour(np.clip(value, 0, 1).astype(np.float32), self.palette)
        return speckled(marbled, points, noise, 0.11)


@dataclass
class Box(Surface):
    """Upright box, rotated about z by `turn` radians. Its six faces lie next to each other in the texture."""

    centre: tuple[float, float, float] = (0.0, 0.0, 0.0)
    half: tuple[float, float, float] = (1.0, 1.0, 1.0)
    turn: float = 0.0
    palette: Palette = ()

    def _local_from_world(self) -> Float32:
        c, s = np.cos(self.turn), np.sin(self.turn)
        return np.array([[c, s, 0], [-s, c, 0], [0, 0, 1]], np.float32)

    def distance(self, origin: Float32, direction: Float32) -> Float32:
        rotation = self._local_from_world()
        start = (origin - np.asarray(self.centre, np.float32)) @ rotation.T
        step = direction @ rotation.T
        half = np.asarray(self.half, np.float32)
        enter = np.full(len(direction), -np.inf, np.float32)
        leave = np.full(len(direction), np.inf, np.float32)
        with np.errstate(divide="ignore", invalid="ignore"):
            for axis in range(3):  # a loop is much faster than NumPy's reductions over an axis of length 3
                one = (-half[axis] - start[..., axis]) / step[:, axis]
                other = (half[axis] - start[..., axis]) / step[:, axis]
                np.maximum(enter, np.minimum(one, other), out=enter)
                np.minimum(leave, np.maximum(one, other), out=leave)
        return np.where((enter < leave) & (enter > 1e-3), enter, np.inf).astype(np.float32)

    def texture_coordinates(self, points: Float32) -> tuple[Float32, Float32]:
        local = (points - np.asarray(self.centre, np.float32)) @ self._local_from_world().T
        local /= np.asarray(self.half, np.float32)
        axis = np.abs(local).argmax(axis=1)
        rows = np.arange(len(local))
        face = 2 * axis + (local[rows, axis] > 0)
        # stay half a texel inside the face, so that bilinear look-ups do not read the neighbouring face
        margin = 1.0 - 6.0 / self.columns
        across = np.clip(local[rows, (axis + 1) % 3], -margin, margin)
        along = np.clip(local[rows, (axis + 2) % 3], -1, 1)
        return 0.5 + 0.5 * along, (face + 0.5 + 0.5 * across).astype(np.float32) / np.float32(6)

    def point(self, row: Float32, column: Float32) -> tuple[Float32, Float32]:
        face = np.minimum((column * 6).astype(np.int32), 5)
        axis, side = face // 2, 2.0 * (face % 2) - 1.0
        rows = np.arange(len(row))
        local = np.zeros((len(row), 3), np.float32)
        local[rows, axis] = side
        normals = local @ self._local_from_world()
        local[rows, (axis + 1) % 3] = 2 * (column * 6 - face) - 1
        local[rows, (axis + 2) % 3] = 2 * row - 1
        local *= np.asarray(self.half, np.float32)
        return local @ self._local_from_world() + np.asarray(self.centre, np.float32), normals

    def albedo(self, points: Float32, noise: Noise) -> Float32:
        grain = points * np.array([1.0, 1.0, 2.5], np.float32)
        value = 0.5 + 0.34 * noise(grain + 2, 0.5, 4) + 0.22 * np.sin(22.0 * points[:, 2] + 3 * noise(points, 0.9, 1))
        grained = palette_colour(np.clip(value, 0, 1).astype(np.float32), self.palette)
        return speckled(grained, points, noise, 0.11)


def still_life() -> list[Surface]:
    """Return the objects of the still life, before `bake` computes their textures."""
    marble = ((0.10, 0.16, 0.34), (0.30, 0.46, 0.70), (0.80, 0.86, 0.90), (0.95, 0.94, 0.88))
    amber = ((0.45, 0.16, 0.05), (0.86, 0.46, 0.12), (0.98, 0.84, 0.48))
    red = ((0.26, 0.06, 0.07), (0.64, 0.18, 0.14), (0.90, 0.50, 0.34))
    green = ((0.08, 0.20, 0.14), (0.24, 0.48, 0.28), (0.70, 0.80, 0.46))
    return [
        Floor(768, 768),
        Wall(320, 2048),
        Ball(192, 384, centre=(0.05, -0.1, 0.48), radius=0.48, palette=marble),
        Ball(96, 192, centre=(0.72, 0.62, 0.24), radius=0.24, palette=amber),
        Box(128, 768, centre=(-0.85, 0.35, 0.42), half=(0.30, 0.26, 0.42), turn=0.5, palette=red),
        Box(96, 576, centre=(0.55, -0.95, 0.20), half=(0.34, 0.22, 0.20), turn=-0.35, palette=green),
    ]


def bake(surfaces: list[Surface], seed: int) -> None:
    """Compute every texture: albedo times sky and sun, with soft sun shadows and darkening near the floor."""
    noise = Noise(seed)
    suns = SUN_DIRECTION + np.random.default_rng(seed).normal(0.0, 0.05, (SHADOW_RAYS_PER_TEXEL, 3)).astype(np.float32)
    suns /= np.linalg.norm(suns, axis=1, keepdims=True)
    blockers = [surface for surface in surfaces if isinstance(surface, (Ball, Box))]
    with ThreadPoolExecutor(2) as pool:
        list(pool.map(partial(bake_surface, suns=suns, blockers=blockers, noise=noise), surfaces))


def bake_surface(surface: Surface, suns: Float32, blockers: Sequence[Surface], noise: Noise) -> None:
    """Compute the texture of one surface: albedo times light.

    suns: (n, 3), directions to points of the sun's disc.
    blockers: surfaces that cast shadows.
    """
    points, normals = surface.grid(surface.rows, surface.columns)
    # compute soft shadows on a grid four times coarser, and interpolate, because they vary slowly
    rows, columns = surface.rows // 4, surface.columns // 4
    coarse_points, coarse_normals = surface.grid(rows, columns)
    start = coarse_points + 2e-3 * coarse_normals
    lit = np.zeros(len(start), np.float32)
    for sun in suns:
        direction = np.broadcast_to(sun, start.shape)
        lit += ~np.any([np.isfinite(blocker.distance(start, direction)) for blocker in blockers], axis=0)
    sunlit = ndimage.zoom(
        (lit / SHADOW_RAYS_PER_TEXEL).reshape(rows, columns), 4, order=1, grid_mode=True, mode="nearest"
    )
    sun_term = np.maximum(dot(normals, SUN_DIRECTION), 0) * sunlit.ravel()
    sky_term = 0.55 + 0.45 * normals[:, 2]
    if isinstance(surface, (Ball, Box)):
        sky_term = sky_term * (1 - 0.4 * np.exp(-points[:, 2] / 0.12))
    light = SKY_COLOUR * (0.35 + 0.65 * sky_term)[:, None] + SUN_COLOUR * sun_term[:, None]
    texture = surface.albedo(points, noise) * light
    surface.texture = texture.reshape(surface.rows, surface.columns, 3).astype(np.float32)


def cameras(count: int, width: int, height: int, seed: int) -> list[Camera]:
    """Return hand-held cameras around the scene: three fifths on a low ring, the others on a high ring.

    They look at the scene's middle. Positions, targets and up directions have random errors.
    """
    generator = np.random.default_rng(seed + 1)
    focal = 0.5 * max(width, height) / np.tan(0.5 * FIELD_OF_VIEW_RADIANS)
    low = max(1, round(count * 0.6)) if count > 1 else count
    views = []
    for ring, ring_count, radius, elevation in ((0, low, 2.55, 0.85), (1, count - low, 2.15, 1.75)):
        for index in range(ring_count):
            angle = 2 * np.pi * (index + 0.5 * ring) / ring_count + generator.normal(0, 0.02)
            position = np.array([radius * np.cos(angle), radius * np.sin(angle), elevation])
            position += generator.normal(0, 0.04, 3)
            target = SCENE_CENTRE + generator.normal(0, 0.06, 3)
            up = np.array([0.0, 0.0, 1.0]) + generator.normal(0, 0.02, 3)
            rotation, translation = look_at(position, target, up)
            views.append(Camera(width, height, focal, focal, width / 2, height / 2, rotation, translation))
    return views


def render(surfaces: list[Surface], camera: Camera, samples: int = 2) -> Float32:
    """Render one photo, (height, width, 3) in [0, 1].

    samples: each pixel is the average of samples x samples rays.
    """
    columns = (np.arange(camera.width * samples, dtype=np.float32) + 0.5) / samples
    rows = (np.arange(camera.height * samples, dtype=np.float32) + 0.5) / samples
    x, y = np.meshgrid((columns - camera.cx) / camera.fx, (rows - camera.cy) / camera.fy)
    local = np.stack([x.ravel(), y.ravel(), np.ones(x.size)], axis=-1)
    local /= np.linalg.norm(local, axis=1, keepdims=True)
    direction = (local @ camera.rotation).astype(np.float32)
    origin = camera.position.astype(np.float32)

    distances = np.stack([surface.distance(origin, direction) for surface in surfaces])
    nearest = distances.min(axis=0)
    hit_index = np.where(np.isfinite(nearest), distances.argmin(axis=0), -1)
    colour = np.zeros_like(direction)  # no ray stays black: each hits the floor, the wall or an object
    for index, surface in enumerate(surfaces):
        rays = np.flatnonzero(hit_index == index)
        if not len(rays):
            continue
        points = origin + nearest[rays, None] * direction[rays]
        colour[rays] = surface.colour(points)
        if isinstance(surface, Ball):
            normals = ((points - np.asarray(surface.centre)) / surface.radius).astype(np.float32)
            halfway = (SUN_DIRECTION - direction[rays]).astype(np.float32)
            halfway /= np.sqrt(dot(halfway, halfway))[:, None]
            highlight = np.maximum(dot(normals, halfway), 0) ** 24
            colour[rays] += HIGHLIGHT_STRENGTH * highlight[:, None]
    fine = colour.reshape(camera.height, samples, camera.width, samples, 3)
    linear = np.clip(fine.mean(axis=(1, 3)), 0, 1)
    # a gentle tone curve keeps the photos from looking gloomy
    return np.asarray(linear ** np.float32(1 / 1.6))


def write_jpeg(path: Path, image: Float32) -> None:
    """Write an image (height, width, 3) in [0, 1] as an 8-bit JPEG of high quality, without metadata."""
    pixels = np.ascontiguousarray(np.rint(image * 255).astype(np.uint8))
    spec = oiio.ImageSpec(pixels.shape[1], pixels.shape[0], 3, "uint8")
    spec.attribute("Compression", "jpeg:97")
    spec.attribute("jpeg:subsampling", "4:4:4")
    write_spec(path, [pixels], [spec], "jpeg")


def write_photos(
    folder: Path,
    *,
    count: int = 40,
    width: int = 320,
    height: int = 240,
    seed: int = 0,
    progress: Progress = no_progress,
) -> None:
    """Write `count` photos `photo_000.jpg` ... into the folder, which is created if missing.

    Equal seeds give equal photos.
    width, height: size of the picture in pixels.
    progress: function that is called with a text and the completed fraction.
    Raises ClsplatError if a photo cannot be written.
    Poses are neither returned nor written, because the demo recovers them by structure from motion.
    """
    folder.mkdir(parents=True, exist_ok=True)
    progress("painting the scene", 0.0)
    surfaces = still_life()
    bake(surfaces, seed)
    views = cameras(count, width, height, seed)
    # NumPy releases the interpreter lock in its loops, so two threads nearly halve the time
    with ThreadPoolExecutor(2) as pool:
        for index, image in enumerate(pool.map(partial(render, surfaces), views)):
            write_jpeg(folder / f"photo_{index:03d}.jpg", image)
            progress("taking photos", (index + 1) / count)
