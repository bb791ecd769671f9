# SPDX-License-Identifier: Apache-2.0
"""Camera paths generated from a scene's cameras, with any number of frames: turntable, spiral and through.

`shots/viewpoints.py` finds the up axis and the arcs that cameras cover; `shots/read.py` has the default number of
frames.
"""

from __future__ import annotations

from collections.abc import Iterable, Sequence
from dataclasses import dataclass, replace

import numpy as np

from clsplat.arrays import Float64
from clsplat.camera import Camera
from clsplat.scenes.orientation.level import focus_point, up_axis
from clsplat.shots.keyframes import Key, interpolate
from clsplat.shots.viewpoints import MAX_AZIMUTH_GAP_RADIANS, covered_arc, look_at


@dataclass(frozen=True, eq=False)
class _Ring:
    """Cameras in cylindrical coordinates about the point that they look at.

    first: the first camera.
    up, east, north: unit axes (3,); east points towards the first camera.
    focus: (3,), the point that the cameras look at.
    offsets: (N, 3), camera positions relative to the focus.
    heights: (N,), offsets along up.
    radii: (N,), distances from the axis through the focus.
    azimuths: (N,), radians.
    """

    first: Camera
    up: Float64
    east: Float64
    north: Float64
    focus: Float64
    offsets: Float64
    heights: Float64
    radii: Float64
    azimuths: Float64

    def outwards(self, angle: float) -> Float64:
        """Horizontal unit vector (3,) that points away from the axis at an azimuth."""
        return np.asarray(np.cos(angle) * self.east + np.sin(angle) * self.north)

    def facing(self, positions: Iterable[Float64]) -> list[Camera]:
        """Copies of the first camera at the given positions, each (3,), turned to the focus."""
        poses = [look_at(position, self.focus, self.up) for position in positions]
        return [replace(self.first, rotation=rotation, translation=translation) for rotation, translation in poses]


def _check(name: str, cameras: Sequence[Camera], frames: int) -> None:
    if not cameras or frames < 1:
        raise ValueError(f"{name}: {frames} frames from {len(cameras)} cameras, expected at least one of each")


def _ring(cameras: Sequence[Camera], known_up: Float64 | None) -> _Ring:
    up, focus = up_axis(cameras) if known_up is None else known_up, focus_point(cameras)
    offsets = np.stack([camera.position for camera in cameras]) - focus
    heights = offsets @ up
    level = offsets - heights[:, None] * up
    aside = np.linalg.norm(level[0]) > 1e-9 * np.linalg.norm(offsets[0])
    first = level[0] if aside else np.cross(up, cameras[0].rotation[0])
    east = first / np.linalg.norm(first)
    north = np.cross(up, east)
    azimuths = np.arctan2(level @ north, level @ east)
    return _Ring(cameras[0], up, east, north, focus, offsets, heights, np.linalg.norm(level, axis=1), azimuths)


def turntable(cameras: Sequence[Camera], frames: int, up: Float64 | None = None) -> list[Camera]:
    """A closed path of `frames` cameras around the point that the scene's cameras look at, their focus point.

    The path keeps the cameras' median distance and height, and begins near the first camera. If the cameras surround
    the focus point, the path makes one full turn. If they leave a wide gap, the path swings back and forth over the arc
    that the cameras cover, since no camera has seen the rest. Intrinsics are the first camera's.

    up: up direction (3,); None to estimate it from the cameras.
    Raises ValueError for no cameras or no frames.
    """
    _check("turntable", cameras, frames)
    ring = _ring(cameras, up)
    radius, height = float(np.median(ring.radii)), float(np.median(ring.heights))

    time = np.arange(frames) / frames
    begin, width = covered_arc(ring.azimuths)
    if 2 * np.pi - width <= MAX_AZIMUTH_GAP_RADIANS:
        angles = 2 * np.pi * time
    else:
        # the phase puts the first frame at azimuth 0, which is the first camera's azimuth
        middle, half = begin + width / 2, width / 2
        off = (-middle + np.pi) % (2 * np.pi) - np.pi
        phase = np.arcsin(np.clip(off / half, -1, 1)) if half > 1e-6 else 0.0
        angles = middle + half * np.sin(2 * np.pi * time + phase)
    return ring.facing(ring.focus + height * ring.up + radius * ring.outwards(angle) for angle in angles)


SPIRAL_TURNS = 2
"""Full turns of a spiral around the focus point."""
MAX_SPIRAL_ELEVATION_RADIANS = np.deg2rad(85.0)
"""Largest elevation of a spiral, in radians. A level camera that looks straight up or down has no defined right
axis."""
SMOOTHING_NEIGHBOURS = 3
"""Number of cameras on each side of a camera from which `through` computes its smoothed pose. This removes the jitter
of hand-held photographs."""


def spiral(cameras: Sequence[Camera], frames: int, up: Float64 | None = None) -> list[Camera]:
    """A closed path of two turns that rises and sinks over the cameras' range of heights, facing their focus point.

    Coordinates are spherical about `focus_point`. If the cameras stand all around this point, the path makes two full
    turns at the cameras' median distance. Its elevation goes once from the 10th to the 90th percentile of the cameras'
    elevations and back.

    If the cameras leave a wide gap, the path is an ellipse in front of the scene, run through twice. In each round, the
    azimuth goes once to and fro over the arc that the cameras cover, and the elevation between the two percentiles. The
    distance goes to and fro once in the whole path, between the 10th and 90th percentile of the cameras' distances.

    Intrinsics are the first camera's.

    up: as for `turntable`.
    Raises ValueError for no cameras or no frames.
    """
    _check("spiral", cameras, frames)
    ring = _ring(cameras, up)
    elevations = np.clip(
        np.arctan2(ring.heights, ring.radii), -MAX_SPIRAL_ELEVATION_RADIANS, MAX_SPIRAL_ELEVATION_RADIANS
    )
    distances = np.linalg.norm(ring.offsets, axis=1)

    turn = 2 * np.pi * np.arange(frames) / frames
    begin, width = covered_arc(ring.azimuths)
    if 2 * np.pi - width <= MAX_AZIMUTH_GAP_RADIANS:
        azimuth = SPIRAL_TURNS * turn
        elevation = _between(elevations, -np.cos(turn))
        distance = np.full(frames, np.median(distances))
    else:
        azimuth = begin + width / 2 * (1 + np.sin(SPIRAL_TURNS * turn))
        elevation = _between(elevations, np.cos(SPIRAL_TURNS * turn))
        distance = _between(distances, np.sin(turn))
    return ring.facing(
        ring.focus + radius * (np.cos(height) * ring.outwards(angle) + np.sin(height) * ring.up)
        for angle, height, radius in zip(azimuth, elevation, distance, strict=True)
    )


def _between(values: Float64, wave: Float64) -> Float64:
    """Map a wave from -1 to 1 onto the range from the 10th to the 90th percentile of `values` (n,)."""
    low, high = np.percentile(values, [10, 90])
    return np.asarray(0.5 * (low + high) + 0.5 * (high - low) * wave)


def through(cameras: Sequence[Camera], frames: int, up: Float64 | None = None) -> list[Camera]:  # noqa: ARG001
    """A smoothed path from the first camera to the last, in their order, at constant speed, with the first camera's
    intrinsics.

    Positions and rotations come from a parabola fitted to each camera and three neighbours on each side, which
    preserves arcs. Near the ends fewer neighbours are used, so that the ends stay in place. A spline interpolates the
    results. Speed combines distance and angle, each relative to its median step, so that a camera that only turns also
    takes time. Raises ValueError for no cameras or no frames.
    """
    from scipy.spatial.transform import Rotation  # here, as the import takes 0.1 s and few commands need it

    _check("through", cameras, frames)
    smooth = _smoothed(cameras)
    positions = np.stack([camera.position for camera in smooth])
    rotations = Rotation.from_matrix(np.stack([camera.rotation.T for camera in smooth]))
    moves = np.linalg.norm(np.diff(positions, axis=0), axis=1)
    turns = (rotations[:-1].inv() * rotations[1:]).magnitude() if len(smooth) > 1 else np.zeros(0)
    steps = np.hypot(_in_medians(moves, 1e-12 * np.abs(positions).max()), _in_medians(turns, 1e-9))
    keys = [Key(0.0, smooth[0])]
    for camera, step in zip(smooth[1:], steps, strict=True):
        if step > 1e-6:  # skips a camera that has not moved
            keys.append(Key(keys[-1].frame + float(step), camera))
    return interpolate(keys, list(np.linspace(0.0, keys[-1].frame, frames)))


def _in_medians(lengths: Float64, rounding: float) -> Float64:
    """Divide lengths (n,) by the median of the lengths that exceed `rounding`, the largest rounding error."""
    clear = lengths[lengths > rounding]
    return lengths / np.median(clear) if len(clear) else np.zeros_like(lengths)


def _smoothed(cameras: Sequence[Camera]) -> list[Camera]:
    from scipy.spatial.transform import Rotation  # as above

    positions = np.stack([camera.position for camera in cameras])
    rotations = Rotation.from_matrix(np.stack([camera.rotation.T for camera in cameras]))
    smooth = []
    for index in range(len(cameras)):
        reach = min(SMOOTHING_NEIGHBOURS, index, len(cameras) - 1 - index)
        near, weights = slice(index - reach, index + reach + 1), parabola_weights(reach)
        turns = (rotations[index].inv() * rotations[near]).as_rotvec()
        rotation = (rotations[index] * Rotation.from_rotvec(weights @ turns)).inv().as_matrix()
        smooth.append(replace(cameras[0], rotation=rotation, translation=-rotation @ (weights @ positions[near])))
    return smooth


def parabola_weights(reach: int) -> Float64:
    """Return the weights (2 reach + 1,) of a Savitzky-Golay filter (1964) for evenly spaced values.

    The sum of the weighted values is the middle value of the parabola that is fitted to them.
    """
    offsets = np.arange(-reach, reach + 1)
    scale = 3 / ((2 * reach + 3) * (2 * reach + 1) * (2 * reach - 1))
    return np.asarray(scale * (3 * reach * reach + 3 * reach - 1 - 5 * offsets**2))


PATH_GENERATORS = {"turntable": turntable, "spiral": spiral, "through": through}
