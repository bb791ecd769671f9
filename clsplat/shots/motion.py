# SPDX-License-Identifier: Apache-2.0
"""Cameras of a shot around a frame's own: the next frame's, and those of the shutter's time."""

from __future__ import annotations

from bisect import bisect_left, bisect_right
from collections.abc import Callable, Iterable
from dataclasses import dataclass, replace
from functools import cached_property
from math import ceil
from typing import Any

import numpy as np

from clsplat.arrays import Float64
from clsplat.camera import Camera
from clsplat.errors import InputError
from clsplat.shots import Frame, Shot

AROUND = 2
"""Frames on each side of a time that say where the camera is then: a segment's end, and what its tangent looks at."""


_SCALARS = ("fx", "fy", "cx", "cy", "near", "far")


@dataclass(frozen=True, eq=False)
class Moments:
    """Cameras of a frame, each at a time when it is looked at, taken from the source: for processes without it.

    first: the camera at the first time; times (T,): in frames from the frame, rising; values (T, 18): what differs from
    time to time, `_SCALARS`, rotation and translation.
    """

    first: Camera
    times: Float64
    values: Float64

    @classmethod
    def of(cls, moment: Callable[[float], Camera], times: Iterable[float]) -> Moments:
        """The camera at each of the times. Raises InputError where they are of several projections."""
        rising = np.unique(np.array(list(times), np.float64))
        cameras = [moment(float(time)) for time in rising]
        for time, camera in zip(rising, cameras, strict=True):
            if camera.projection != cameras[0].projection:
                raise InputError(
                    f"an open shutter: the camera is {cameras[0].projection} {rising[0]:g} frames from the frame and "
                    f"{camera.projection} {time:g} frames from it, expected one camera"
                )
        return cls(cameras[0], rising, np.array([_values(camera) for camera in cameras]))

    @cached_property
    def _rows(self) -> dict[float, int]:
        return {float(time): row for row, time in enumerate(self.times)}

    def at(self, time: float) -> Camera:
        """The camera at one of the times. Raises KeyError for another."""
        values = self.values[self._rows[time]]
        scalars: dict[str, Any] = dict(zip(_SCALARS, values[:6].tolist(), strict=True))
        return replace(self.first, **scalars, rotation=values[6:15].reshape(3, 3), translation=values[15:])


def _values(camera: Camera) -> Float64:
    return np.concatenate([[getattr(camera, name) for name in _SCALARS], camera.rotation.ravel(), camera.translation])


def moments(shot: Shot, resize: Callable[[Camera], Camera], number: int, times: Iterable[float]) -> Moments:
    """The cameras of a shot that has one for each moment, at those times in frames from the frame of that number, and
    at the times between the first and the last of them that the source has values for."""
    assert shot.moment is not None
    moment, wanted = shot.moment, list(times)
    begin = bisect_left(shot.authored, number + min(wanted))
    end = bisect_right(shot.authored, number + max(wanted))
    wanted += [time - number for time in shot.authored[begin:end]]
    return Moments.of(lambda time: resize(moment(number + time)), wanted)


def camera_after(shot: Shot, index: int) -> Camera:
    """The shot's camera one frame number after its frame of this index.

    After the last it goes on as it did from the one before: the same rigid motion once more, so that a turntable turns
    on. A single frame stays where it is.
    """
    frame = shot.frames[index]
    if index + 1 < len(shot.frames):
        following = shot.frames[index + 1]
        return following.camera if following.number == frame.number + 1 else shot.at(frame.number + 1)
    if index == 0:
        return frame.camera
    return continued(camera_before(shot, index), frame.camera)


def camera_before(shot: Shot, index: int) -> Camera:
    """The shot's camera one frame number before its frame of this index.

    Before the first it goes back as it goes on after it: the same rigid motion the other way, as `camera_after`.
    """
    frame = shot.frames[index]
    if index > 0:
        before = shot.frames[index - 1]
        return before.camera if before.number == frame.number - 1 else shot.at(frame.number - 1)
    return frame.camera if len(shot.frames) == 1 else continued(camera_after(shot, 0), frame.camera)


def continued(earlier: Camera, now: Camera) -> Camera:
    """The rigid motion from one to the other once more."""
    turn = now.rotation @ earlier.rotation.T
    shift = now.translation - turn @ earlier.translation
    return replace(now, rotation=turn @ now.rotation, translation=turn @ now.translation + shift)


def stretches(
    shot: Shot,
    resize: Callable[[Camera], Camera],
    opens: float,
    closes: float,
    *,
    motion: bool = False,
    backward: bool = False,
) -> Callable[[int], Shot | None]:
    """The part of the shot that a frame's shutter looks at, by the frame's number, from which its own numbers count;
    None where nothing can move. opens, closes: frames from the frame; motion, backward: with the middle of the shutter
    of the next frame, and of the frame before.

    Before its first frame and after its last the shot goes on as it does there, as for motion. Raises InputError where
    the frames' pictures have several sizes or projections, which is no camera that moves.
    """
    middle = 0.5 * (opens + closes)
    opens = min(opens, middle - 1) if backward else opens
    closes = max(closes, middle + 1) if motion else closes
    frames = [(frame.number, resize(frame.camera)) for frame in shot.frames]
    if len(frames) == 1:
        return lambda number: None
    for (number, camera), (earlier, before) in zip(frames[1:], frames, strict=False):
        kinds = [f"{shown.width}x{shown.height} {shown.projection}" for shown in (before, camera)]
        if kinds[0] != kinds[1]:
            raise InputError(
                f"an open shutter: frame {earlier} is {kinds[0]} and frame {number} {kinds[1]}, expected one camera"
            )
    first, second = frames[0][1], resize(camera_after(shot, 0))
    for _ in range(ceil(max(-opens, 0)) + AROUND):
        first, second = continued(second, first), first
        frames.insert(0, (frames[0][0] - 1, first))
    last, following = frames[-1][1], resize(camera_after(shot, len(shot.frames) - 1))
    for _ in range(ceil(max(closes, 0)) + AROUND):
        frames.append((frames[-1][0] + 1, following))
        last, following = following, continued(last, following)
    numbers = [number for number, _ in frames]

    def stretch(number: int) -> Shot:
        begin = max(bisect_right(numbers, number + min(opens, 0)) - AROUND, 0)
        end = bisect_left(numbers, number + max(closes, 0)) + AROUND
        return Shot(tuple(Frame(at - number, camera, f"{at:04d}") for at, camera in frames[begin:end]))

    return stretch
