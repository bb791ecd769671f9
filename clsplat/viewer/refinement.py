# SPDX-License-Identifier: Apache-2.0
"""Refinement of a viewer's pictures: coarse ones in motion, exact ones at rest, shares of a training.

No OpenCL and no viser. Times are seconds of any clock that does not go back.
"""

from __future__ import annotations

import math
from dataclasses import dataclass

SETTLE = (0.2, 1.0)
"""Seconds without a change after which a picture is refined: at least; at most, where a slow browser's camera jumps."""
START = 0.5
"""The same for the first picture of all, which the browser has to get ready to show."""
JUMPS = 3.0
"""A camera is at rest when it has not changed for this many times its usual interval."""
TARGET = 0.04
"""Seconds that a picture in motion may take, with its encoding: what the browser needs comes on top."""
PATIENCE = 0.6
"""An exact picture that takes longer is led up to by pictures of growing size."""
SMALLEST = 1 / 8
"""Smallest scale of the page's size: a coarser picture would not be told apart from another."""
QUALITIES = (60, 95)
"""Qualities of JPEG, in motion and at rest."""
SHARES = (0.2, 0.05)
"""Shares of the time of a training: while a viewer moves, and while all are at rest."""


@dataclass(frozen=True)
class Level:
    """A picture that is due: its size in relation to the page's, and whether it is the last, which is exact."""

    scale: float
    exact: bool

    @property
    def quality(self) -> int:
        """Quality of JPEG."""
        return QUALITIES[self.exact]


def next_scale(scale: float, seconds: float) -> float:
    """The scale at which a picture in motion comes nearer to the time that it may take, after one of `scale` took
    `seconds`. Part of that does not shrink with the pixels, so that the size is found step by step."""
    factor = math.sqrt(TARGET / max(seconds, 1e-4))
    return min(max(scale * min(max(factor, 0.6), 1.2), SMALLEST), 1.0)


class Refinement:
    """The picture that a viewer sees, and the next one: coarse in motion, finer at rest, exact in the end."""

    def __init__(self, now: float) -> None:
        self.scale = 0.25
        self.served = -math.inf
        self.changes, self._at = 1, now
        self._settle = START
        self._shown = 0
        self._model = 0
        self._level = Level(0.0, exact=False)
        self._exact_takes = 0.0

    @property
    def moving(self) -> bool:
        """True if the picture shown is not the one asked for."""
        return self._shown != self.changes

    def changed(self, now: float) -> None:
        """The camera, or how the model is looked at."""
        apart = now - self._at
        usual = JUMPS * apart if self.changes > 1 and apart < SETTLE[1] else 0.0
        before = self._settle if self.changes > 1 else 0.0
        self._settle = min(max(0.7 * before + 0.3 * usual, SETTLE[0]), SETTLE[1])
        self.changes += 1
        self._at = now

    def due(self, now: float, model: int = 0) -> Level | None:
        """The next picture, if its time has come; model: counts its changes, while it is trained."""
        if self.wait(now, model) != 0:
            return None
        if self.moving:
            return Level(self.scale, exact=False)
        if self._level.exact or self._exact_takes <= PATIENCE or self._level.scale >= 0.5:
            return Level(1.0, exact=True)
        return Level(2 * self._level.scale, exact=False)

    def wait(self, now: float, model: int = 0) -> float | None:
        """Seconds until something is due, None if nothing will be by itself."""
        if self.moving:
            return 0.0
        if self._level.exact and self._model == model:
            return None
        return max(0.0, self._at + self._settle - now)

    def shown(self, begun: int, level: Level, seconds: float, now: float, model: int = 0) -> None:
        """A picture has been sent that took so long; begun: the number of `changes` before it was made."""
        if level.exact:
            self._exact_takes = seconds
        elif self._shown != begun:
            self.scale, self._exact_takes = next_scale(level.scale, seconds), max(self._exact_takes, seconds)
        self._shown, self._level, self._model, self.served = begun, level, model, now


class Share:
    """Keeps pictures to a share of a training's time."""

    def __init__(self, shares: tuple[float, float] = SHARES) -> None:
        self._moving, self._still = shares
        self._end, self._seconds = -math.inf, 0.0

    def ready(self, now: float, *, moving: bool) -> bool:
        """True if another picture may be made."""
        share = self._moving if moving else self._still
        return now - self._end >= self._seconds * (1 - share) / share

    def spent(self, now: float, seconds: float) -> None:
        """A picture took so long, and is done now."""
        self._end, self._seconds = now, seconds
