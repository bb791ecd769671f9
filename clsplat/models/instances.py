# SPDX-License-Identifier: Apache-2.0
"""Placement of several models in a shot, and their merging into one model for each frame.

A placement has a transform, an opacity and a colour matrix, which may change over time. Models are merged before
rendering, so that their Gaussians are sorted and blended together.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, replace
from math import ceil
from typing import Protocol

import numpy as np

from clsplat.arrays import Float64
from clsplat.errors import InputError
from clsplat.gaussians import Gaussians
from clsplat.images.colour import REC709_LUMA_WEIGHTS
from clsplat.models.codec.axes import NODE_SIMILARITY_TOLERANCE
from clsplat.models.edit import decompose, faded, graded, merge, transform
from clsplat.models.series import ModelSeries

IDENTITY_ROWS = tuple(np.eye(4)[:3].ravel().tolist())


@dataclass(frozen=True)
class Placement:
    """Placement of a model at one time.

    matrix: first three rows of the (4, 4) matrix from the model's world to the shot's, flattened.
    opacity: factor from 0 (hidden) to 1.
    colour: colour matrix (3, 3) with an offset as fourth column, flattened; empty if colours do not change.
    frame: for a `ModelSeries`, the frame whose Gaussians are placed; None for a static model.
    """

    matrix: tuple[float, ...] = IDENTITY_ROWS
    opacity: float = 1.0
    colour: tuple[float, ...] = ()
    frame: float | None = None

    @property
    def transform(self) -> Float64:
        """Matrix (4, 4) from the model's world to the shot's."""
        return np.vstack([np.array(self.matrix).reshape(3, 4), (0.0, 0.0, 0.0, 1.0)])

    def within(self, outer: Placement) -> Placement:
        """Placement of this model in the shot's world, if it is in a group that has the placement `outer`."""
        matrix = self.matrix
        if outer.matrix != IDENTITY_ROWS:
            matrix = rows_of(outer.transform @ self.transform)
        colour = outer.colour or self.colour
        if outer.colour and self.colour:
            first, then = (np.array(rows).reshape(3, 4) for rows in (self.colour, outer.colour))
            both = then[:, :3] @ first
            both[:, 3] += then[:, 3]
            colour = tuple(both.ravel().tolist())
        return Placement(matrix, self.opacity * outer.opacity, colour, self.frame)


State = tuple[Placement, ...]
"""Placements of all models of a shot at one time."""


class Track(Protocol):
    """Placement of a model over time."""

    def at(self, frame: float) -> Placement:
        """Placement at a frame, which may be fractional. Raises InputError if the placement is invalid."""

    @property
    def reach(self) -> tuple[float, float] | None:
        """First and last frame for which the track's source has data; None for a static placement."""


@dataclass(frozen=True, eq=False)
class Changing:
    """`Track` of a `ModelSeries`. At each frame it places the Gaussians that the series has at that frame.

    inner: the track that gives the transform, opacity and colour at each frame.
    """

    inner: Track

    def at(self, frame: float) -> Placement:
        """Placement of the inner track at a frame, with this frame as the placement's `frame` too."""
        return replace(self.inner.at(frame), frame=float(frame))

    @property
    def reach(self) -> tuple[float, float] | None:
        """First and last frame for which the inner track's source has data; None for a static placement."""
        return self.inner.reach


def rows_of(matrix: Float64) -> tuple[float, ...]:
    """First three rows of a matrix (4, 4), flattened for `Placement.matrix`."""
    return tuple(float(value) + 0.0 for value in matrix[:3].ravel())  # -0 + 0.0 is 0: equal matrices get equal bits


def grade(gain: Float64, offset: Float64, saturation: float) -> tuple[float, ...]:
    """Return `Placement.colour` for a gain (3,), then an offset (3,), then a saturation, as in ASC CDL.

    The result is empty if they change no colour.
    """
    if (gain == 1).all() and (offset == 0).all() and saturation == 1:
        return ()
    spread = saturation * np.eye(3) + (1 - saturation) * np.array(REC709_LUMA_WEIGHTS)
    return tuple(np.column_stack([spread * gain, spread @ offset]).ravel().tolist())


def checked(placement: Placement, where: str) -> Placement:
    """Check that a placement's transform is a similarity, and return the placement.

    Raises InputError, prefixed with `where`, if it is not.
    """
    try:
        decompose(placement.transform, NODE_SIMILARITY_TOLERANCE)
    except InputError as error:
        raise InputError(f"{where}: has {error}") from None
    return placement


def placed(gaussians: Gaussians, placement: Placement) -> Gaussians:
    """Apply a placement to a model. Raises InputError like `edit.transform`."""
    moved = gaussians
    if placement.matrix != IDENTITY_ROWS:
        moved = transform(gaussians, placement.transform, NODE_SIMILARITY_TOLERANCE)
    if placement.colour:
        rows = np.array(placement.colour).reshape(3, 4)
        moved = graded(moved, rows[:, :3], rows[:, 3])
    return faded(moved, placement.opacity)


def extrapolated(track: Track, frame: float, end: float) -> Placement:
    """Placement of a track at a frame. If the track has no data there, its motion at frame `end` continues.

    end: frame from which motions are extrapolated, such as the last or the first of the shot.

    If `frame` is n whole frames and a fraction beyond the end, the motion over the same fraction just before the end is
    repeated once. Then the motion of the last whole frame is repeated n times, as for cameras (`shots.motion`). Opacity
    and colour are those of the track at `frame`. Raises InputError for a transform that is no longer invertible.
    """
    if (reach := track.reach) is None or reach[0] <= frame <= reach[1]:
        return track.at(frame)
    way, place, now = (1 if frame > end else -1), track.at(frame), track.at(end)
    steps = ceil(abs(frame - end)) - 1
    matrix = _step(now, track.at(2 * end - (frame - steps * way))) @ now.transform
    for _ in range(steps):
        matrix = _step(now, track.at(end - way)) @ matrix
    rows = now.matrix if np.array_equal(matrix, now.transform) else rows_of(matrix)
    return checked(replace(place, matrix=rows), f"a model that moves on beyond frame {end:g}")


def _step(now: Placement, before: Placement) -> Float64:
    """Similarity (4, 4) that maps a model placed by `before` to the same model placed by `now`, without shear."""
    matrix = np.eye(4)
    if now.matrix != before.matrix:
        (scale, turn, shift), (scale_before, turn_before, shift_before) = (
            decompose(placement.transform, NODE_SIMILARITY_TOLERANCE) for placement in (now, before)
        )
        matrix[:3, :3] = scale / scale_before * turn @ turn_before.T
        matrix[:3, 3] = shift - matrix[:3, :3] @ shift_before
    return matrix


def kind_of(model: Gaussians | ModelSeries) -> Gaussians:
    """Return a model that tells how the given one is drawn: its `antialiased`, `by_rays` and near plane.

    It is the model itself, or for a `ModelSeries` an empty model.
    """
    return model.kind if isinstance(model, ModelSeries) else model


def near_of(models: Sequence[Gaussians | ModelSeries], state: State) -> float:
    """Smallest near plane in world units of the models placed by `state`, hidden models included."""
    return min(
        model.near
        if placement.matrix == IDENTITY_ROWS
        else decompose(placement.transform, NODE_SIMILARITY_TOLERANCE)[0] * model.near
        for model, placement in zip(map(kind_of, models), state, strict=True)
    )


class Ensemble:
    """Places the models of a shot by a `State` and merges them into one model, for one state after another.

    A model whose placement is that of the last state is not placed again. Not thread-safe.
    """

    def __init__(self, models: Sequence[Gaussians | ModelSeries]) -> None:
        self.models = tuple(models)
        self._placed: list[tuple[Placement, Gaussians] | None] = [None] * len(self.models)
        self._last: tuple[State, Gaussians] | None = None

    def at(self, state: State) -> Gaussians:
        """The models placed by `state` and merged in order. Hidden models are included, so each Gaussian keeps its row.

        The same state again returns the same object.
        """
        if self._last is None or self._last[0] != state:
            self._last = None  # frees the old merged model before the next is allocated
            self._last = state, merge([self._one(index, placement) for index, placement in enumerate(state)])
        return self._last[1]

    def moved(self, state: State, after: State) -> Gaussians | None:
        """Merged model with the rows of `at(state)` and the means of the state `after`; None if no model moves.

        Only its means are of use. It has no SH coefficients above degree 0, and the placements' opacities and colours
        are not applied.
        """
        if [(now.matrix, now.frame) for now in state] == [(then.matrix, then.frame) for then in after]:
            return None
        moved = []
        for model, now, then in zip(self.models, state, after, strict=True):
            if isinstance(model, ModelSeries):
                assert now.frame is not None
                assert then.frame is not None
                there = model.moved(now.frame, then.frame)
            else:
                there = model
            moved.append(placed(replace(there, sh=there.sh[:, :1]), Placement(then.matrix)))
        return merge(moved)

    def _one(self, index: int, placement: Placement) -> Gaussians:
        before = self._placed[index]
        if before is None or before[0] != placement:
            self._placed[index] = None
            model = self.models[index]
            if isinstance(model, ModelSeries):
                assert placement.frame is not None
                model = model.at(placement.frame)
            before = self._placed[index] = placement, placed(model, placement)
        return before[1]
