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
circles a still life and keeps it in the middle of the picture then gives some 60 frames."""
MIN_FRAMES_PER_SECOND = 1.0
"""Smallest number of frames chosen for each second of a moving camera, if the number of frames is not given."""
MAX_DEFAULT_FRAMES = 300
"""Largest number of frames if it is not given."""
MOTION_STEP = 0.01
"""Motion, in longer sides, that counts as one step of the camera. Smaller movements back and forth, as of a hand
that holds the camera still, do not add up."""
FAST_SIDES_PER_SECOND = 0.6
"""Motion in longer sides per second up to which a camera is never too fast. A turn of 90 degrees per second of a phone
has about 1.4."""
FAST_RATIO = 3.0
"""A camera is too fast if its motion is above this multiple of its median while it moves, and above
FAST_SIDES_PER_SECOND."""
MAX_STRETCHES_PER_FRAME = 4
"""Largest number of stretches of equal motion for each frame that is asked for, where some have no usable frame."""
BLURRED_RATIO = 0.6
"""A frame is blurred if its detail (sharpness minus SMOOTH_SHARPNESS) is below this fraction of the upper quartile of
its neighbours' detail."""
LESS_SHARP_RATIO = 0.9
"""A frame is blurred too if its detail is below this fraction of the upper quartile of the neighbours before it, and of
those after it. Where detail only rises or falls, because of what the camera sees, one of the two is no larger."""
NEIGHBOUR_SECONDS = 1.0
"""A frame's neighbours are the frames up to this many seconds before and after it."""
MAX_ALIKE_RMS_LEVELS, MAX_ALIKE_RMS_PER_GRADIENT = 1.0, 0.2
"""Largest RMS difference of the thumbnails of two frames that are alike: in 255ths, or as a multiple of the RMS
difference of neighbouring pixels. The larger limit applies. A shift by 1/480 of the longer side reaches the second."""
SMOOTH_SHARPNESS = 0.25
"""`thumbnail.sharpness_of` of a smooth picture, as of a lens out of focus."""


@dataclass(frozen=True, eq=False)
class Choice:
    """The chosen frames of a video. F: frames of the video, N: chosen frames, at most one of each stretch (`choose`).

    frames: (N,), indices of the chosen frames in display order.
    stretches: (F,), number of the stretch that each frame is in, -1 for fast frames.
    fast: (F,), True for frames during which the camera is too fast.
    blurred: (F,), True for frames that are blurred against their neighbours.
    travelled: length of the camera's path in longer sides, without fast frames.
    wanted: number of frames that was asked for, or that follows from the video's length and motion.
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
    frame. If at most `count` frames are usable, each frame is a stretch. The sharpest frame of each stretch is chosen,
    or the sharpest in the stretch's middle half if it is sharper than the stretch's median. Fast, blurred and damaged
    frames are not usable. Where a stretch has no usable frame, there are more and shorter stretches, up to
    MAX_STRETCHES_PER_FRAME for each frame, so that the number of frames comes as near to `count` as it can without
    exceeding it. Of two alike frames in a row, the less sharp one is left out.
    """
    fast, blurred = fast_frames(measured), blurred_frames(measured)
    path = travelled(measured, fast)
    total = float(path[-1])
    wanted = count if count is not None else default_count(total, measured.seconds[-1], len(measured))
    usable = measured.whole & ~fast & ~blurred

    def divided(number: int) -> Choice:
        """The choice of a frame of each of `number` stretches, or of each frame as a stretch if few are usable."""
        if wanted >= usable.sum():
            stretches = np.arange(len(measured))
        else:
            stretches = np.minimum((path / max(total, 1e-9) * number).astype(np.int64), number - 1)
        stretches[fast] = -1
        parts = (np.flatnonzero(stretches == part) for part in np.unique(stretches[~fast]))
        best = (_sharpest(measured.sharpness, path, part, usable) for part in parts)
        kept = unlike([frame for frame in best if frame is not None], measured)
        return Choice(np.array(kept, np.int64), stretches, fast, blurred, total, wanted)

    fewest, most = wanted, MAX_STRETCHES_PER_FRAME * wanted
    choice = divided(fewest)
    while most - fewest > 1 and len(choice.frames) < wanted < usable.sum():
        middle = (fewest + most) // 2
        tried = divided(middle)
        if len(tried.frames) <= wanted:
            fewest, choice = middle, tried
        else:
            most = middle
    return choice


def default_count(total: float, seconds: float, frames: int) -> int:
    """Return the number of frames to choose from a video.

    total: length of the camera's path in longer sides.
    seconds, frames: length of the video.
    """
    by_motion = min(max(total / MOTION_PER_FRAME, seconds * MIN_FRAMES_PER_SECOND), MAX_DEFAULT_FRAMES)
    return int(max(1, min(round(by_motion), frames)))


def rates(measured: Measurements) -> Float64:
    """Return the motion (F,) before or after each frame, whichever is larger, in longer sides per second.

    It is infinite where the blocks of two frames do not match.
    """
    lengths = np.maximum(np.diff(measured.seconds, prepend=measured.seconds[0] - 1), 1e-3)
    rate = measured.motion / lengths
    rate[measured.motion >= LOST_MOTION] = np.inf
    return np.asarray(np.maximum(rate, np.append(rate[1:], 0.0)))


def fast_frames(measured: Measurements) -> NDArray[np.bool_]:
    """Return a mask (F,) of the frames during which the camera is too fast."""
    rate = rates(measured)
    moving = rate[np.isfinite(rate) & (rate > MOTION_STEP)]
    usual = float(np.median(moving)) if len(moving) else 0.0
    return np.asarray(rate > max(FAST_SIDES_PER_SECOND, FAST_RATIO * usual))


def blurred_frames(measured: Measurements) -> NDArray[np.bool_]:
    """Return a mask (F,) of the frames that are much less sharp than those within NEIGHBOUR_SECONDS."""
    detail, at = measured.sharpness - SMOOTH_SHARPNESS, measured.seconds

    def usual(begin: Float64, end: Float64) -> Float64:
        """Upper quartile (F,) of the detail of the frames between two times (F,); 0 if there are none."""
        first, last = np.searchsorted(at, begin), np.searchsorted(at, end, side="right")
        parts = (detail[low:high] for low, high in zip(first, last, strict=True))
        return np.array([np.quantile(part, 0.75) if len(part) else 0.0 for part in parts])

    around = usual(at - NEIGHBOUR_SECONDS, at + NEIGHBOUR_SECONDS)
    before, after = (
        usual(at - NEIGHBOUR_SECONDS, np.nextafter(at, -np.inf)),
        usual(np.nextafter(at, np.inf), at + NEIGHBOUR_SECONDS),
    )
    return np.asarray(detail < np.maximum(BLURRED_RATIO * around, LESS_SHARP_RATIO * np.minimum(before, after)))


def travelled(measured: Measurements, fast: NDArray[np.bool_]) -> Float64:
    """Return the length (F,) of the camera's path up to each frame, in longer sides, without fast frames.

    The path has steps of at least MOTION_STEP: each block's motion vectors are summed, until the mean length of the
    blocks' sums reaches MOTION_STEP. Movements back and forth within a step lengthen the path only once.

    fast: (F,), mask of the fast frames.
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
    """Return the index of the frame to choose from a stretch, as `choose` describes; None if no frame is usable.

    sharpness, path, usable: (F,), of all frames; path is the result of `travelled`.
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
    """Return the indices of the chosen frames, with only the sharper of two alike frames in a row."""
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
