# SPDX-License-Identifier: Apache-2.0
"""Poses of training views, learnt with the model."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from typing import Any

import numpy as np
from numpy.typing import NDArray

from clsplat.arrays import Float64
from clsplat.camera import NO_ROTATION
from clsplat.config.training import TrainConfig
from clsplat.errors import InputError
from clsplat.scenes.scene import View
from clsplat.scenes.strays import stray_cameras

BETA1, BETA2 = 0.9, 0.99
FLATTEST, TINY = 1e-2, 1e-30
"""Least second moment along an axis: that part of the largest one, and what stands for nothing at all."""
PAIRS = [
    np.array(pairs)
    for pairs in (
        ((0, 2, 4), (1, 3, 5)),
        ((0, 1, 3), (2, 4, 5)),
        ((0, 1, 2), (3, 5, 4)),
        ((0, 1, 2), (4, 3, 5)),
        ((0, 1, 3), (5, 2, 4)),
    )
]
"""The 15 pairs of six motions, three at a time."""
SWEEPS, ROUNDING = 6, 1e-16
"""Of Jacobi's rotations: passes over all pairs, and what counts as zero beside the diagonal."""
LEAST = 0.01
"""Part of the rate that is left at the last step."""


def fallen(reach: float, part: float, visits: float) -> float:
    """The rate of a visit that comes after this part of all: it falls exponentially, and all together are `reach`."""
    mean = (1 - LEAST) / -np.log(LEAST)
    return float(reach / max(visits * mean, 1.0) * LEAST**part)


def first_step(config: TrainConfig) -> int:
    """The step after which cameras are refined: the model has to show something by then."""
    return min(500, config.iterations // 10)


def checked_arrays(
    own: Mapping[str, NDArray[Any]], arrays: Mapping[str, NDArray[Any]], folder: str
) -> dict[str, NDArray[Any]]:
    """Copies of a checkpoint's arrays by name, for those that `own` has in this folder. Raises ValueError for one that
    is missing, or of other views."""
    values = {}
    for name, like in own.items():
        value = arrays.get(name.removeprefix(folder))
        if value is None or value.shape != like.shape or value.dtype != like.dtype or not np.isfinite(value).all():
            raise ValueError(f"has no {name} of shape {like.shape}")
        values[name.removeprefix(folder)] = value.copy()
    return values


def axes_of(matrix: Float64) -> tuple[Float64, Float64]:
    """Eigenvalues (6,) of a symmetric matrix (6, 6), and the eigenvectors as rows, by Jacobi rotations of three pairs
    at a time (Golub and Van Loan, section 8.5): LAPACK has other bits on another processor."""
    a, axes = matrix.copy(), np.eye(6)
    for p, q in SWEEPS * PAIRS:
        off, ends = a[p, q], (a[p, p], a[q, q])
        turns = np.abs(off) > ROUNDING * np.maximum(*np.abs(ends))
        half = (ends[1] - ends[0]) / np.where(turns, 2 * off, 1.0)
        tangent = np.where(turns, np.copysign(1.0, half) / (np.abs(half) + np.sqrt(half * half + 1.0)), 0.0)
        cosine = 1.0 / np.sqrt(tangent * tangent + 1.0)
        cosine, sine = cosine[:, None], (tangent * cosine)[:, None]
        for rows in (a, a.T, axes):
            rows[p], rows[q] = cosine * rows[p] - sine * rows[q], sine * rows[p] + cosine * rows[q]
    return np.diagonal(a).copy(), axes


def descend(first: Float64, second: Float64, by: Float64, visit: int) -> Float64:
    """Adam's step (6,) at rate 1 along the axes of the gradients' second moments, at visit number `visit` (from 1); the
    moments (6,) and (6, 6) change in place. docs/gradients.md, (143)."""
    first += (1 - BETA1) * (by - first)
    second += (1 - BETA2) * (by[:, None] * by - second)
    mean = first / (1 - BETA1**visit)
    squares, axes = axes_of(second / (1 - BETA2**visit))
    least = max(FLATTEST * squares.max(), TINY)
    along = (axes * mean).sum(axis=1) / np.sqrt(np.maximum(squares, least))
    step: Float64 = -(axes.T * along).sum(axis=1)
    return step


class Poses:
    """The cameras of the training views, which move where poses are refined.

    Adam has moments for each view. Two views stay as they are, the first and the one that is farthest from it, strays
    aside: they keep the model's place and size.
    """

    def __init__(self, config: TrainConfig, views: Sequence[View], extent: float) -> None:
        self.on, self.cameras = config.refine_poses, [view.camera for view in views]
        self._config, self._scale = config, np.repeat([1.0, extent], 3)
        self._given = list(self.cameras)
        self.held: tuple[int, ...] = ()
        if not self.on:
            return
        if len(views) < 3:
            raise InputError(f"--refine-poses: {len(views)} training views, expected 3 or more, as two are held")
        places = np.array([camera.position for camera in self.cameras])
        near = ~stray_cameras(self.cameras)
        first = int(near.argmax())
        distances = np.where(near, np.linalg.norm(places - places[first], axis=1), 0.0)
        self.held = (first, int(distances.argmax()) or len(views) - 1)
        self._start = first_step(config)
        self._first, self._second = np.zeros((len(views), 6)), np.zeros((len(views), 6, 6))
        self._visits = np.zeros(len(views), np.int64)

    def moves(self, view: int, step: int) -> bool:
        """True if the view's pose is refined in this step."""
        return self.on and step > self._start and view not in self.held

    def rate(self, step: int) -> float:
        """Radians of a step, falling exponentially: over all visits of a view they are about `pose_reach`."""
        steps = self._config.iterations - self._start
        reach, part = np.radians(self._config.pose_reach), (step - self._start) / steps
        return fallen(reach, part, steps / len(self.cameras))

    def move(self, view: int, step: int, gradient: Float64) -> None:
        """Adam's step of a view's pose; none for a gradient that is not finite."""
        by = gradient * self._scale  # shifts in parts of the extent
        if not np.isfinite(by).all():
            return
        self._visits[view] += 1
        down = descend(self._first[view], self._second[view], by, int(self._visits[view]))
        self.cameras[view] = self.cameras[view].moved(self.rate(step) * self._scale * down)

    def motions(self) -> tuple[Float64, Float64]:
        """Degrees by which each view has turned, and world units by which it has moved."""
        pairs = list(zip(self._given, self.cameras, strict=True))
        cosines = [(np.trace(a.rotation @ b.rotation.T) - 1) / 2 for a, b in pairs]
        degrees: Float64 = np.degrees(np.arccos(np.clip(cosines, -1, 1)))
        return degrees, np.array([np.linalg.norm(a.position - b.position) for a, b in pairs])

    def arrays(self) -> dict[str, NDArray[Any]]:
        """Arrays of a checkpoint, by name."""
        if not self.on:
            return {}
        rotations = np.array([camera.rotation for camera in self.cameras])
        translations = np.array([camera.translation for camera in self.cameras])
        moments = {"poses/first": self._first, "poses/second": self._second, "poses/visits": self._visits}
        return {"poses/rotations": rotations, "poses/translations": translations, **moments}

    def load(self, arrays: Mapping[str, NDArray[Any]]) -> None:
        """Take the arrays of a checkpoint. Raises ValueError where that is of other views."""
        if not self.on:
            return
        values = checked_arrays(self.arrays(), arrays, "poses/")
        turned = values["rotations"]
        if np.abs(turned @ turned.transpose(0, 2, 1) - np.eye(3)).max() > NO_ROTATION:
            raise ValueError("has poses/rotations that are none")
        poses = zip(self._given, values["rotations"], values["translations"], strict=True)
        self.cameras = [given.posed(rotation, translation) for given, rotation, translation in poses]
        self._first, self._second, self._visits = values["first"], values["second"], values["visits"]
