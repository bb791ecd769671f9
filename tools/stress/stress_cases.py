# SPDX-License-Identifier: Apache-2.0
"""Stressors of projection and its gradient. Each makes extreme Gaussians for one camera, and tells how extreme."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass, field, replace

import numpy as np
from scipy.spatial.transform import Rotation

from clsplat.arrays import Float64
from clsplat.camera import Camera
from clsplat.gaussians import Gaussians

WIDTH, HEIGHT, FOCAL = 640, 360, 600.0
DEGREE = 1
"""Degree of the SH: enough for the gradient with respect to the direction. Other tests check the bands themselves."""


@dataclass
class Cloud:
    """Gaussians in float64, which a stressor changes.

    pixels: (n, 2), the means on the image.
    axes: (n, 3), standard deviations in pixels.
    scales: (n, 3), standard deviations in world units, in place of `axes`.
    spoilt: Gaussians in place of all the other arrays.
    """

    camera: Camera
    pixels: Float64
    depths: Float64
    axes: Float64
    quaternions: Float64
    logits: Float64
    sh: Float64
    scales: Float64 | None = None
    spoilt: Gaussians | None = None

    def gaussians(self) -> Gaussians:
        """The Gaussians in float32, with means in the world; or `spoilt`."""
        if self.spoilt is not None:
            return self.spoilt
        camera = self.camera
        flat = (self.pixels - (camera.cx, camera.cy)) / (camera.fx, camera.fy) * self.depths[:, None]
        means = (np.column_stack([flat, self.depths]) - camera.translation) @ camera.rotation
        scales = self.scales if self.scales is not None else self.axes * np.abs(self.depths)[:, None] / camera.fx
        with np.errstate(divide="ignore"):
            arrays = (means, self.quaternions, np.log(scales), self.logits, self.sh)
        places, turns, logs, logits, harmonics = (np.ascontiguousarray(array, np.float32) for array in arrays)
        return Gaussians(places, turns, logs, logits, harmonics)


@dataclass(frozen=True, eq=False)
class Cases:
    """A batch of cases.

    hurt: (n,), how extreme each case is, in the stressor's unit.
    """

    gaussians: Gaussians
    camera: Camera
    hurt: Float64


def camera_of(rng: np.random.Generator) -> Camera:
    """A camera with a random pose, different fx and fy, and the principal point near the middle."""
    axis = rng.normal(size=3)
    rotation = Rotation.from_rotvec(rng.uniform(-np.pi, np.pi) * axis / np.linalg.norm(axis)).as_matrix()
    cx, cy = WIDTH * rng.uniform(0.4, 0.6), HEIGHT * rng.uniform(0.4, 0.6)
    position = rng.normal(size=3)
    return Camera(WIDTH, HEIGHT, FOCAL, 1.1 * FOCAL, cx, cy, rotation, -rotation @ position)


def cloud(rng: np.random.Generator, count: int) -> Cloud:
    """Gaussians like those of a trained scene: axes of 0.3 to 30 pixels, and all opacities."""
    return Cloud(
        camera=camera_of(rng),
        pixels=rng.uniform(-0.1, 1.1, (count, 2)) * (WIDTH, HEIGHT),
        depths=rng.uniform(1.0, 10.0, count),
        axes=10 ** rng.uniform(-0.5, 1.5, (count, 3)),
        quaternions=rng.normal(size=(count, 4)) * rng.uniform(0.3, 3.0, (count, 1)),
        logits=rng.normal(0.0, 2.0, count),
        sh=rng.normal(0.0, 0.4, (count, (DEGREE + 1) ** 2, 3)),
    )


def scales(made: Cloud, rng: np.random.Generator, count: int) -> Float64:
    size = 10 ** rng.uniform(-12, 6, (count, 1))
    made.scales = size * 10 ** rng.uniform(-0.5, 0.5, (count, 3))
    return size[:, 0]


def _elongated(made: Cloud, rng: np.random.Generator, low: float, high: float) -> tuple[Float64, Float64]:
    """Make needles and discs, with longest axes of 10^low to 10^high pixels.

    Returns the longest axes, and their ratios to the shortest ones.
    """
    count = len(made.depths)
    longest, ratio = 10 ** rng.uniform(low, high, count), 10 ** rng.uniform(0, 8, count)
    middle = np.where(rng.random(count) < 0.5, longest, longest / ratio)
    made.axes = rng.permuted(np.stack([longest, middle, longest / ratio], axis=1), axis=1)
    return longest, ratio


def edge_on(made: Cloud, rng: np.random.Generator, count: int) -> Float64:
    """Needles that point at the camera, and discs seen from the side, apart from a random angle. Returns the angles."""
    angle = 10 ** rng.uniform(-8, 0, count)
    needle = rng.random(count) < 0.5
    ratio = 10 ** rng.uniform(0, 8, count)
    longest = 10 ** rng.uniform(0, 2.8, count)
    flat = np.where(needle, longest / ratio, longest)
    # the third axis is the needle's own, or the disc's normal
    made.axes = np.stack([flat, flat, np.where(needle, longest, longest / ratio)], axis=1)
    rays = np.column_stack([(made.pixels - (made.camera.cx, made.camera.cy)) / (FOCAL, 1.1 * FOCAL), np.ones(count)])
    rays = rays @ made.camera.rotation
    rays /= np.linalg.norm(rays, axis=1, keepdims=True)
    across = np.cross(rays, rng.normal(size=(count, 3)))
    across /= np.linalg.norm(across, axis=1, keepdims=True)
    along, aside = np.cos(angle)[:, None], np.sin(angle)[:, None]
    target = np.where(needle[:, None], along * rays + aside * across, aside * rays + along * across)
    # the shortest turn that takes z to the target, after a random one about z
    turn = np.column_stack([1 + target[:, 2], -target[:, 1], target[:, 0], np.zeros(count)])
    spin = rng.uniform(0, np.pi, count)
    cos, sin = np.cos(spin), np.sin(spin)
    w, x, y, _ = turn.T
    made.quaternions = np.column_stack([w * cos, x * cos + y * sin, y * cos - x * sin, w * sin])
    return angle


def near_plane(made: Cloud, rng: np.random.Generator, count: int) -> Float64:
    apart = 10 ** rng.uniform(-7, 0, count)
    made.depths = made.camera.near * (1 + rng.choice([-1.0, 1.0], count) * apart)
    behind = rng.random(count) < 0.1
    made.depths = np.where(behind, -rng.uniform(0, 10, count), made.depths)
    made.scales = 10 ** rng.uniform(-4, -1, (count, 3))
    return apart


def off_frustum(made: Cloud, rng: np.random.Generator, count: int) -> Float64:
    angle, away = rng.uniform(0, 2 * np.pi, count), 10 ** rng.uniform(-1, 4, count)
    made.pixels = (WIDTH, HEIGHT) * (0.5 + away[:, None] * np.stack([np.cos(angle), np.sin(angle)], axis=1))
    made.axes *= np.maximum(away, 1)[:, None] * 10 ** rng.uniform(0, 1.5, (count, 1))
    return away


def depths(made: Cloud, rng: np.random.Generator, count: int) -> Float64:
    made.camera = replace(made.camera, near=1e-4)
    made.depths = 10 ** rng.uniform(-3, 7, count)
    return made.depths


def opacities(made: Cloud, rng: np.random.Generator, count: int) -> Float64:
    threshold = np.float32(-np.log(254.0))
    ulps = rng.integers(-3, 4, count) * np.spacing(threshold)
    kinds = rng.integers(0, 4, count)
    exact = rng.choice([-np.inf, np.inf, -3e38, 3e38, -100.0, 100.0, -87.0, 87.0, 0.0], count)
    wide = rng.uniform(-100, 100, count)
    made.logits = np.choose(kinds, [threshold + ulps, exact, wide, rng.uniform(-8, 20, count)])
    return np.clip(made.logits, -100, 100)


def quaternions(made: Cloud, rng: np.random.Generator, count: int) -> Float64:
    length = 10 ** rng.uniform(-14, 14, count)
    extreme = rng.random(count) < 0.1
    length = np.where(extreme, rng.choice([0.0, 1e-45, 1e-40, 1e-30, 1e-20, 1e20, 1e30, 1e37], count), length)
    made.quaternions *= (length / np.linalg.norm(made.quaternions, axis=1))[:, None]
    return length


def far_world(made: Cloud, rng: np.random.Generator, count: int) -> Float64:
    """Gaussians and a camera far from the world's origin. The rounding of means to float32 is no error here."""
    offset = rng.normal(size=3)
    offset *= 10 ** rng.uniform(3, 6.5) / np.linalg.norm(offset)
    camera = made.camera
    made.camera = replace(camera, translation=camera.translation - camera.rotation @ offset)
    made.depths = 10 ** rng.uniform(0.5, 3, count)
    return np.full(count, np.linalg.norm(offset))


def off_centre(made: Cloud, rng: np.random.Generator, count: int) -> Float64:
    away = rng.uniform(-5, 5, 2)
    made.camera = replace(made.camera, cx=WIDTH * (0.5 + away[0]), cy=HEIGHT * (0.5 + away[1]))
    return np.full(count, np.abs(away).max())


def focal_lengths(made: Cloud, rng: np.random.Generator, count: int) -> Float64:
    focal = float(10 ** rng.uniform(0, 6))
    made.camera = replace(made.camera, fx=focal, fy=focal * rng.uniform(0.5, 2))
    return np.full(count, focal)


def colours(made: Cloud, rng: np.random.Generator, count: int) -> Float64:
    factor = 10 ** rng.uniform(0, 8, count)
    made.sh *= factor[:, None, None]
    return factor


def balls(made: Cloud, rng: np.random.Generator, count: int) -> Float64:
    """Gaussians with three nearly or exactly equal axes. The gradient of a rotation is then a small difference."""
    apart = 10 ** rng.uniform(-8, 0, count)
    apart[rng.random(count) < 0.05] = 0
    made.axes = made.axes[:, :1] * np.exp(apart[:, None] * rng.uniform(-1, 1, (count, 3)))
    return np.maximum(apart, 1e-8)


def wild(made: Cloud, rng: np.random.Generator, count: int) -> Float64:
    """Gaussians with arbitrary float32 values in one parameter or in all. Only finite results are required."""
    gaussians = made.gaussians()
    everywhere = rng.random(count) < 0.2
    group = rng.integers(0, 5, count)
    names = ("means", "quaternions", "log_scales", "opacity_logits", "sh")
    for index, array in enumerate(getattr(gaussians, name) for name in names):
        rows = np.flatnonzero(everywhere | (group == index))
        values = rng.integers(0, 2**32, (len(rows), *array.shape[1:]), np.uint32).view(np.float32)
        special = np.array([0.0, -0.0, np.inf, -np.inf, np.nan, 1e-45, 3.4e38, -3.4e38, 88.0, -104.0], np.float32)
        pick = rng.random(values.shape) < 0.3
        array[rows] = np.where(pick, rng.choice(special, values.shape), values)
    made.spoilt = gaussians
    return np.ones(count)


Bounds = dict[str, float]

PROJECTION: Bounds = {
    "position": 2e-6,
    "shape": 1e-4,
    "offset": 1e-3,
    "depth": 2e-7,
    "opacity": 1e-6,
    "extent": 1e-4,
    "colour": 1e-6,
}
"""Maximum error of a case, by column of `ERRORS`.

- position: two floats store a mean with a relative error of 2^-44, and the fraction of a pixel has one of 6e-8. The
  bound allows a few such roundings.
- shape: float32 may cause an error of 3e-5 before the rotation is refined, in each of three terms.
- offset: l12 is stored in float32. So the end of a needle 0.55 pixels wide and some 700 pixels from its mean is off by
  700 / 0.55 * 2^-24 = 8e-5. The error of the shape times the extent of 3.3 is added.
- depth, opacity, colour: two to ten roundings of 6e-8.
- extent: in a budget log2(255 o) of 0.007, the rounding of log2 o, of size 8, leaves four correct digits.
"""
GRADIENT_NORM, GRADIENT_TAIL = 1e-4, 1e-3
"""Bounds of a gradient's relative error: in norm over all cases, and for the 99.9th percentile of Gaussians.

The largest relative error has no bound, because a gradient may vanish.
"""

FRAME_TAIL = 5e-3
"""GRADIENT_TAIL for frames of one kind, which have only a few thousand Gaussians.

By chance, more of their gradients are near zero, and needles have the error of their ends. All kinds together must stay
within GRADIENT_TAIL.
"""
FRAME = 2e-5
"""Bound of the error of a pixel's colour outside the band, relative to the frame's brightest colour.

It allows a few dozen roundings of 6e-8. The ends of needles are off by 64 / 0.55 * 2^-24 = 7e-6, as for `offset` in
PROJECTION.
"""
BAND_SHARE = 0.03
"""Maximum fraction of pixels in the band: a threshold there decides on a value within 1e-4 of it.

In the scene "faint", about 100 Gaussians at each pixel have alphas spread evenly around 1/255. Of these, a fraction of
2e-4 is in the band. Other scenes have few such pixels.
"""


@dataclass(frozen=True)
class Stressor:
    """A way to make extreme Gaussians.

    change(cloud, rng, count): changes a cloud of `count` Gaussians, and returns `Cases.hurt`.
    unit: unit of `Cases.hurt`, for the plot.
    bounds, why: bounds that differ from PROJECTION's, and the reason.
    finite: True if results only have to be finite.
    """

    change: Callable[[Cloud, np.random.Generator, int], Float64]
    unit: str
    bounds: Bounds = field(default_factory=dict)
    why: str = ""
    finite: bool = False

    def make(self, rng: np.random.Generator, count: int) -> Cases:
        """A batch of `count` cases."""
        made = cloud(rng, count)
        hurt = self.change(made, rng, count)
        return Cases(made.gaussians(), made.camera, hurt)


STRESSORS: dict[str, Stressor] = {
    "ordinary": Stressor(lambda made, *_: np.asarray(made.axes.max(axis=1)), "longest axis, px"),
    "scales": Stressor(scales, "scale, world units"),
    # needles and discs: their longest axes are at most as long as the image, or far longer
    "anisotropy": Stressor(lambda made, rng, _: _elongated(made, rng, 0, 2.8)[1], "longest axis / shortest axis"),
    "giants": Stressor(lambda made, rng, _: _elongated(made, rng, 2.8, 6)[0], "longest axis, px"),
    "edge_on": Stressor(edge_on, "angle to the ray (needles) or to its perpendicular (discs), rad"),
    "near_plane": Stressor(near_plane, "|z / near - 1|"),
    "off_frustum": Stressor(off_frustum, "distance from the middle, image sizes"),
    "depths": Stressor(depths, "depth"),
    "opacities": Stressor(opacities, "logit"),
    "quaternions": Stressor(quaternions, "|q|"),
    "far_world": Stressor(
        far_world,
        "distance from the world's origin",
        {"position": 1e-5},
        "3e6 units in two floats leave 3e6 * 2^-48 = 1e-8 a product and sum, four of them, times fy / z = 660 / 3",
    ),
    "off_centre": Stressor(off_centre, "principal point from the middle, image sizes"),
    "focal_lengths": Stressor(focal_lengths, "focal length, px"),
    "colours": Stressor(colours, "factor on the SH"),
    "balls": Stressor(balls, "largest log ratio of two axes"),
    "wild": Stressor(wild, "", finite=True),
}
