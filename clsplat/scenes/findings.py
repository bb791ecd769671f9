# SPDX-License-Identifier: Apache-2.0
"""Findings about a scene before it is trained: what in its photographs a setting answers, or nothing but other
photographs. They come from glances at the photographs, the cameras and the points, without a device."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from typing import Any, Literal

import numpy as np
from numpy.typing import NDArray

from clsplat.arrays import Float64
from clsplat.config.masks import NO_MASKS, MaskUse
from clsplat.errors import InputError, examples
from clsplat.scenes.data_set import RADIAL
from clsplat.scenes.glance import GREY
from clsplat.scenes.looked import BRIGHT, LEAST_POINTS, Looked
from clsplat.scenes.masks import masks_beside, read_mask
from clsplat.scenes.scene import Scene, View

Kind = Literal[
    "few steps",
    "exposure",
    "scales",
    "masks",
    "cut out",
    "strange masks",
    "alpha",
    "fisheye",
    "sky",
    "few views",
    "some views",
    "blur",
    "duplicates",
]

EXPOSURE = 0.2
"""Standard deviation over the photographs, in stops, of a channel's brightness. Cameras that hold their exposure are
under 0.1 by this measure, as points are hidden and shine; gains that are learnt begin to pay at about 0.2."""
SCALES = 4.0
"""Distances over focal lengths, the ninth tenth over the first. From 4 on a Gaussian that is a pixel in one photograph
is a quarter of one, or four, in another."""
CUT_OUT = 0.9
"""Part of the photographs' border that masks leave out where they cut a thing out of its surroundings."""
MOST_MASKS = 12
"""Masks that are read to tell that."""
TRANSPARENT = 0.02
"""Part of a photograph's pixels that is transparent where alpha means something; a seam or a corner is less."""
WIDE = 100.0
"""Degrees across a fisheye's picture from which on undistortion loses much: pinhole pictures grow with the tangent."""
FEW = 16
"""Training photographs under which each part of a scene is seen from too few sides to fix its depth; published
trainings of 12 are 8 dB under those of 100, of 24 about 3."""
SOME = 30
"""Training photographs under which growth without a bound fits them rather than the scene (docs/quality.md)."""
A_POINT, A_GAUSSIAN = 12, 16
"""Gaussians at most for each point that was found in so many photographs, and pixels at least for each Gaussian: it has
up to 59 numbers, a pixel three. fox's 50 photographs are best with 7 Gaussians a point (docs/quality.md, Growth)."""
FEW_STEPS = 60
"""Steps for each training photograph under which high rates pay (docs/decisions/0031-high-rates.md)."""
SHORT_TRAINING = range(1000, 10_001)
"""Numbers of steps that these rates were measured with, 2000 to 7000, and those not far from them."""
BLURRED = 0.72
"""Sharpness, in the scene's median, under which a photograph is called blurred; a blur of a pixel and a half is there.
What is photographed moves it by a tenth or two."""
ODD = 3.5
"""Standard deviations under the median (by quartiles) that it has to be beside that."""
COPY = 1.5 / 255
"""Root mean square difference of two glances up to which they are one picture; JPEG's rounding is a half of it."""
FLAT = 8 / 255
"""Standard deviation under which a glance shows nothing, and is no copy of another such."""
SKY_PART, SKY_VIEWS = 0.06, 0.3
"""Part of a photograph that its sky is at least, and of the photographs that have one."""
SKY_POINTS = 0.1
"""Points in the sky for each in as large a part of the rest, at most."""
SKY_SMOOTH, SKY_LIGHT = 0.025, 0.45
"""Largest difference of neighbouring pixels of a glance in a sky, and least brightness."""
SKY_BLUE = 0.02
"""Blue less red that a sky has at least; a wall under lamps has less than 0, and a white sky is BRIGHT."""


@dataclass(frozen=True)
class Finding:
    """A part of a sentence about the photographs, and its kind. options: settings that answer it, the best first, where
    they follow from the photographs."""

    kind: Kind
    text: str
    options: Sequence[Mapping[str, Any]] = ()


def findings(scene: Scene, use: MaskUse = NO_MASKS, iterations: int = 0) -> list[Finding]:
    """All findings about a scene, read with these masks, to be trained in so many steps if that is known. Raises
    InputError as `Scene.check_pictures`."""
    looked = Looked(scene)
    found = (
        _few(scene),
        _some(scene),
        _few_steps(scene, iterations),
        _exposure(looked),
        _scales(looked),
        _masks(scene, use),
        _alpha(scene, use),
        _fisheye(scene),
        _sky(looked),
        _blur(scene),
        _duplicates(scene),
    )
    return [each for each in found if each is not None]


def _exposure(looked: Looked) -> Finding | None:
    gains = looked.gains
    if len(gains) < 3:
        return None
    values = np.array(list(gains.values()))
    spread = float(values.std(axis=0).max())
    if spread < EXPOSURE:
        return None
    grey = values @ GREY.astype(np.float64)
    low, high = (list(gains)[index] for index in (grey.argmin(), grey.argmax()))
    return Finding(
        "exposure",
        f"exposures or colours differ by {spread:.2f} stops from photograph to photograph, {np.ptp(grey):.1f} from "
        f"{low} to {high}",
    )


def _scales(looked: Looked) -> Finding | None:
    distances = []
    for view in looked.scene.train_views:
        _, _, _, depths = looked.places.get(view.name, (0, 0, 0, np.empty(0)))
        if len(depths) >= LEAST_POINTS:
            distances.append(float(np.median(depths)) / view.camera.fx * view.camera.width)
    if len(distances) < 3:
        return None
    near, far = np.quantile(distances, (0.1, 0.9))
    if far < SCALES * near:
        return None
    return Finding("scales", f"photographs are from near and from far, {far / near:.0f} times as far")


def _masks(scene: Scene, use: MaskUse) -> Finding | None:
    if use.masks != "none":
        return None
    try:
        found = masks_beside(scene.views)
        some = sorted(found)[:: max(len(found) // MOST_MASKS, 1)]
        masks = [read_mask(found[name], orient=False, invert=False)[:, :, 0] for name in some]
    except InputError as error:
        return _strange_masks(scene, str(error).partition("; ")[0])
    if not masks:
        return None
    kept = [(mask.mean(), np.concatenate([mask[0], mask[-1], mask[:, 0], mask[:, -1]]).mean()) for mask in masks]
    inside, border = np.mean(kept, axis=0)
    text = f"there are masks for {len(found):,} of {len(scene.views):,} photographs, and they are not used"
    if border <= 1 - CUT_OUT and inside < 0.5:
        return Finding("cut out", f"{text}; they cut out a thing that is {100 * inside:.0f} % of the pictures")
    return Finding("masks", f"{text}; they leave out {100 - 100 * inside:.0f} % of the pictures")


def _strange_masks(scene: Scene, reason: str) -> Finding | None:
    """Masks of some photographs, beside what is none; nothing where all there is is something else's."""
    try:
        count = len(masks_beside(scene.views, strict=False))
    except InputError:
        return None
    if not count:
        return None
    text = f"there are masks for {count:,} of {len(scene.views):,} photographs, which cannot be used ({reason})"
    return Finding("strange masks", text)


def _alpha(scene: Scene, use: MaskUse) -> Finding | None:
    if use.alpha != "blend":
        return None
    shares = np.array([scene.glances[view.name].transparent for view in scene.train_views])
    if (shares >= TRANSPARENT).mean() < 0.5:
        return None
    part = f"{100 * shares.mean():.0f} %"
    return Finding("alpha", f"{part} of the photographs is transparent, and lies over the background")


def _fisheye(scene: Scene) -> Finding | None:
    wide = [
        (2 * np.degrees(view.lens.width / 2 / view.lens.params[0]), view)
        for view in scene.train_views
        if view.lens.model in RADIAL and view.camera.projection == "perspective"
    ]
    if not wide or (most := max(angle for angle, _ in wide)) < WIDE:
        return None
    return Finding(
        "fisheye", f"{len(wide):,} photographs are through fisheyes of {most:.0f} degrees across, and undistorted"
    )


def _few(scene: Scene) -> Finding | None:
    count = len(scene.train_views)
    if count >= FEW:
        return None
    return Finding("few views", f"{count} photographs to train on are few, so that views from elsewhere will show fog")


def _some(scene: Scene) -> Finding | None:
    count = len(scene.train_views)
    if not FEW <= count < SOME:
        return None
    pixels = sum(view.camera.width * view.camera.height for view in scene.train_views)
    points = len(scene.points)
    most = max(min(pixels // A_GAUSSIAN, A_POINT * points or pixels), points, 1)
    why = f"{count} photographs to train on, with {points:,} points and {pixels / 1e6:.1f} million pixels"
    sparse, bound = {"thinning": 0.2, "penalty": 0.02}, {"density.max_gaussians": most}
    options = ({**sparse, **bound}, sparse, {"thinning": 0.2})
    return Finding("some views", f"{why}, tell of about {most:,} Gaussians", options)


def _few_steps(scene: Scene, iterations: int) -> Finding | None:
    count = len(scene.train_views)
    if iterations not in SHORT_TRAINING or iterations >= FEW_STEPS * count:
        return None
    each = iterations / count
    text = (
        f"{iterations:,} steps are {each:.1f} for each of {count:,} photographs to train on, which takes higher rates"
    )
    return Finding("few steps", text)


def _sky(looked: Looked) -> Finding | None:
    scene = looked.scene
    parts = [_sky_part(looked, view) for view in scene.train_views if view.name in looked.places]
    with_sky = [part for part in parts if part >= SKY_PART]
    if len(with_sky) < max(3, SKY_VIEWS * len(parts)) or not len(scene.points):
        return None
    return Finding(
        "sky", f"{len(with_sky):,} photographs have a sky, {100 * np.mean(with_sky):.0f} % of each, without points"
    )


def _sky_part(looked: Looked, view: View) -> float:
    """Part of a view that is sky: light, smooth, blue or white, joined to the upper border, above the horizon, and
    without points."""
    pixels = looked.scene.glances[view.name].pixels
    up = looked.up @ view.camera.rotation.T
    turns = int(np.round(np.arctan2(up[0], -up[1]) / (np.pi / 2))) % 4  # quarter turns that make the picture upright
    upright = np.rot90(pixels, turns)
    light = upright @ GREY
    steps = np.zeros(light.shape)
    steps[1:] = np.abs(np.diff(light, axis=0))
    steps[:, 1:] = np.maximum(steps[:, 1:], np.abs(np.diff(light, axis=1)))
    blue = upright[:, :, 2] - upright[:, :, 0]
    likely = (light > SKY_LIGHT) & (steps < SKY_SMOOTH) & ((blue > SKY_BLUE) | (light > BRIGHT))
    reached = np.logical_and.accumulate(likely, axis=0)  # from the border down
    part = float(reached.mean())
    if part < SKY_PART or not likely[0].mean() > 0.5:
        return 0.0
    _, rows, columns, _ = looked.places[view.name]
    held = np.rot90(reached, -turns)[rows, columns].mean() if len(rows) else 1.0
    if held > SKY_POINTS * part or _elevation(view, np.rot90(reached, -turns), looked.up) < 0:
        return 0.0
    return part


def _elevation(view: View, part: NDArray[np.bool_], up: Float64) -> float:
    """Sine of the mean elevation of a view's pixels (h, w) that are in a part of it."""
    rows, columns = np.nonzero(part)
    camera = view.camera.resized(part.shape[1], part.shape[0])
    x, y = (columns.mean() + 0.5 - camera.cx) / camera.fx, (rows.mean() + 0.5 - camera.cy) / camera.fy
    ray = np.array([x, y, 1.0]) @ camera.rotation
    return float(ray @ up / np.linalg.norm(ray))


def _blur(scene: Scene) -> Finding | None:
    names = [view.name for view in scene.train_views]
    logs = np.log([max(scene.glances[name].sharpness, 1e-6) for name in names])
    if len(names) < 5:
        return None
    low, middle, high = np.quantile(logs, (0.25, 0.5, 0.75))
    limit = min(middle + np.log(BLURRED), middle - ODD * (high - low) / 1.349)
    blurred = [name for name, value in zip(names, logs, strict=True) if value < limit]
    if not blurred:
        return None
    return Finding("blur", f"{len(blurred):,} photographs are blurred beside the others ({examples(blurred)})")


def _duplicates(scene: Scene) -> Finding | None:
    """Photographs whose glances are one."""
    by_size: dict[tuple[int, ...], list[str]] = {}
    for view in scene.views:
        by_size.setdefault(scene.glances[view.name].pixels.shape, []).append(view.name)
    copies = []
    for names in by_size.values():
        flat = np.array([scene.glances[name].pixels[::4, ::4].ravel() for name in names], np.float64)
        squares = (flat * flat).sum(axis=1)
        apart = (squares[:, None] + squares - 2 * flat @ flat.T) / flat.shape[1]
        for one, other in np.argwhere(np.triu(apart <= 4 * COPY * COPY, 1)):
            a, b = (scene.glances[names[index]].pixels for index in (one, other))
            if a.std(axis=(0, 1)).max() > FLAT and float(np.square(a - b).mean()) <= COPY * COPY:
                copies.append(f"{names[other]} is {names[one]}")
    if not copies:
        return None
    return Finding("duplicates", f"{len(copies):,} photographs are there twice ({examples(copies)})")
