# SPDX-License-Identifier: Apache-2.0
"""Cameras for motion vectors (one frame later or earlier) and for motion blur (while the shutter is open).

`SamplingConfig.shutter` in `config/pictures.py` has the time in which the shutter is open.
"""

from __future__ import annotations

from bisect import bisect_left, bisect_right
from collections.abc import Callable, Iterable
from dataclasses import dataclass, replace
from functools import cached_property
from math import ceil

import numpy as np

from clsplat.arrays import Float64
from clsplat.camera import Camera
from clsplat.config.pictures import SamplingConfig
from clsplat.errors import InputError
from clsplat.shots.shot import Frame, Shot

NEIGHBOUR_FRAMES = 2
"""Number of frames on each side of a time that the interpolated camera depends on: a segment's end, and the neighbour
that sets the tangent at this end."""


@dataclass(frozen=True, eq=False)
class Moments:
    """Cameras of one frame at several times, evaluated in advance for processes that cannot read the shot's source.

    first: the camera at the first time.
    times: (T,), in increasing order, in frames relative to the frame.
    values: (T, 18), the quantities that change over time: fx, fy, cx, cy, near, far, rotation (9) and translation (3).
    """

    first: Camera
    times: Float64
    values: Float64

    @classmethod
    def of(cls, moment: Callable[[float], Camera], times: Iterable[float]) -> Moments:
        """Evaluate the camera at each of the times. Raises InputError if the cameras differ in projection."""
        rising = np.unique(np.array(list(times), np.float64))
        cameras = [moment(float(time)) for time in rising]
        for time, camera in zip(rising, cameras, strict=True):
            if camera.projection != cameras[0].projection:
                raise InputError(
                    f"motion blur: the camera is {cameras[0].projection} at {rising[0]:g} frames from the frame, and "
                    f"{camera.projection} at {time:g}, expected one projection while the shutter is open"
                )
        return cls(cameras[0], rising, np.array([_values(camera) for camera in cameras]))

    @cached_property
    def _rows(self) -> dict[float, int]:
        return {float(time): row for row, time in enumerate(self.times)}

    def at(self, time: float) -> Camera:
        """The camera at one of the times. Raises KeyError for any other time."""
        values = self.values[self._rows[time]]
        fx, fy, cx, cy, near, far = values[:6].tolist()
        rotation, translation = values[6:15].reshape(3, 3), values[15:]
        return replace(
            self.first, fx=fx, fy=fy, cx=cx, cy=cy, near=near, far=far, rotation=rotation, translation=translation
        )


def _values(camera: Camera) -> Float64:
    scalars = [camera.fx, camera.fy, camera.cx, camera.cy, camera.near, camera.far]
    return np.concatenate([scalars, camera.rotation.ravel(), camera.translation])


def moments(shot: Shot, resize: Callable[[Camera], Camera], number: int, sampling: SamplingConfig) -> Moments | None:
    """Return the cameras while the shutter of the frame `number` is open.

    Their times are the opening, middle and closing of the shutter, the times of the frame's samples, and the times in
    between at which the shot's source has values. Returns None if the shot has no `moment`, or the shutter is (0, 0).

    resize: function that adapts a camera to the size of the pictures.
    sampling: the times of the shutter and of its samples.
    """
    if shot.moment is None or sampling.shutter == (0.0, 0.0):
        return None
    moment, times = shot.moment, sampling.sample_times if sampling.moves else ()
    wanted = [sampling.middle, *sampling.shutter, *times]
    begin = bisect_left(shot.authored, number + min(wanted))
    end = bisect_right(shot.authored, number + max(wanted))
    wanted += [time - number for time in shot.authored[begin:end]]
    return Moments.of(lambda time: resize(moment(number + time)), wanted)


def targets(
    shot: Shot, resize: Callable[[Camera], Camera], index: int, middle: float, *, motion: bool, backward: bool
) -> tuple[Camera | None, Camera | None]:
    """Return the cameras of the next and the previous frame, to which the motion vectors of a frame point.

    motion: True to return the next frame's camera; otherwise it is None. backward: the same for the previous frame.
    resize: function that adapts a camera to the size of the pictures.
    index: index of the frame in the shot.
    middle: middle of the shutter, in frames relative to the frame. A shot that has `moment` gives the cameras one frame
        after and before this time. Other shots ignore `middle`.
    """
    if shot.moment is not None:
        time = shot.frames[index].number + middle
        after = _beside(shot, resize, time, 1) if motion else None
        return after, _beside(shot, resize, time, -1) if backward else None
    after = resize(camera_after(shot, index)) if motion else None
    return after, resize(camera_before(shot, index)) if backward else None


def _beside(shot: Shot, resize: Callable[[Camera], Camera], time: float, way: int) -> Camera:
    """Return the camera one frame after a time (way 1) or one frame before it (-1), for a shot that has `moment`.

    Outside the shot, where its source has no values, the camera is extrapolated.
    """
    assert shot.moment is not None
    first, last = float(shot.frames[0].number), float(shot.frames[-1].number)
    if shot.reach is not None:
        first, last = min(first, shot.reach[0]), max(last, shot.reach[1])
    if first <= time + way <= last or len(shot.frames) == 1:
        return resize(shot.moment(time + way))
    return continued(resize(shot.moment(time - way)), resize(shot.moment(time)))


def camera_after(shot: Shot, index: int) -> Camera:
    """The shot's camera one frame number after the frame at this index.

    After the last frame, the last rigid motion is repeated, so that a turntable keeps turning. A single frame stays in
    place.
    """
    frame = shot.frames[index]
    if index + 1 < len(shot.frames):
        following = shot.frames[index + 1]
        return following.camera if following.number == frame.number + 1 else shot.at(frame.number + 1)
    if index == 0:
        return frame.camera
    return continued(camera_before(shot, index), frame.camera)


def camera_before(shot: Shot, index: int) -> Camera:
    """The shot's camera one frame number before the frame at this index.

    Before the first frame, the first rigid motion is repeated backwards, as `camera_after` does at the end.
    """
    frame = shot.frames[index]
    if index > 0:
        before = shot.frames[index - 1]
        return before.camera if before.number == frame.number - 1 else shot.at(frame.number - 1)
    return frame.camera if len(shot.frames) == 1 else continued(camera_after(shot, 0), frame.camera)


def continued(earlier: Camera, now: Camera) -> Camera:
    """Repeat a camera's motion: return the camera that follows `now` as `now` follows `earlier`."""
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
    """Return a function that cuts out the part of a shot from which one frame's motion blur is computed.

    The function's argument is the frame's number. Its result is the part of the shot from which the camera is
    interpolated while that frame's shutter is open, numbered relative to the frame. It is None for a shot of one frame,
    which does not move. The shot is extrapolated beyond its ends, as for motion channels.

    resize: function that adapts a camera to the size of the pictures.
    opens, closes: times at which the shutter opens and closes, in frames relative to the frame.
    motion, backward: also cover the middle of the next frame's shutter, or of the previous frame's.
    Raises InputError if the pictures of two consecutive frames differ in size or projection, because no camera can be
    interpolated between them.
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
                f"motion blur: frame {earlier} is {kinds[0]} and frame {number} {kinds[1]}, expected one size "
                "and projection"
            )
    first, second = frames[0][1], resize(camera_after(shot, 0))
    for _ in range(ceil(max(-opens, 0)) + NEIGHBOUR_FRAMES):
        first, second = continued(second, first), first
        frames.insert(0, (frames[0][0] - 1, first))
    last, following = frames[-1][1], resize(camera_after(shot, len(shot.frames) - 1))
    for _ in range(ceil(max(closes, 0)) + NEIGHBOUR_FRAMES):
        frames.append((frames[-1][0] + 1, following))
        last, following = following, continued(last, following)
    numbers = [number for number, _ in frames]

    def stretch(number: int) -> Shot:
        begin = max(bisect_right(numbers, number + min(opens, 0)) - NEIGHBOUR_FRAMES, 0)
        end = bisect_left(numbers, number + max(closes, 0)) + NEIGHBOUR_FRAMES
        return Shot(tuple(Frame(at - number, camera, f"{at:04d}") for at, camera in frames[begin:end]))

    return stretch
