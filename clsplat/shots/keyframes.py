# SPDX-License-Identifier: Apache-2.0
"""Key frames of a camera and smooth interpolation between them.

Positions and rotations follow cubic Hermite splines (not slerp), scalars monotone cubics. docs/cameras.md
(Between key frames) gives the reasons. `shots/readers` reads key frames from files.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, replace
from typing import TYPE_CHECKING

import numpy as np
from numpy.typing import NDArray

from clsplat.arrays import Float64
from clsplat.camera import Camera

if TYPE_CHECKING:
    from scipy.spatial.transform import Rotation

MAX_TANGENT_SLOPE_RATIO = 3.0
"""Largest ratio of a tangent to the slope of an adjacent segment. At 3, a cubic's inner Bezier points are one chord
length from its ends. Under any larger limit, a cubic of a scalar might not be monotone."""


@dataclass(frozen=True, eq=False)
class Key:
    """A camera at a frame number, which may be fractional.

    roll: additional rotation about the camera's own z axis, in radians.
    """

    frame: float
    camera: Camera
    roll: float = 0.0


def interpolate(keys: Sequence[Key], frames: Sequence[float], *, loop: float | None = None) -> list[Camera]:
    """Interpolate cameras at `frames`. Before the first key and after the last, the camera does not move.

    keys: key frames in increasing order of frame, with cameras of one size and projection.
    loop: number of frames after which the first key repeats; must exceed the span of the keys.
    Rotations take the shorter arc from key to key. Rolls are interpolated as numbers, so they may make full turns.

    Raises ValueError if there are no keys, if they are not in order, or if they span `loop` frames or more.
    """
    from scipy.interpolate import PchipInterpolator  # here, as the import takes 0.3 s and few commands need it
    from scipy.spatial.transform import Rotation

    if not keys:
        raise ValueError("expected at least one key")
    times = np.array([key.frame for key in keys], np.float64)
    if not (np.diff(times) > 0).all() or (loop is not None and not times[-1] - times[0] < loop):
        raise ValueError("expected keys in increasing order of frame, which span less than the loop if there is one")
    at = np.asarray(frames, np.float64)
    positions = np.stack([key.camera.position for key in keys])
    rotations = Rotation.from_matrix(np.stack([key.camera.rotation.T for key in keys]))
    scalars = np.array(
        [[key.roll, np.log(key.camera.fx), np.log(key.camera.fy), key.camera.cx, key.camera.cy] for key in keys]
    )
    if loop is not None:
        # the keys are repeated for one period before and after, as a slope depends on at most two neighbours
        at = times[0] + np.mod(at - times[0], loop)
        closing = np.zeros(scalars.shape[1])
        closing[0] = 2 * np.pi * np.round((scalars[-1, 0] - scalars[0, 0]) / (2 * np.pi))
        times = np.concatenate([times - loop, times, times + loop])
        positions = np.tile(positions, (3, 1))
        rotations = Rotation.concatenate([rotations] * 3)
        scalars = np.concatenate([scalars - closing, scalars, scalars + closing])
    if len(times) == 1:
        times = np.array([times[0], times[0] + 1])
        positions, scalars = np.tile(positions, (2, 1)), np.tile(scalars, (2, 1))
        rotations = Rotation.concatenate([rotations] * 2)
    at = np.clip(at, times[0], times[-1])
    segment = np.clip(np.searchsorted(times, at, side="right") - 1, 0, len(times) - 2)

    path = _positions(times, positions, at, segment)
    turned = _rotations(times, rotations, at, segment)
    values = np.asarray(PchipInterpolator(times, scalars)(at))
    roll = np.zeros((len(at), 3))
    roll[:, 2] = values[:, 0]
    cam_from_world = (turned * Rotation.from_rotvec(roll)).inv().as_matrix()
    # at a key without roll, the key's camera is used bit for bit, so that it shows the recorded view
    exact = {key.frame: key.camera for key in keys if key.roll == 0}
    cameras = []
    for index, (rotation, position) in enumerate(zip(cam_from_world, path, strict=True)):
        if (camera := exact.get(float(at[index]))) is not None:
            cameras.append(camera)
            continue
        key = keys[int(segment[index]) % len(keys)]
        cameras.append(_moved(key.camera, values[index], rotation, position))
    return cameras


def _moved(camera: Camera, values: Float64, rotation: Float64, position: Float64) -> Camera:
    """Copy a camera with another pose and lens.

    values: (5,), the roll, which is not used, the logarithms of fx and fy, and cx and cy.
    rotation: (3, 3), of cam_from_world. position: (3,), the camera's centre.
    """
    fx, fy = np.exp(values[1:3])
    return replace(
        camera,
        fx=float(fx),
        fy=float(fy),
        cx=float(values[3]),
        cy=float(values[4]),
        rotation=rotation,
        translation=-rotation @ position,
    )


def tangents(times: Float64, slopes: Float64) -> Float64:
    """Return the velocities (N, D) of a spline at its N keys.

    times: (N,), of the keys. slopes: (N - 1, D), the mean velocities from each key to the next.
    """
    before, after = np.diff(times)[:-1, None], np.diff(times)[1:, None]
    result = np.concatenate([slopes[:1], slopes[-1:]])
    if len(slopes) > 1:
        inner = (after * slopes[:-1] + before * slopes[1:]) / (before + after)
        # A tangent is the slope of the parabola through three keys; at an end it is 0 if it would point backwards.
        first = ((2 * before[0] + after[0]) * slopes[0] - before[0] * slopes[1]) / (before[0] + after[0])
        last = ((2 * after[-1] + before[-1]) * slopes[-1] - after[-1] * slopes[-2]) / (before[-1] + after[-1])
        first = first if first @ slopes[0] > 0 else np.zeros_like(first)
        last = last if last @ slopes[-1] > 0 else np.zeros_like(last)
        result = np.concatenate([first[None], inner, last[None]])
    speeds = np.linalg.norm(slopes, axis=1)
    most = MAX_TANGENT_SLOPE_RATIO * np.minimum(np.append(speeds, np.inf), np.insert(speeds, 0, np.inf))
    lengths = np.linalg.norm(result, axis=1)
    scale = np.divide(most, lengths, out=np.ones_like(most), where=lengths > most)
    limited: Float64 = result * scale[:, None]
    return limited


def _positions(times: Float64, keys: Float64, at: Float64, segment: NDArray[np.intp]) -> Float64:
    """Return the positions (F, 3) at the times `at` (F,) on the spline through the positions `keys` (N, 3).

    times: (N,), of the keys. segment: (F,), for each time in `at` the index of the key before it.
    """
    chords, lengths = np.diff(keys, axis=0), np.diff(times)
    velocity = tangents(times, chords / lengths[:, None])
    h = lengths[segment][:, None]
    s = (at - times[segment])[:, None] / h
    leave, arrive = velocity[segment] * h, velocity[segment + 1] * h
    path: Float64 = keys[segment] + chords[segment] * s * s * (3 - 2 * s) + s * (1 - s) * ((1 - s) * leave - s * arrive)
    # at the end of a segment, copy the key to keep its exact bits
    return np.where(s == 1, keys[segment + 1], path)


def _rotations(times: Float64, keys: Rotation, at: Float64, segment: NDArray[np.intp]) -> Rotation:
    from scipy.spatial.transform import Rotation  # as above

    lengths = np.diff(times)
    # the rotation vector from one key to the next is the same in the axes of both keys
    steps = (keys[:-1].inv() * keys[1:]).as_rotvec()
    velocity = tangents(times, steps / lengths[:, None])
    h = lengths[segment][:, None]
    s = (at - times[segment])[:, None] / h
    leave, arrive = velocity[segment] * h / 3, velocity[segment + 1] * h / 3
    step = Rotation.from_rotvec(steps[segment])
    middle = (Rotation.from_rotvec(-leave) * step * Rotation.from_rotvec(-arrive)).as_rotvec()
    return (
        keys[segment]
        * Rotation.from_rotvec((1 - (1 - s) ** 3) * leave)
        * Rotation.from_rotvec(s * s * (3 - 2 * s) * middle)
        * Rotation.from_rotvec(s**3 * arrive)
    )
