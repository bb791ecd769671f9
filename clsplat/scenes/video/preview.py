# SPDX-License-Identifier: Apache-2.0
"""Report on a video before its frames are used: how sharp, bright and fast the capture was, with advice."""

from __future__ import annotations

from dataclasses import dataclass
from itertools import pairwise

import numpy as np

from clsplat.arrays import Float64
from clsplat.progress import duration
from clsplat.scenes.video.choice import SMOOTH_SHARPNESS, Choice, rates
from clsplat.scenes.video.motion import Measurements
from clsplat.scenes.video.reading import VideoFacts

MAX_FAST_FRACTION = 0.1
"""Largest fraction of fast frames for which no advice is given."""
DARK_LUMA = 0.15
"""Median of the frames' mean luma, in [0, 1], below which a video is too dark."""
SOFT_DETAIL = 0.05
"""Detail below which a video is soft: the median sharpness of the chosen frames minus SMOOTH_SHARPNESS."""
MIN_PARALLAX = 0.06
"""Parallax (`parallax_of`) below which a camera only turns, and its place hardly changes.

In the demo's scene, a camera that turns on the spot has 0.04, and one that flies over the flat floor 0.07. One that
walks sideways or around the scene has 0.45 to 0.8.
"""
MIN_TRAVELLED = 0.1
"""Length of the camera's path, in longer sides, below which a video hardly shows different viewpoints. A walk of 60
degrees around the demo's scene has 0.2."""
ASSUMED_FOCAL = 0.8
"""Focal length in longer sides, as of a phone, that `rotation_field` assumes."""


@dataclass(frozen=True)
class Preview:
    """Report on a video. text: one line of facts. advice: lines on how to capture better; empty for a good video."""

    text: str
    advice: tuple[str, ...]


def preview(facts: VideoFacts, measured: Measurements, choice: Choice) -> Preview:
    """Report on a video and the choice of its frames."""
    rate = rates(measured)[~choice.fast]
    speed = float(np.median(rate)) if len(rate) else 0.0
    detail = float(np.median(measured.sharpness[choice.frames])) - SMOOTH_SHARPNESS if len(choice.frames) else 0.0
    less = len(choice.frames) < choice.wanted
    instead = f", instead of {choice.wanted:,}, as others are alike, blurred or too fast," if less else ""
    text = (
        f"{len(choice.frames):,} of {len(measured):,} frames chosen{instead} from {duration(measured.seconds[-1])} of "
        f"{facts.width}x{facts.height} {facts.coding.label}; detail {detail:.2f} (soft below {SOFT_DETAIL:g}), motion "
        f"{100 * speed:.0f} % of the frame per second, too fast in {100 * choice.fast.mean():.0f} % of the frames"
    )
    return Preview(text, tuple(_advice(measured, choice, detail)))


def _advice(measured: Measurements, choice: Choice, detail: float) -> list[str]:
    advice = []
    if choice.fast.mean() > MAX_FAST_FRACTION:
        share = 100 * choice.fast.mean()
        advice.append(f"the camera is too fast in {share:.0f} % of the frames, which are left out; turn slower")
    if float(np.median(measured.brightness)) < DARK_LUMA:
        level = 100 * float(np.median(measured.brightness))
        advice.append(f"the picture is too dark ({level:.0f} % of white); use more light, or a longer exposure at rest")
    if detail < SOFT_DETAIL:
        advice.append("the frames are not sharp; move slower, clean the lens, or lock the focus")
    if choice.travelled < MIN_TRAVELLED:
        advice.append(
            f"the camera hardly moves ({100 * choice.travelled:.0f} % of the frame's longer side in all); walk around "
            "the scene"
        )
    elif (parallax := parallax_of(measured, choice)) < MIN_PARALLAX:
        advice.append(
            f"there is too little parallax ({100 * parallax:.0f} % of the motion): the camera turns but hardly moves; "
            "walk sideways, and look at the scene from several places"
        )
    return advice


def parallax_of(measured: Measurements, choice: Choice) -> float:
    """Return the fraction of the motion that no turn of the camera explains, from 0 for a tripod to 1.

    The motion between chosen frames is fitted with the flow field of a rotation (Longuet-Higgins and Prazdny 1980).
    """
    field = rotation_field(measured.places)
    ends = choice.frames
    left, whole = 0.0, 0.0
    for start, stop in pairwise(ends):
        if choice.fast[start + 1 : stop + 1].any():
            continue
        flow = measured.flow[start + 1 : stop + 1]
        matched = np.isfinite(flow[:, :, 0]).all(axis=0)
        if matched.sum() < 4:
            continue
        moved = flow[:, matched].sum(axis=0).ravel()
        rows = field[matched].reshape(-1, 3)
        rest = moved - rows @ np.linalg.lstsq(rows, moved, rcond=None)[0]
        left, whole = left + float(np.linalg.norm(rest)), whole + float(np.linalg.norm(moved))
    return left / whole if whole > 0 else 0.0


def rotation_field(places: Float64) -> Float64:
    """Return the motion x, y at each place (B, 2, 3) for a small rotation about each of the camera's axes x, y and z.

    places: (B, 2), in longer sides from the frame's centre. The motion is in longer sides per radian.
    """
    x, y, focal = places[:, 0], places[:, 1], ASSUMED_FOCAL
    across = np.stack([x * y / focal, -(focal + x**2 / focal), y], axis=-1)
    down = np.stack([focal + y**2 / focal, -x * y / focal, -x], axis=-1)
    return np.stack([across, down], axis=1)
