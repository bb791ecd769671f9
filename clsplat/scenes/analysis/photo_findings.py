# SPDX-License-Identifier: Apache-2.0
"""Findings about a scene before training: blur, varying exposure, masks, sky and other problems of its photographs.

Findings are based on thumbnails, cameras and points, and need no OpenCL device.
"""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from typing import Any, Literal

import numpy as np
from numpy.typing import NDArray

from clsplat.arrays import Float64
from clsplat.config.masks import NO_MASKS, MaskUse
from clsplat.errors import InputError, examples
from clsplat.scenes.analysis.visible_points import MAX_EXPOSURE_COLOUR, MIN_POINTS_PER_VIEW, VisiblePoints
from clsplat.scenes.scene import Scene, View
from clsplat.scenes.supervision.masks import masks_beside, read_mask
from clsplat.scenes.thumbnail import REC601_LUMA

Kind = Literal[
    "few steps",
    "few passes",
    "exposure",
    "scales",
    "masks",
    "cut out",
    "strange masks",
    "alpha",
    "undistorted",
    "sky",
    "few views",
    "some views",
    "blur",
    "duplicates",
]

EXPOSURE_SPREAD_STOPS = 0.2
"""Exposures count as varying if a channel's brightness varies between photographs by at least this standard deviation,
in stops.

With locked exposure, occlusion and highlights cause up to 0.1. From about 0.2, learnt gains improve a model.
"""
DISTANCE_SPREAD_RATIO = 4.0
"""Distances of the photographs from the subject count as varying widely if the longest are at least this many times the
shortest. They are measured in focal lengths. Longest and shortest are the 90th and the 10th percentile.

At 4, a Gaussian one pixel wide in a near photograph is a quarter of a pixel wide in a far one.
"""
CUT_OUT_BORDER_FRACTION = 0.9
"""Masks cut an object out of its background if they leave out at least this fraction of the border pixels."""
SAMPLED_MASKS = 12
"""Approximate number of masks, evenly spaced, that are read to recognise cut-outs. Up to twice as many may be read."""
TRANSPARENT_PIXEL_FRACTION = 0.02
"""Minimum fraction of transparent pixels in a photograph for its alpha to be reported. Seams and corners cover less."""
WIDE_FISHEYE_DEGREES = 100.0
"""Field of view of a fisheye in degrees above which undistortion loses much: the pinhole picture would be too large."""
FEW_TRAINING_VIEWS = 16
"""Number of training photographs below which they hardly constrain the depth of a scene.

According to publications, the PSNR after training on 12 photographs is 8 dB lower than after training on 100, and after
training on 24 it is about 3 dB lower.
"""
SPARSE_TRAINING_VIEWS = 30
"""Number of training photographs below which unlimited growth overfits (docs/quality.md)."""
MAX_GAUSSIANS_PER_POINT, MIN_PIXELS_PER_GAUSSIAN = 12, 64
"""Maximum number of Gaussians per point, and minimum number of pixels per Gaussian, for scenes with few photographs.

A Gaussian has up to 59 parameters. A pixel has three values, and most pixels resemble their neighbours. For 25
photographs of bonsai, results are best with 64 to 85 pixels per Gaussian; for 50 of fox, with 7 Gaussians per point
(docs/quality.md, Few photographs and Growth).
"""
SUPPORTED_GAUSSIANS_PER_POINT = 1.5
"""Minimum of the recommended number of Gaussians, as a multiple of the number of points.

It matters for small photographs, for which MIN_PIXELS_PER_GAUSSIAN allows too few Gaussians: neighbouring pixels differ
more in small photographs, so fewer pixels per Gaussian suffice.
"""
FEW_STEPS_PER_VIEW = 60
"""Steps per training photograph below which high learning rates give better models
(docs/decisions/0031-high-rates.md)."""
SHORT_TRAINING_STEPS = range(1000, 10_001)
"""Numbers of training steps for which high learning rates are recommended. Measurements cover 2000 to 7000 steps."""
RECOMMENDED_PASSES = 30
"""Number of passes through the training photographs below which a longer schedule is recommended. The paper's 30,000
steps are 30 passes through 1000 photographs."""
BLUR_SHARPNESS_RATIO = 0.72
"""Sharpness, relative to the scene's median, below which a photograph counts as blurred.

A blur of 1.5 pixels gives this ratio. The content of a photograph changes the ratio by 0.1 to 0.2.
"""
BLUR_OUTLIER_SIGMAS = 3.5
"""The log sharpness of a blurred photograph must also lie this many standard deviations below the median. The standard
deviation is estimated from quartiles."""
DUPLICATE_RMS = 1.5 / 255
"""Maximum RMS difference of two thumbnails that count as the same picture. JPEG compression causes half of it."""
FEATURELESS_THUMBNAIL_STD = 8 / 255
"""Standard deviation of a thumbnail up to which it is featureless and never counts as a duplicate."""
MIN_SKY_PIXEL_FRACTION, MIN_SKY_VIEW_FRACTION = 0.06, 0.3
"""Minimum fraction of a photograph that its sky covers, and minimum fraction of photographs with a sky, for a finding
about the sky."""
MAX_SKY_POINT_DENSITY_RATIO = 0.1
"""Maximum density of points in a sky, relative to the mean density in the photograph."""
MAX_SKY_PIXEL_STEP, MIN_SKY_LUMA = 0.025, 0.45
"""Maximum luma difference of neighbouring thumbnail pixels in a sky, and minimum luma of a sky."""
MIN_SKY_BLUE_EXCESS = 0.02
"""Minimum of blue minus red in a blue sky. In lamplight, blue minus red is negative for a wall. The luma of a sky that
is not blue must exceed MAX_EXPOSURE_COLOUR."""


@dataclass(frozen=True)
class Finding:
    """A finding about the photographs.

    kind: name of the problem, such as "exposure".
    text: a clause for the report that describes the problem in this scene.
    options: alternative settings that mitigate the problem, best first, if they depend on the scene. If the
        settings are the same in all scenes, they are in `recommendations.SETTINGS_BY_FINDING` instead.
    """

    kind: Kind
    text: str
    options: Sequence[Mapping[str, Any]] = ()


def findings(scene: Scene, use: MaskUse = NO_MASKS, iterations: int = 0) -> list[Finding]:
    """Run all checks on a scene. Returns the problems found.

    use: the meanings of masks and alpha channels in training.
    iterations: planned number of training steps, 0 if unknown.
    Raises InputError if a picture does not decode.
    """
    visible = VisiblePoints(scene)
    found = (
        _few(scene),
        _some(scene, iterations),
        _few_steps(scene, iterations),
        _few_passes(scene, iterations),
        _exposure(visible),
        _scales(visible),
        _masks(scene, use),
        _alpha(scene, use),
        _undistorted(scene),
        _sky(visible),
        _blur(scene),
        _duplicates(scene),
    )
    return [each for each in found if each is not None]


def _sampled_training_views(scene: Scene) -> list[View]:
    """Return the training views among `Scene.sampled_views`, which are the views with thumbnails."""
    return [view for view in scene.sampled_views if view.split == "train"]


def _counted(scene: Scene, count: int) -> str:
    """Return a number of photographs as text, such as "3", or "3 of 200 sampled" if only a sample was inspected."""
    return f"{count:,}" if scene.decoded_first else f"{count:,} of {len(scene.sampled_views):,} sampled"


def _exposure(visible: VisiblePoints) -> Finding | None:
    gains = visible.gains
    if len(gains) < 3:
        return None
    values = np.array(list(gains.values()))
    spread = float(values.std(axis=0).max())
    if spread < EXPOSURE_SPREAD_STOPS:
        return None
    grey = values @ REC601_LUMA.astype(np.float64)
    low, high = (list(gains)[index] for index in (grey.argmin(), grey.argmax()))
    return Finding(
        "exposure",
        f"exposures or colours have a standard deviation of {spread:.2f} stops, and {low} and {high} differ by "
        f"{np.ptp(grey):.1f} stops",
    )


def _scales(visible: VisiblePoints) -> Finding | None:
    distances = []
    for view in visible.scene.train_views:
        _, _, _, depths = visible.places.get(view.name, (0, 0, 0, np.empty(0)))
        if len(depths) >= MIN_POINTS_PER_VIEW:
            distances.append(float(np.median(depths)) / view.camera.fx * view.camera.width)
    if len(distances) < 3:
        return None
    near, far = np.quantile(distances, (0.1, 0.9))
    if far < DISTANCE_SPREAD_RATIO * near:
        return None
    return Finding("scales", f"distances to the subject differ by a factor of {far / near:.0f} between photographs")


def _masks(scene: Scene, use: MaskUse) -> Finding | None:
    if use.masks != "none":
        return None
    try:
        found = masks_beside(scene.views)
        some = sorted(found)[:: max(len(found) // SAMPLED_MASKS, 1)]
        masks = [read_mask(found[name], orient=False, invert=False)[:, :, 0] for name in some]
    except InputError as error:
        return _strange_masks(scene, str(error).partition("; ")[0])
    if not masks:
        return None
    kept = [(mask.mean(), np.concatenate([mask[0], mask[-1], mask[:, 0], mask[:, -1]]).mean()) for mask in masks]
    inside, border = np.mean(kept, axis=0)
    text = f"{len(found):,} of {len(scene.views):,} photographs have masks, which are not used"
    if border <= 1 - CUT_OUT_BORDER_FRACTION and inside < 0.5:
        return Finding(
            "cut out", f"{text}; they cut out an object that covers {100 * inside:.0f} % of a picture on average"
        )
    return Finding("masks", f"{text}; they leave out {100 - 100 * inside:.0f} % of the pixels on average")


def _strange_masks(scene: Scene, reason: str) -> Finding | None:
    """Return a finding about masks that cannot be used; None if no mask file matches a photograph.

    reason: why the masks cannot be used.
    """
    try:
        count = len(masks_beside(scene.views, strict=False))
    except InputError:
        return None
    if not count:
        return None
    text = f"{count:,} of {len(scene.views):,} photographs have masks, which cannot be used ({reason})"
    return Finding("strange masks", text)


def _alpha(scene: Scene, use: MaskUse) -> Finding | None:
    if use.alpha != "blend":
        return None
    shares = np.array([scene.thumbnails[view.name].transparent for view in _sampled_training_views(scene)])
    if (shares >= TRANSPARENT_PIXEL_FRACTION).mean() < 0.5:
        return None
    part = f"{100 * shares.mean():.0f} %"
    return Finding("alpha", f"{part} of the photographs' area is transparent and shows the background")


def _undistorted(scene: Scene) -> Finding | None:
    wide = [
        (2 * np.degrees(view.lens.width / 2 / view.lens.params[0]), view)
        for view in scene.train_views
        if view.lens.native is not None and view.camera.is_pinhole
    ]
    if not wide or (most := max(angle for angle, _ in wide)) < WIDE_FISHEYE_DEGREES:
        return None
    return Finding(
        "undistorted",
        f"{len(wide):,} photographs were taken with fisheyes of up to {most:.0f} degrees and are undistorted",
    )


def _few(scene: Scene) -> Finding | None:
    count = len(scene.train_views)
    if count >= FEW_TRAINING_VIEWS:
        return None
    return Finding("few views", f"there are only {count} training photographs, so that other views will show floaters")


def _some(scene: Scene, iterations: int) -> Finding | None:
    count = len(scene.train_views)
    if not FEW_TRAINING_VIEWS <= count < SPARSE_TRAINING_VIEWS:
        return None
    pixels = sum(view.camera.width * view.camera.height for view in scene.train_views)
    points = len(scene.points)
    most = min(pixels // MIN_PIXELS_PER_GAUSSIAN, MAX_GAUSSIANS_PER_POINT * points or pixels)
    most = max(most, int(SUPPORTED_GAUSSIANS_PER_POINT * points), 1)
    why = f"{count} training photographs, with {points:,} points and {pixels / 1e6:.1f} million pixels"
    sparse, bound = {"thinning": 0.2, "penalty": 0.02}, {"density.max_gaussians": most}
    early = {"eval_at": (iterations // 3,)} if scene.test_views and iterations >= 3 else {}  # reveals overfitting
    options = ({**sparse, **bound, **early}, {**sparse, **bound}, sparse, {"thinning": 0.2})
    return Finding("some views", f"{why}, support about {most:,} Gaussians", options)


def _few_steps(scene: Scene, iterations: int) -> Finding | None:
    count = len(scene.train_views)
    if iterations not in SHORT_TRAINING_STEPS or iterations >= FEW_STEPS_PER_VIEW * count:
        return None
    passes = f"{iterations:,} steps pass {iterations / count:.1f} times through the {count:,} training photographs"
    return Finding("few steps", f"{passes}: higher learning rates help")


def _few_passes(scene: Scene, iterations: int) -> Finding | None:
    count = len(scene.train_views)
    if iterations < SHORT_TRAINING_STEPS.stop or iterations >= RECOMMENDED_PASSES * count:
        return None
    text = f"{iterations:,} steps pass {iterations / count:.1f} times through the {count:,} training photographs"
    return Finding("few passes", text, ({"passes": RECOMMENDED_PASSES},))


def _sky(visible: VisiblePoints) -> Finding | None:
    scene = visible.scene
    parts = [_sky_part(visible, view) for view in _sampled_training_views(scene) if view.name in visible.places]
    with_sky = [part for part in parts if part >= MIN_SKY_PIXEL_FRACTION]
    if len(with_sky) < max(3, MIN_SKY_VIEW_FRACTION * len(parts)) or not len(scene.points):
        return None
    many, area = _counted(scene, len(with_sky)), 100 * np.mean(with_sky)
    return Finding("sky", f"{many} photographs have a sky without points, which covers {area:.0f} % of their area")


def _sky_part(visible: VisiblePoints, view: View) -> float:
    """Return the fraction of a view's pixels that show sky.

    Sky is a bright, smooth, blue or white region at the upper border, above the horizon, with hardly any points.
    """
    pixels = visible.scene.thumbnails[view.name].pixels
    up = visible.up @ view.camera.rotation.T
    turns = int(np.round(np.arctan2(up[0], -up[1]) / (np.pi / 2))) % 4  # quarter turns that make the picture upright
    upright = np.rot90(pixels, turns)
    light = upright @ REC601_LUMA
    steps = np.zeros(light.shape)
    steps[1:] = np.abs(np.diff(light, axis=0))
    steps[:, 1:] = np.maximum(steps[:, 1:], np.abs(np.diff(light, axis=1)))
    blue = upright[:, :, 2] - upright[:, :, 0]
    likely = (
        (light > MIN_SKY_LUMA)
        & (steps < MAX_SKY_PIXEL_STEP)
        & ((blue > MIN_SKY_BLUE_EXCESS) | (light > MAX_EXPOSURE_COLOUR))
    )
    reached = np.logical_and.accumulate(likely, axis=0)  # in each column, sky ends at the first pixel unlike sky
    part = float(reached.mean())
    if part < MIN_SKY_PIXEL_FRACTION or not likely[0].mean() > 0.5:
        return 0.0
    _, rows, columns, _ = visible.places[view.name]
    held = np.rot90(reached, -turns)[rows, columns].mean() if len(rows) else 1.0
    if held > MAX_SKY_POINT_DENSITY_RATIO * part or _elevation(view, np.rot90(reached, -turns), visible.up) < 0:
        return 0.0
    return part


def _elevation(view: View, part: NDArray[np.bool_], up: Float64) -> float:
    """Return the sine of the elevation above the horizon of the centroid of `part`, a mask (h, w) of the view.

    up: (3,), the world's up direction.
    """
    rows, columns = np.nonzero(part)
    camera = view.camera.resized(part.shape[1], part.shape[0])
    x, y = (columns.mean() + 0.5 - camera.cx) / camera.fx, (rows.mean() + 0.5 - camera.cy) / camera.fy
    ray = np.array([x, y, 1.0]) @ camera.rotation
    return float(ray @ up / np.linalg.norm(ray))


def _blur(scene: Scene) -> Finding | None:
    names = [view.name for view in _sampled_training_views(scene)]
    logs = np.log([max(scene.thumbnails[name].sharpness, 1e-6) for name in names])
    if len(names) < 5:
        return None
    low, middle, high = np.quantile(logs, (0.25, 0.5, 0.75))
    limit = min(middle + np.log(BLUR_SHARPNESS_RATIO), middle - BLUR_OUTLIER_SIGMAS * (high - low) / 1.349)
    blurred = [name for name, value in zip(names, logs, strict=True) if value < limit]
    if not blurred:
        return None
    return Finding(
        "blur", f"{_counted(scene, len(blurred))} photographs are more blurred than the others ({examples(blurred)})"
    )


def _duplicates(scene: Scene) -> Finding | None:
    """Return a finding about photographs with nearly identical thumbnails; None if there are none."""
    by_size: dict[tuple[int, ...], list[str]] = {}
    for view in scene.sampled_views:
        by_size.setdefault(scene.thumbnails[view.name].pixels.shape, []).append(view.name)
    copies = []
    for names in by_size.values():
        flat = np.array([scene.thumbnails[name].pixels[::4, ::4].ravel() for name in names], np.float64)
        squares = (flat * flat).sum(axis=1)
        apart = (squares[:, None] + squares - 2 * flat @ flat.T) / flat.shape[1]
        for one, other in np.argwhere(np.triu(apart <= 4 * DUPLICATE_RMS * DUPLICATE_RMS, 1)):
            a, b = (scene.thumbnails[names[index]].pixels for index in (one, other))
            if (
                a.std(axis=(0, 1)).max() > FEATURELESS_THUMBNAIL_STD
                and float(np.square(a - b).mean()) <= DUPLICATE_RMS * DUPLICATE_RMS
            ):
                copies.append(f"{names[other]} is {names[one]}")
    if not copies:
        return None
    return Finding("duplicates", f"{_counted(scene, len(copies))} photographs are duplicates ({examples(copies)})")
