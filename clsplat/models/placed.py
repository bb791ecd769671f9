# SPDX-License-Identifier: Apache-2.0
"""Models placed in a shot: where each is at a time, how opaque and of which colour, at which frame if it changes, and
all of them as one model.

They are put together before they are drawn, so that they sort and blend with each other as one model's Gaussians do.
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
from clsplat.models.codec.axes import SLACK
from clsplat.models.edit import decompose, faded, graded, merge, transform
from clsplat.models.series import Series

IDENTITY = tuple(np.eye(4)[:3].ravel().tolist())
LUMA = np.array([0.2126, 0.7152, 0.0722])
"""Rec.709's weights, which ASC CDL's saturation takes too."""


@dataclass(frozen=True)
class Placement:
    """A model at a time. matrix: the first three rows of (4, 4), from the model's world to the shot's; opacity: factor
    from 0, which hides it, to 1; colour: none, or the rows of (3, 4), a matrix and what is added to it; frame: at which
    the Gaussians of a `Series` are taken, None for those of a model that does not change."""

    matrix: tuple[float, ...] = IDENTITY
    opacity: float = 1.0
    colour: tuple[float, ...] = ()
    frame: float | None = None

    @property
    def transform(self) -> Float64:
        """(4, 4)."""
        return np.vstack([np.array(self.matrix).reshape(3, 4), (0.0, 0.0, 0.0, 1.0)])

    def within(self, outer: Placement) -> Placement:
        """The same model where what it is in is placed as well."""
        matrix = self.matrix
        if outer.matrix != IDENTITY:
            matrix = rows_of(outer.transform @ self.transform)
        colour = outer.colour or self.colour
        if outer.colour and self.colour:
            first, then = (np.array(rows).reshape(3, 4) for rows in (self.colour, outer.colour))
            both = then[:, :3] @ first
            both[:, 3] += then[:, 3]
            colour = tuple(both.ravel().tolist())
        return Placement(matrix, self.opacity * outer.opacity, colour, self.frame)


State = tuple[Placement, ...]
"""Placements of all models of a shot at a time."""


class Track(Protocol):
    """The placement of a model over time."""

    def at(self, frame: float) -> Placement:
        """The placement at a frame, which need not be whole. Raises InputError for one that cannot be."""

    @property
    def reach(self) -> tuple[float, float] | None:
        """The first and the last frame at which the source says where the model is; None for one that stands still."""


@dataclass(frozen=True, eq=False)
class Changing:
    """The `Track` of a model that changes, at the same frames as it is placed."""

    inner: Track

    def at(self, frame: float) -> Placement:
        """The placement, with the frame of the Gaussians."""
        return replace(self.inner.at(frame), frame=float(frame))

    @property
    def reach(self) -> tuple[float, float] | None:
        """That of the placement."""
        return self.inner.reach


def rows_of(matrix: Float64) -> tuple[float, ...]:
    """The first three rows of (4, 4), in the order of a `Placement`."""
    return tuple(float(value) + 0.0 for value in matrix[:3].ravel())  # + 0.0: no -0, which would be another state


def grade(gain: Float64, offset: Float64, saturation: float) -> tuple[float, ...]:
    """The colour of a `Placement`: gain (3,) and offset (3,), then the saturation: ASC CDL without its
    power; none where nothing changes."""
    if (gain == 1).all() and (offset == 0).all() and saturation == 1:
        return ()
    spread = saturation * np.eye(3) + (1 - saturation) * LUMA
    return tuple(np.column_stack([spread * gain, spread @ offset]).ravel().tolist())


def checked(placement: Placement, where: str) -> Placement:
    """The placement. Raises InputError, which begins with `where`, for a transform that Gaussians cannot follow."""
    try:
        decompose(placement.transform, SLACK)
    except InputError as error:
        raise InputError(f"{where}: has {error}") from None
    return placement


def placed(gaussians: Gaussians, placement: Placement) -> Gaussians:
    """The model at its place. What is not changed keeps its bits. Raises InputError as `edit.transform`."""
    moved = gaussians
    if placement.matrix != IDENTITY:
        moved = transform(gaussians, placement.transform, SLACK)
    if placement.colour:
        rows = np.array(placement.colour).reshape(3, 4)
        moved = graded(moved, rows[:, :3], rows[:, 3])
    return faded(moved, placement.opacity)


def gone_on(track: Track, frame: float, end: float) -> Placement:
    """The placement of a track at a frame beyond `end`, after it or before it. Where its source says no more it goes on
    as it did up to there: for a frame its motion mirrored, which at the whole one is the same motion once more, and so
    on from frame to frame.

    So do cameras (`shots.motion`). Opacity and colour are the track's own. Raises InputError for a transform that no
    longer can be undone.
    """
    if (reach := track.reach) is None or reach[0] <= frame <= reach[1]:
        return track.at(frame)
    way, place, now = (1 if frame > end else -1), track.at(frame), track.at(end)
    steps = ceil(abs(frame - end)) - 1
    matrix = _step(now, track.at(2 * end - (frame - steps * way))) @ now.transform
    for _ in range(steps):
        matrix = _step(now, track.at(end - way)) @ matrix
    rows = now.matrix if np.array_equal(matrix, now.transform) else rows_of(matrix)
    return checked(replace(place, matrix=rows), f"a model that goes on beyond frame {end:g}")


def _step(now: Placement, before: Placement) -> Float64:
    """The similarity (4, 4) from one placement to a later one, without what its axes are off right angles."""
    matrix = np.eye(4)
    if now.matrix != before.matrix:
        (scale, turn, shift), (scale_before, turn_before, shift_before) = (
            decompose(placement.transform, SLACK) for placement in (now, before)
        )
        matrix[:3, :3] = scale / scale_before * turn @ turn_before.T
        matrix[:3, 3] = shift - matrix[:3, :3] @ shift_before
    return matrix


def kind_of(model: Gaussians | Series) -> Gaussians:
    """A model that is drawn as this one: itself, or of one that changes one of no Gaussians."""
    return model.kind if isinstance(model, Series) else model


def near_of(models: Sequence[Gaussians | Series], state: State) -> float:
    """The near plane of the models in this state, hidden ones too: the least of theirs."""
    return min(
        model.near if placement.matrix == IDENTITY else decompose(placement.transform, SLACK)[0] * model.near
        for model, placement in zip(map(kind_of, models), state, strict=True)
    )


class Ensemble:
    """All models of a shot as one, of states that follow each other: what stays is made once. One thread's."""

    def __init__(self, models: Sequence[Gaussians | Series]) -> None:
        self.models = tuple(models)
        self._placed: list[tuple[Placement, Gaussians] | None] = [None] * len(self.models)
        self._last: tuple[State, Gaussians] | None = None

    def at(self, state: State) -> Gaussians:
        """The models in this state, merged in their order; hidden ones are among them, so that a Gaussian keeps its
        row. The same object for the same state twice running."""
        if self._last is None or self._last[0] != state:
            self._last = None  # its memory is free before the next takes some
            self._last = state, merge([self._one(index, placement) for index, placement in enumerate(state)])
        return self._last[1]

    def moved(self, state: State, after: State) -> Gaussians | None:
        """Gaussians with the means that those of `state` have in the state `after`; None where nothing moves."""
        if [(now.matrix, now.frame) for now in state] == [(then.matrix, then.frame) for then in after]:
            return None
        moved = []
        for model, now, then in zip(self.models, state, after, strict=True):
            if isinstance(model, Series):
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
            if isinstance(model, Series):
                assert placement.frame is not None
                model = model.at(placement.frame)
            before = self._placed[index] = placement, placed(model, placement)
        return before[1]
