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
"""Largest number of stretches of equal motion, as a multiple of the number of frames that are asked for."""
BLURRED_RATIO = 0.6
"""A frame is blurred if its detail (sharpness minus SMOOTH_SHARPNESS) is below this fraction of the upper quartile of
its neighbours' detail."""
SHAKEN_RATIO = 0.9
"""A frame is shaken if its detail is below this fraction of the upper quartile of its earlier neighbours' detail, and
of its later neighbours'."""
MIN_NEIGHBOURS = 4
"""Least number of neighbours before a frame, and after it, with which it is compared for shake."""
MAX_GAP_STRETCHES = 3.0
"""A part of the camera's path that is longer than this many stretches gets a shaken frame if it has no other."""
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
    frame. If no more frames than that are usable, each is a stretch. The sharpest frame of each stretch is chosen, or
    the sharpest in its middle half if it is sharper than the stretch's median. Fast, blurred, shaken and damaged frames
    are not usable, but a part of the path that is longer than MAX_GAP_STRETCHES gets a shaken frame if it has no other.
    If stretches have no usable frame, the path is divided into more, up to MAX_STRETCHES_PER_FRAME times as many, so
    that the number of frames comes near to `count`. Of two alike frames in a row, the less sharp one is left out.
    """
    fast, blurred = fast_frames(measured), blurred_frames(measured)
    path = travelled(measured, fast)
    total = float(path[-1])
    wanted = count if count is not None else default_count(total, measured.seconds[-1], len(measured))
    able = measured.whole & ~fast & ~blurred
    usable = able & ~shaken_frames(measured)

    def divided(number: int | None) -> Choice:
        """The choice of a frame of each of `number` stretches. None: each frame is a stretch."""
        if number is None:
            stretches = np.arange(len(measured))
        else:
            stretches = np.minimum((path / max(total, 1e-9) * number).astype(np.int64), number - 1)
        stretches[fast] = -1
        chosen, last = list[int](), 0.0
        for inside in _parts(stretches):
            best = _sharpest(measured.sharpness, path, inside, usable)
            if best is None and (path[inside[-1]] - last) * wanted > MAX_GAP_STRETCHES * total:
                since = np.arange(chosen[-1] + 1 if chosen else 0, inside[-1] + 1)
                best = _sharpest(measured.sharpness, path, since, able)
            if best is not None:
                chosen.append(best)
                last = float(path[best])
        return Choice(np.array(unlike(chosen, measured), np.int64), stretches, fast, blurred, total, wanted)

    if usable.sum() <= wanted and len((choice := divided(None)).frames) <= wanted:
        return choice
    fewest, most = wanted, MAX_STRETCHES_PER_FRAME * wanted + 1
    choice = divided(fewest)
    while most - fewest > 1 and len(choice.frames) < wanted:
        middle = (fewest + most) // 2
        tried = divided(middle)
        if len(tried.frames) <= wanted:
            fewest = middle
            choice = max(choice, tried, key=lambda each: len(each.frames))
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
    """Return a mask (F,) of the frames that are much less sharp than their neighbours."""
    detail, first, last = _neighbourhoods(measured)
    parts = (detail[low:high][measured.whole[low:high]] for low, high in zip(first, last, strict=True))
    around = np.array([np.quantile(part, 0.75) if len(part) else 0.0 for part in parts])
    return np.asarray(detail < around - (1 - BLURRED_RATIO) * np.abs(around))


def shaken_frames(measured: Measurements) -> NDArray[np.bool_]:
    """Return a mask (F,) of the frames that are less sharp than their neighbours before and after them.

    Where detail rises or falls because the view changes, the neighbours on one side have no more than the frame.
    Damaged frames are no neighbours. Frames with fewer than MIN_NEIGHBOURS on a side are not in the mask.
    """
    detail, first, last = _neighbourhoods(measured)

    def usual(low: int, high: int) -> float:
        """Upper quartile of the detail of frames [low, high); -infinity if they are too few."""
        part = detail[low:high][measured.whole[low:high]]
        return float(np.quantile(part, 0.75)) if len(part) >= MIN_NEIGHBOURS else -np.inf

    sides = enumerate(zip(first, last, strict=True))
    both = np.array([min(usual(low, index), usual(index + 1, high)) for index, (low, high) in sides])
    return np.asarray(detail < both - (1 - SHAKEN_RATIO) * np.abs(both))


def _neighbourhoods(measured: Measurements) -> tuple[Float64, NDArray[np.int64], NDArray[np.int64]]:
    """Return each frame's detail (F,), and the first and the end index (F,) of its neighbours and itself."""
    at = measured.seconds
    first = np.searchsorted(at, at - NEIGHBOUR_SECONDS)
    return measured.sharpness - SMOOTH_SHARPNESS, first, np.searchsorted(at, at + NEIGHBOUR_SECONDS, side="right")


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


def _parts(stretches: NDArray[np.int64]) -> list[NDArray[np.int64]]:
    """Return the indices of the frames of each stretch, given its number (F,). Negative numbers are left out."""
    order = np.argsort(stretches, kind="stable")
    order = order[stretches[order] >= 0]
    return np.split(order, np.flatnonzero(np.diff(stretches[order])) + 1) if len(order) else []


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
