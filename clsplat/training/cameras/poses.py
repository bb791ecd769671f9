# SPDX-License-Identifier: Apache-2.0
"""Refinement of poses (--refine-poses): poses of the training views, learnt with the model by Adam."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from typing import Any

import numpy as np
from numpy.typing import NDArray

from clsplat.arrays import Float64
from clsplat.camera import ROTATION_TOLERANCE
from clsplat.config.training import TrainConfig
from clsplat.scenes.outliers import stray_cameras
from clsplat.scenes.scene import View

POSE_BETA1, POSE_BETA2 = 0.9, 0.99
"""Decay rates per step of Adam's first and second moment, for poses and lenses."""
MIN_AXIS_MOMENT_RATIO, MIN_AXIS_MOMENT = 1e-2, 1e-30
"""Lower bounds of the second moment along an axis: as a fraction of the largest second moment, and absolute."""
JACOBI_PAIRS = [
    np.array(pairs)
    for pairs in (
        ((0, 2, 4), (1, 3, 5)),
        ((0, 1, 3), (2, 4, 5)),
        ((0, 1, 2), (3, 5, 4)),
        ((0, 1, 2), (4, 3, 5)),
        ((0, 1, 3), (5, 2, 4)),
    )
]
"""Pairs of axes that Jacobi rotations of a 6x6 matrix treat: all 15, as five sets of three disjoint pairs."""
JACOBI_SWEEPS, JACOBI_TOLERANCE = 6, 1e-16
"""Number of passes of Jacobi rotations over all pairs, and relative size of off-diagonals that counts as zero."""
CAMERA_RATE_END_FRACTION = 0.01
"""Learning rate of cameras at the last step, as a fraction of the rate at the first."""


def fallen(reach: float, part: float, visits: float) -> float:
    """Learning rate of a camera at fraction `part` of its refinement. It falls exponentially.

    reach: sum of the rates of all of the camera's steps, and so about the limit of its motion.
    visits: number of these steps.
    """
    mean = (1 - CAMERA_RATE_END_FRACTION) / -np.log(CAMERA_RATE_END_FRACTION)
    return float(reach / max(visits * mean, 1.0) * CAMERA_RATE_END_FRACTION**part)


def first_step(config: TrainConfig) -> int:
    """Return the number of the step after which cameras are refined. Before, the model is too coarse to align them."""
    return min(500, config.iterations // 10)


def checked_arrays(
    own: Mapping[str, NDArray[Any]], arrays: Mapping[str, NDArray[Any]], folder: str
) -> dict[str, NDArray[Any]]:
    """Return copies of a checkpoint's arrays, if their shapes and types are those of the current arrays.

    own: the current arrays, by name with the prefix `folder`.
    arrays: the checkpoint's arrays, by name without this prefix, as in the result.
    Raises ValueError if an array is missing, not finite, or belongs to other views.
    """
    values = {}
    for name, like in own.items():
        value = arrays.get(name.removeprefix(folder))
        if value is None or value.shape != like.shape or value.dtype != like.dtype or not np.isfinite(value).all():
            raise ValueError(f"has no {name} of shape {like.shape}")
        values[name.removeprefix(folder)] = value.copy()
    return values


def axes_of(matrix: Float64) -> tuple[Float64, Float64]:
    """Eigenvalues (6,) of a symmetric matrix (6, 6), and its eigenvectors as rows.

    They are found by Jacobi rotations, of three pairs of axes at a time (Golub and Van Loan, section 8.5). LAPACK is
    not used, because its bits depend on the processor.
    """
    a, axes = matrix.copy(), np.eye(6)
    for p, q in JACOBI_SWEEPS * JACOBI_PAIRS:
        off, ends = a[p, q], (a[p, p], a[q, q])
        turns = np.abs(off) > JACOBI_TOLERANCE * np.maximum(*np.abs(ends))
        half = (ends[1] - ends[0]) / np.where(turns, 2 * off, 1.0)
        tangent = np.where(turns, np.copysign(1.0, half) / (np.abs(half) + np.sqrt(half * half + 1.0)), 0.0)
        cosine = 1.0 / np.sqrt(tangent * tangent + 1.0)
        cosine, sine = cosine[:, None], (tangent * cosine)[:, None]
        for rows in (a, a.T, axes):
            rows[p], rows[q] = cosine * rows[p] - sine * rows[q], sine * rows[p] + cosine * rows[q]
    return np.diagonal(a).copy(), axes


def descend(first: Float64, second: Float64, gradient: Float64, visit: int) -> Float64:
    """Adam's step (6,) at rate 1, in the axes of the gradients' second moments: equation (143) of docs/gradients.md.

    first, second: moments (6,) and (6, 6), updated in place.
    gradient: (6,).
    visit: number of steps that the camera has taken, including this step.
    """
    first += (1 - POSE_BETA1) * (gradient - first)
    second += (1 - POSE_BETA2) * (gradient[:, None] * gradient - second)
    mean = first / (1 - POSE_BETA1**visit)
    squares, axes = axes_of(second / (1 - POSE_BETA2**visit))
    least = max(MIN_AXIS_MOMENT_RATIO * squares.max(), MIN_AXIS_MOMENT)
    along = (axes * mean).sum(axis=1) / np.sqrt(np.maximum(squares, least))
    step: Float64 = -(axes.T * along).sum(axis=1)
    return step


class Poses:
    """Cameras of the training views, which move if poses are refined.

    Adam has moments for each view. Two views do not move, so that the model keeps its place and size. They are the
    first view whose camera is not an outlier, and the view farthest from it among such views.

    held: indices of the two views that do not move; empty if poses are not refined.
    """

    def __init__(self, config: TrainConfig, views: Sequence[View], length_unit: float) -> None:
        self.on, self.cameras = config.refine_poses, [view.camera for view in views]
        self._config, self._scale = config, np.repeat([1.0, length_unit], 3)
        self._given = list(self.cameras)
        self.held: tuple[int, ...] = ()
        if not self.on:
            return
        places = np.array([camera.position for camera in self.cameras])
        near = ~stray_cameras(self.cameras)
        first = int(near.argmax())
        distances = np.where(near, np.linalg.norm(places - places[first], axis=1), 0.0)
        self.held = (first, int(distances.argmax()) or len(views) - 1)
        self._start = first_step(config)
        self._first, self._second = np.zeros((len(views), 6)), np.zeros((len(views), 6, 6))
        self._visits = np.zeros(len(views), np.int64)

    def moves(self, view: int, step: int) -> bool:
        """True if step number `step` refines the pose of training view `view`."""
        return self.on and step > self._start and view not in self.held

    def rate(self, step: int) -> float:
        """Learning rate of step number `step`, in radians. The rates of all steps of a view sum to `pose_reach`."""
        steps = self._config.iterations - self._start
        reach, part = np.radians(self._config.pose_reach), (step - self._start) / steps
        return fallen(reach, part, steps / len(self.cameras))

    def move(self, view: int, step: int, gradient: Float64) -> None:
        """Take Adam's step for the pose of training view `view`. A gradient that is not finite causes no step.

        step: number of the training step, by which the learning rate falls.
        gradient: (6,), with respect to the camera's rotation and translation, as `Camera.moved` defines them.
        """
        scaled = gradient * self._scale  # translations relative to the length unit
        if not np.isfinite(scaled).all():
            return
        self._visits[view] += 1
        down = descend(self._first[view], self._second[view], scaled, int(self._visits[view]))
        self.cameras[view] = self.cameras[view].moved(self.rate(step) * self._scale * down)

    def motions(self) -> tuple[Float64, Float64]:
        """Rotation of each camera from its given pose in degrees (n,), and its movement in world units (n,)."""
        pairs = list(zip(self._given, self.cameras, strict=True))
        cosines = [(np.trace(a.rotation @ b.rotation.T) - 1) / 2 for a, b in pairs]
        degrees: Float64 = np.degrees(np.arccos(np.clip(cosines, -1, 1)))
        return degrees, np.array([np.linalg.norm(a.position - b.position) for a, b in pairs])

    def arrays(self) -> dict[str, NDArray[Any]]:
        """Poses and Adam's moments, keyed by their names in a checkpoint."""
        if not self.on:
            return {}
        rotations = np.array([camera.rotation for camera in self.cameras])
        translations = np.array([camera.translation for camera in self.cameras])
        moments = {"poses/first": self._first, "poses/second": self._second, "poses/visits": self._visits}
        return {"poses/rotations": rotations, "poses/translations": translations, **moments}

    def load(self, arrays: Mapping[str, NDArray[Any]]) -> None:
        """Load the poses from a checkpoint's arrays, by name without "poses/". Raises ValueError for other views."""
        if not self.on:
            return
        values = checked_arrays(self.arrays(), arrays, "poses/")
        turned = values["rotations"]
        if np.abs(turned @ turned.transpose(0, 2, 1) - np.eye(3)).max() > ROTATION_TOLERANCE:
            raise ValueError("has poses/rotations that are not rotation matrices")
        poses = zip(self._given, values["rotations"], values["translations"], strict=True)
        self.cameras = [given.posed(rotation, translation) for given, rotation, translation in poses]
        self._first, self._second, self._visits = values["first"], values["second"], values["visits"]
