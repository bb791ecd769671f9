# SPDX-License-Identifier: Apache-2.0
"""Choice of a video's frames: the sharpest of each stretch of equal motion, none of a fast turn, and no two alike."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from clsplat.arrays import Float64
from clsplat.scenes.video.motion import LOST_MOTION, Measurements

MOTION_PER_FRAME = 0.025
"""Motion between two chosen frames, in longer sides, if the number of frames is not given. A camera that
circles a still life then gives some 60 frames, as the middle of the scene stays in the middle."""
MIN_FRAMES_PER_SECOND = 1.0
"""Smallest number of frames chosen for each second of a moving camera, if the number of frames is not given."""
MAX_DEFAULT_FRAMES = 300
"""Largest number of frames if it is not given."""
MOTION_STEP = 0.01
"""Motion, in longer sides, that counts as one step of the camera. Smaller movements there and back, of a hand that
holds the camera still, add up to nothing."""
FAST_SIDES_PER_SECOND = 0.6
"""Motion in longer sides per second up to which a camera is never too fast. A turn of 90 degrees per second of a phone
has about 1.4."""
FAST_RATIO = 3.0
"""Ratio to the median motion of the moving camera, above which a camera is too fast."""
BLURRED_RATIO = 0.6
"""A frame is blurred if its sharpness, above that of a smooth picture, is less than this part of its neighbours'."""
NEIGHBOUR_SECONDS = 1.0
"""Seconds before and after a frame within which its neighbours are compared with it."""
MAX_ALIKE_RMS_LEVELS, MAX_ALIKE_RMS_PER_GRADIENT = 1.0, 0.2
"""Largest RMS difference of the thumbnails of two frames that are alike: in 255ths, or as a multiple of the RMS
difference of neighbouring pixels. The larger limit applies. Its second part is a shift by 1/480 of the frame."""
SMOOTH_SHARPNESS = 0.25
"""`thumbnail.sharpness_of` of a picture without any detail."""


@dataclass(frozen=True, eq=False)
class Choice:
    """The chosen frames of a video. F: frames of the video, N: chosen frames, fewer than stretches if some are alike.

    frames: (N,), indices of the chosen frames in display order.
    stretches: (F,), number of the stretch of each frame, -1 for fast frames.
    fast: (F,), True for frames during which the camera is too fast.
    blurred: (F,), True for frames that are blurred against their neighbours.
    travelled: motion of the usable frames in longer sides.
    wanted: number of frames that was asked for, or that follows from length and motion.
    """

    frames: NDArray[np.int64]
    stretches: NDArray[np.int64]
    fast: NDArray[np.bool_]
    blurred: NDArray[np.bool_]
    travelled: float
    wanted: int


def choose(measured: Measurements, count: int | None = None) -> Choice:
    """Choose frames of a video. count: number of frames; None for a number by length and motion.

    The camera's path is divided into `count` stretches of equal motion, so that a camera that stands still gives one
    frame. If there are no more usable frames than `count`, each is a stretch. The sharpest frame of each stretch is
    chosen. It is looked for in the stretch's middle half, if one there is sharper than the stretch's median. Fast,
    blurred and damaged frames are left out, and of two alike frames in a row the less sharp one.
    """
    fast, blurred = fast_frames(measured), blurred_frames(measured)
    path = travelled(measured, fast)
    total = float(path[-1])
    wanted = count if count is not None else default_count(total, measured.seconds[-1], len(measured))
    usable = measured.whole & ~fast & ~blurred
    if wanted >= usable.sum():
        stretches = np.arange(len(measured))
    else:
        stretches = np.minimum((path / max(total, 1e-9) * wanted).astype(np.int64), wanted - 1)
    stretches[fast] = -1
    chosen = []
    for number in np.unique(stretches[~fast]):
        inside = np.flatnonzero(stretches == number)
        if (best := _sharpest(measured.sharpness, path, inside, usable)) is not None:
            chosen.append(best)
    kept = np.array(unlike(chosen, measured), np.int64)
    return Choice(kept, stretches, fast, blurred, total, wanted)


def default_count(total: float, seconds: float, frames: int) -> int:
    """Return the number of frames for a path of `total` longer sides and a video of some seconds."""
    by_motion = min(max(total / MOTION_PER_FRAME, seconds * MIN_FRAMES_PER_SECOND), MAX_DEFAULT_FRAMES)
    return int(max(1, min(round(by_motion), frames)))


def rates(measured: Measurements) -> Float64:
    """Return the motion (F,) before or after each frame, whichever is larger, in longer sides per second."""
    lengths = np.maximum(np.diff(measured.seconds, prepend=measured.seconds[0] - 1), 1e-3)
    rate = measured.motion / lengths
    rate[measured.motion >= LOST_MOTION] = np.inf
    return np.asarray(np.maximum(rate, np.append(rate[1:], 0.0)))


def fast_frames(measured: Measurements) -> NDArray[np.bool_]:
    """Return True (F,) for frames during which the camera is too fast."""
    rate = rates(measured)
    moving = rate[np.isfinite(rate) & (rate > MOTION_STEP)]
    usual = float(np.median(moving)) if len(moving) else 0.0
    return np.asarray(rate > max(FAST_SIDES_PER_SECOND, FAST_RATIO * usual))


def blurred_frames(measured: Measurements) -> NDArray[np.bool_]:
    """Return True (F,) for frames that are much less sharp than frames within NEIGHBOUR_SECONDS."""
    detail = measured.sharpness - SMOOTH_SHARPNESS
    first = np.searchsorted(measured.seconds, measured.seconds - NEIGHBOUR_SECONDS)
    last = np.searchsorted(measured.seconds, measured.seconds + NEIGHBOUR_SECONDS, side="right")
    around = np.array([np.quantile(detail[low:high], 0.75) for low, high in zip(first, last, strict=True)])
    return np.asarray(detail < BLURRED_RATIO * around)


def travelled(measured: Measurements, fast: NDArray[np.bool_]) -> Float64:
    """Return the length (F,) of the camera's path up to each frame, in longer sides, without fast frames.

    The path has steps of at least MOTION_STEP: the motion of each block is summed as a vector, until the mean length of
    the sums reaches a step. Movements there and back in a step lengthen the path only once.
    """
    path, done, step = np.zeros(len(measured)), 0.0, np.zeros_like(measured.flow[0])
    for index in range(1, len(measured)):
        flow = measured.flow[index]
        matched = np.isfinite(flow[:, 0])
        if not fast[index] and matched.any():
            step = step + np.where(matched[:, None], flow, flow[matched].mean(axis=0))
            length = float(np.linalg.norm(step, axis=1).mean())
            path[index] = max(path[index - 1], done + length)
            if length >= MOTION_STEP:
                done, step = done + length, np.zeros_like(step)
        else:
            path[index] = path[index - 1]
    return path


def _sharpest(sharpness: Float64, path: Float64, inside: NDArray[np.int64], usable: NDArray[np.bool_]) -> int | None:
    """Return the usable frame of a stretch to choose, None if there is none.

    inside: indices of the stretch's frames.
    """
    able = inside[usable[inside]]
    if not len(able):
        return None
    best = int(able[sharpness[able].argmax()])
    low, high = path[inside[0]], path[inside[-1]]
    middle = able[np.abs(path[able] - (low + high) / 2) <= (high - low) / 4]
    if not len(middle):
        return best
    central = int(middle[sharpness[middle].argmax()])
    good = sharpness[central] > np.median(sharpness[inside]) or sharpness[central] == sharpness[best]
    return central if good else best


def unlike(chosen: list[int], measured: Measurements) -> list[int]:
    """Return the chosen frames without those that look like the one before; of two alike ones the sharper is kept."""
    kept: list[int] = []
    for index in chosen:
        if kept and alike(measured.thumbnails[kept[-1]], measured.thumbnails[index]):
            if measured.sharpness[index] > measured.sharpness[kept[-1]]:
                kept[-1] = index
            continue
        kept.append(index)
    return kept


def alike(first: NDArray[np.uint8], second: NDArray[np.uint8]) -> bool:
    """Return True if two thumbnails show the same picture from the same place."""
    one, other = first.astype(np.float32), second.astype(np.float32)
    slopes = np.concatenate([np.diff(one, axis=axis).ravel() for axis in (0, 1)])
    limit = max(MAX_ALIKE_RMS_LEVELS, MAX_ALIKE_RMS_PER_GRADIENT * float(np.sqrt(np.mean(slopes**2))))
    return float(np.sqrt(np.mean((one - other) ** 2))) <= limit
