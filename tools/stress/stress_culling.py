# SPDX-License-Identifier: Apache-2.0
"""Compare the culling of chunks with every Gaussian in them, for many random cameras and boxes.

    tools/stress/run culling [--pairs 1e6] [--seed 0] [--device DEVICE]

A pair is a camera and a box of Gaussians, most of them at a border of the picture. The box is measured; then Adam moves
the Gaussians for up to 300 steps that show them and 5000 that do not, by random and adversarial gradients. The box,
widened by the bound of these movements, must be visible if one of the Gaussians has a tile, in float64 or, with
--device, by a device's kernels. Prints a table with, for each kind of camera, the pairs, those with a tile, those found
visible, and the Gaussians missed. The exit status is 1 if a Gaussian is missed.
"""

from __future__ import annotations

import math
import time
from collections.abc import Callable, Sequence
from dataclasses import dataclass, replace

import numpy as np
from measuring import plain_parser
from tile_boxes import reach_a_tile

from clsplat.arrays import Bool, Float32, Float64
from clsplat.camera import Camera, Window
from clsplat.chunks.bounds import ChunkBounds, hidden_path, largest_step, rounded_share
from clsplat.chunks.culling import PictureBorders, visible
from clsplat.config.training import OptimiserConfig
from clsplat.device.buffers import Workspace, upload
from clsplat.device.context import Device
from clsplat.device.selection import open_device
from clsplat.gaussians import Gaussians
from clsplat.rotations import rotation_from_quaternion
from clsplat.stages.device_camera import pack_camera
from clsplat.stages.device_gaussians import upload_gaussians
from clsplat.stages.project import project

Reach = Callable[[Float64, Float64, Float64, Float64, Camera], Bool]
"""True (N,) for Gaussians with a tile: arguments as of `reach_a_tile`."""
BOXES, ROWS = 200, 8
"""Boxes before a camera, and Gaussians in a box."""
PATHS = 64
"""Paths of a parameter by Adam for each number of steps."""
STEPS = ((0, 0), (1, 0), (1, 1), (1, 5000), (10, 0), (10, 30), (100, 1000), (300, 5000))
"""Steps of Adam that show a Gaussian, and steps after them that do not."""


@dataclass
class Tally:
    """Numbers of pairs: all, with a tile (`reached`), and found visible. missed: number of Gaussians missed."""

    pairs: int = 0
    reached: int = 0
    found: int = 0
    missed: int = 0


def paths(rng: np.random.Generator, shown: int, hidden: int, count: int, config: OptimiserConfig) -> Float64:
    """Movements (count,) of parameters by Adam at rate 1: sums of steps in float32, as in kernels/shared/adam.h.

    The gradients are, in equal parts: random; of one sign; growing by b2 / b1 from step to step, for which the bound is
    tight; random with large ones among small ones.
    shown, hidden: numbers of steps with gradients, and of later steps without any.
    """
    kinds = np.arange(count) % 4
    m: Float32 = np.zeros(count, np.float32)
    v, p = m.copy(), np.zeros(count)
    beta1, beta2 = np.float32(config.beta1), np.float32(config.beta2)
    sign = np.where(rng.random(count) < 0.5, -1.0, 1.0)
    for step in range(1, shown + hidden + 1):
        growing = (config.beta2 / config.beta1) ** min(step - shown, 0)
        random = rng.standard_normal(count)
        rare = random * np.where(rng.random(count) < 0.02, 1e3, 1e-2)
        g = np.where(kinds == 0, random, np.where(kinds == 1, sign, np.where(kinds == 2, sign * growing, rare)))
        g = (g if step <= shown else 0 * g).astype(np.float32)
        m = (beta1 * m + (1 - beta1) * g).astype(np.float32)
        v = (beta2 * v + (1 - beta2) * (g * g)).astype(np.float32)
        root = np.float32((1 - config.beta2**step) ** -0.5)
        p = p - np.float32(1 / (1 - config.beta1**step)) * m / (np.sqrt(v) * root + np.float32(config.epsilon))
    return p


def random_rotation(rng: np.random.Generator) -> Float64:
    """A random rotation, in one of eight cases combined with a reflection."""
    quaternion = rng.standard_normal(4)
    rotation = rotation_from_quaternion(quaternion / np.linalg.norm(quaternion))
    return rotation * [1.0, 1.0, -1.0] if rng.random() < 0.125 else rotation


def base_camera(rng: np.random.Generator, focal: float) -> Camera:
    """A camera at a random place, up to 1e4 from the origin, with a principal point in its picture.

    focal: mean focal length, relative to the picture's width.
    """
    width, height = (int(side) for side in rng.integers(1, 400, 2))
    rotation, position = random_rotation(rng), rng.standard_normal(3) * 10.0 ** rng.uniform(-1, 4)
    fx, fy = focal * width * np.exp(rng.uniform(-0.3, 0.3, 2))
    camera = Camera(width, height, fx, fy, rng.random() * width, rng.random() * height, rotation, np.zeros(3))
    near = 10.0 ** rng.uniform(-3, 1)
    far = near * 10.0 ** rng.uniform(0.1, 4) if rng.random() < 0.2 else math.inf
    return replace(camera, translation=-rotation @ position, near=near, far=far)


def off_centre(rng: np.random.Generator, camera: Camera) -> Camera:
    """The camera with its principal point far outside of the picture."""
    cx, cy = rng.uniform(-3, 4, 2) * [camera.width, camera.height]
    return replace(camera, cx=float(cx), cy=float(cy))


def windowed(rng: np.random.Generator, camera: Camera) -> Camera:
    """A part of the camera's picture, or a picture around it."""
    x, y = (int(each) for each in rng.integers(-300, 400, 2))
    width, height = (int(each) for each in rng.integers(1, 300, 2))
    width = min(width, camera.width) if camera.model.wraps else width  # at most a full turn
    part = camera.cropped(x, y, width, height)
    assert isinstance(part.window, Window)
    return replace(part, window=replace(part.window, clamp=float(rng.choice([0.3, 2.0]))))


def panorama(rng: np.random.Generator, turn: float) -> Camera:
    """A panorama of `turn` radians, of any height."""
    camera = base_camera(rng, 1.0)
    focal = camera.width / turn
    return replace(camera, fx=focal, fy=focal * np.exp(rng.uniform(-0.2, 0.2)), projection="equirectangular")


def bent(rng: np.random.Generator) -> Camera:
    """A fisheye with coefficients."""
    radial = rng.uniform(-0.1, 0.1, 4) * [1.0, 0.3, 0.1, 0.03]
    k1, k2, k3, k4 = (float(each) for each in radial)
    return replace(base_camera(rng, rng.uniform(0.15, 1.0)), projection="fisheye", radial=(k1, k2, k3, k4))


KINDS: dict[str, Callable[[np.random.Generator], Camera]] = {
    "ordinary": lambda rng: base_camera(rng, rng.uniform(0.5, 2.0)),
    "wide": lambda rng: base_camera(rng, rng.uniform(0.03, 0.3)),
    "telephoto": lambda rng: base_camera(rng, 10 ** rng.uniform(1, 3)),
    "off centre": lambda rng: off_centre(rng, base_camera(rng, rng.uniform(0.2, 2.0))),
    "window": lambda rng: windowed(rng, base_camera(rng, rng.uniform(0.2, 2.0))),
    "orthographic": lambda rng: windowed(
        rng, replace(base_camera(rng, rng.uniform(0.01, 2)), projection="orthographic")
    ),
    "along rays": lambda rng: replace(off_centre(rng, base_camera(rng, rng.uniform(0.1, 3.0))), by_rays=True),
    "fisheye": lambda rng: replace(base_camera(rng, rng.uniform(0.15, 1.0)), projection="fisheye"),
    "fisheye window": lambda rng: windowed(
        rng, replace(base_camera(rng, rng.uniform(0.15, 1.0)), projection="fisheye")
    ),
    "bent fisheye": bent,
    "panorama": lambda rng: panorama(rng, 2 * math.pi),
    "narrow panorama": lambda rng: panorama(rng, rng.uniform(0.1, 6.0)),
    "panorama window": lambda rng: windowed(rng, panorama(rng, 2 * math.pi)),
}


def at_borders(rng: np.random.Generator, camera: Camera, count: int) -> tuple[Float64, Float64]:
    """Points (count, 3) in the world, three in four at a border of the picture, and their distances (count,)."""
    window = camera.window or Window(0, 0, camera.width, camera.height)
    share = rng.uniform(-0.2, 1.2, (count, 2))
    side = np.arange(count) % 4
    share[side == 0, 0] = rng.choice([0, 1], (side == 0).sum())
    share[side == 1, 1] = rng.choice([0, 1], (side == 1).sum())
    pixels = share * [camera.width, camera.height] + ([window.x, window.y] if camera.window else [0, 0])
    places = (pixels - [camera.cx, camera.cy]) / [camera.fx, camera.fy]
    origins, rays = camera.model.rays_of(camera, *places.T)
    rays = np.where(np.isfinite(rays), rays, rng.standard_normal((count, 3)))
    astray = side == 3
    rays[astray] = rng.standard_normal((astray.sum(), 3))
    distances = camera.near * 10.0 ** rng.uniform(-1, 4, count)
    points = np.nan_to_num(origins) + rays / np.linalg.norm(rays, axis=1, keepdims=True) * distances[:, None]
    return (points - camera.translation) @ np.linalg.inv(camera.rotation).T, distances


def rows_of(rng: np.random.Generator, camera: Camera, boxes: int) -> tuple[Float32, Float32, Float32, Float32, Float64]:
    """Means, quaternions, log scales and opacity logits (boxes, ROWS, ...), and the boxes' distances from the camera.

    Of four Gaussians, two have means at corners of their box. Two have the largest scale on all axes, and one is a
    needle.
    """
    points, distances = at_borders(rng, camera, boxes)
    half = distances[:, None] * 10.0 ** rng.uniform(-4, 0.3, (boxes, 3))
    largest = np.log(distances) + np.log(10) * rng.uniform(-5, 1, boxes)
    aside = rng.standard_normal((boxes, 3))
    aside *= rng.uniform(0, 1.5, (boxes, 1)) / np.linalg.norm(aside, axis=1, keepdims=True)
    points += aside * (half.max(axis=1) + 3.33 * np.exp(largest))[:, None] * rng.choice([0.0, 1.0], (boxes, 1))
    within = rng.uniform(-1, 1, (boxes, ROWS, 3))
    within[:, ::2] = np.sign(within[:, ::2])
    scales = largest[:, None, None] - rng.exponential(3.0, (boxes, ROWS, 3)) * (np.arange(ROWS) % 4 > 1)[None, :, None]
    scales[:, :, 0] = np.where(np.arange(ROWS) % 4 == 3, largest[:, None], scales[:, :, 0])
    logits = np.where(rng.random((boxes, ROWS)) < 0.7, 20.0, rng.uniform(-6, 6, (boxes, ROWS)))
    arrays = points[:, None] + within * half[:, None], rng.standard_normal((boxes, ROWS, 4)), scales, logits
    means, quaternions, log_scales, opacity_logits = (each.astype(np.float32) for each in arrays)
    return means, quaternions, log_scales, opacity_logits, distances


class Movements:
    """Paths of parameters by Adam, and the bounds of their ends."""

    def __init__(
        self, rng: np.random.Generator, config: OptimiserConfig, kept: Sequence[tuple[int, int]] = STEPS
    ) -> None:
        self._rng, self._steps = rng, tuple(kept)
        self._paths = [paths(rng, shown, hidden, PATHS, config) for shown, hidden in kept]
        step, path = largest_step(config), hidden_path(config)
        self.bounds = [shown * step + path * (hidden > 0) for shown, hidden in kept]

    def moved(
        self, means: Float32, log_scales: Float32, distances: Float64
    ) -> tuple[Float32, Float32, Float64, float, int]:
        """Means and log scales (boxes, ROWS, 3) after random steps, the bounds of both, and the number of steps.

        distances: (boxes,), of the boxes from the camera.
        """
        case = int(self._rng.integers(len(self._steps)))
        mean_rates = distances * 10.0 ** self._rng.uniform(-6, -2)
        scale_rate = 10.0 ** self._rng.uniform(-6, -2)
        by = [self._rng.choice(self._paths[case], each.shape) for each in (means, log_scales)]
        after = means + mean_rates[:, None, None] * by[0], log_scales + scale_rate * by[1]
        bound, steps = self.bounds[case], sum(self._steps[case])
        moved, scaled = (each.astype(np.float32) for each in after)
        return moved, scaled, mean_rates * bound, scale_rate * bound, steps


def by_kernels(device: Device) -> Reach:
    """A `Reach` by the kernels of projection: it finds the Gaussians to which they give a tile."""
    work = Workspace(device)

    def reach(means: Float64, quaternions: Float64, log_scales: Float64, logits: Float64, camera: Camera) -> Bool:
        rows = [each.astype(np.float32) for each in (means, quaternions, log_scales, logits)]
        model = Gaussians(rows[0], rows[1], rows[2], rows[3], np.zeros((len(means), 1, 3), np.float32))
        of_model = device.with_switches(camera.model.defines)
        view = upload(device, pack_camera(camera))
        projected = project(of_model, work, upload_gaussians(device, model), camera, view)
        shown: Bool = projected.tile_counts.get() > 0
        return shown

    return reach


def compare(
    rng: np.random.Generator, kind: str, movements: Movements, reach: Reach = reach_a_tile, boxes: int = BOXES
) -> tuple[Tally, Camera]:
    """Compare culling with every Gaussian, for a camera of this kind. Returns the numbers, and the camera.

    kind: a key of KINDS.
    boxes: number of boxes.
    """
    camera = KINDS[kind](rng)
    means, quaternions, log_scales, logits, distances = rows_of(rng, camera, boxes)
    lowest, highest = means.min(axis=1).astype(np.float64), means.max(axis=1).astype(np.float64)
    bounds = ChunkBounds.of_sides(lowest, highest, log_scales.max(axis=(1, 2)).astype(np.float64))
    moved, scaled, mean_step, scale_step, steps = movements.moved(means, log_scales, distances)
    share = rounded_share(steps)
    widened = bounds.with_rounding(steps).widened(share * mean_step, share * scale_step)
    found = visible(PictureBorders.of(camera), widened)
    flat = (each.reshape(boxes * ROWS, -1).astype(np.float64) for each in (moved, quaternions, scaled))
    places, turns, sizes = flat
    reached = reach(places, turns, sizes, logits.reshape(-1).astype(np.float64), camera).reshape(boxes, ROWS)
    missed = int((reached & ~found[:, None]).sum())
    return Tally(boxes, int(reached.any(axis=1).sum()), int(found.sum()), missed), camera


def main(argv: Sequence[str]) -> int:
    """Compare, and print the table. Returns the exit status."""
    parser = plain_parser(__doc__)
    parser.add_argument("--pairs", type=float, default=1e6, help="number of pairs, default 1e6")
    parser.add_argument("--seed", type=int, default=0, help="seed of the random numbers, default 0")
    parser.add_argument("--device", help="count tiles by the kernels of this device of clsplat devices")
    arguments = parser.parse_args(argv)
    reach = by_kernels(open_device(arguments.device)) if arguments.device else reach_a_tile
    rng, begun = np.random.default_rng(arguments.seed), time.perf_counter()
    movements = Movements(rng, OptimiserConfig())
    cameras = math.ceil(arguments.pairs / BOXES / len(KINDS))
    print(f"{'camera':16} {'pairs':>9} {'with a tile':>11} {'visible':>9} {'missed':>6}")
    total = 0
    for kind in KINDS:
        sums = Tally()
        for _ in range(cameras):
            tally, camera = compare(rng, kind, movements, reach)
            if tally.missed and not sums.missed:
                print("missed before", " ".join(f"{camera}".split()))
            for name, value in vars(tally).items():
                setattr(sums, name, getattr(sums, name) + value)
        print(f"{kind:16} {sums.pairs:9} {sums.reached:11} {sums.found:9} {sums.missed:6}")
        total += sums.missed
    print(f"{cameras * BOXES * len(KINDS)} pairs, {time.perf_counter() - begun:.0f} s, {total} Gaussians missed")
    return 1 if total else 0
