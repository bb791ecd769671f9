# SPDX-License-Identifier: Apache-2.0
"""Refinement of a viewer's pictures: coarse while the camera moves, exact at rest. While a model is trained, pictures
take a limited fraction of the time.

This module uses neither OpenCL nor viser. Times are in seconds, from any monotonic clock.
"""

from __future__ import annotations

import math
from dataclasses import dataclass

SETTLE_SECONDS_RANGE = (0.2, 1.0)
"""Minimum and maximum of the seconds without a change after which refinement begins. Slow browsers need more."""
FIRST_SETTLE_SECONDS = 0.5
"""Seconds before the first refinement. In this time the browser gets ready to show pictures."""
REST_INTERVAL_RATIO = 3.0
"""A camera is at rest if it has not changed for this multiple of the usual interval between changes."""
MOTION_PICTURE_SECONDS = 0.04
"""Time in seconds that a picture of a moving camera should take, with encoding but without the browser."""
MAX_UNPREPARED_EXACT_SECONDS = 0.6
"""Seconds that exact pictures may take. If they take longer, pictures of growing size are shown between the coarse and
the exact one."""
MIN_MOTION_SCALE = 1 / 8
"""Minimum size of a picture relative to the page. A smaller picture would not be recognisable."""
PAGE_JPEG_QUALITIES = (60, 95)
"""JPEG quality of coarse and of exact pictures."""
VIEWER_TIME_FRACTIONS = (0.2, 0.05)
"""Maximum fractions of a training's time for pictures: while a viewer moves, and while all are at rest."""


@dataclass(frozen=True)
class Level:
    """Size and exactness of a picture.

    scale: size of the picture relative to the page.
    exact: True for the last picture of a refinement.
    """

    scale: float
    exact: bool

    @property
    def quality(self) -> int:
        """JPEG quality of the picture, from 0 to 100."""
        return PAGE_JPEG_QUALITIES[self.exact]


def next_scale(scale: float, seconds: float) -> float:
    """Return the scale (resolution) of a moving camera's next picture, after a picture of `scale` took `seconds`.

    The scale approaches, in limited steps, the one at which a picture takes MOTION_PICTURE_SECONDS. The steps are
    limited because a part of the time does not depend on the number of pixels.
    """
    factor = math.sqrt(MOTION_PICTURE_SECONDS / max(seconds, 1e-4))
    return min(max(scale * min(max(factor, 0.6), 1.2), MIN_MOTION_SCALE), 1.0)


class Refinement:
    """State of a viewer's refinement. Pictures are coarse while the camera moves, then finer, and finally exact."""

    def __init__(self, now: float) -> None:
        self.scale = 0.25
        self.served = -math.inf
        self.changes, self._at = 1, now
        self._settle = FIRST_SETTLE_SECONDS
        self._shown = 0
        self._model = 0
        self._level = Level(0.0, exact=False)
        self._exact_takes = 0.0

    @property
    def moving(self) -> bool:
        """True if the displayed picture is older than the last change of camera or `Look`."""
        return self._shown != self.changes

    def changed(self, now: float) -> None:
        """Record a change of the camera or the `Look` (appearance settings)."""
        apart = now - self._at
        usual = REST_INTERVAL_RATIO * apart if self.changes > 1 and apart < SETTLE_SECONDS_RANGE[1] else 0.0
        before = self._settle if self.changes > 1 else 0.0
        self._settle = min(max(0.7 * before + 0.3 * usual, SETTLE_SECONDS_RANGE[0]), SETTLE_SECONDS_RANGE[1])
        self.changes += 1
        self._at = now

    def due(self, now: float, model: int = 0) -> Level | None:
        """Return size and exactness of the next picture if it is due now, otherwise None.

        model: version number of the model, which changes in training.
        """
        if self.wait(now, model) != 0:
            return None
        if self.moving:
            return Level(self.scale, exact=False)
        if self._level.exact or self._exact_takes <= MAX_UNPREPARED_EXACT_SECONDS or self._level.scale >= 0.5:
            return Level(1.0, exact=True)
        return Level(2 * self._level.scale, exact=False)

    def wait(self, now: float, model: int = 0) -> float | None:
        """Return the seconds until a picture is due; None if none is due until camera, `Look` or model changes."""
        if self.moving:
            return 0.0
        if self._level.exact and self._model == model:
            return None
        return max(0.0, self._at + self._settle - now)

    def shown(self, begun: int, level: Level, seconds: float, now: float, model: int = 0) -> None:
        """Record that a picture was sent to the page.

        begun: the value of `changes` when rendering of the picture began.
        seconds: time for rendering and encoding.
        """
        if level.exact:
            self._exact_takes = seconds
        elif self._shown != begun:
            self.scale, self._exact_takes = next_scale(level.scale, seconds), max(self._exact_takes, seconds)
        self._shown, self._level, self._model, self.served = begun, level, model, now


class Share:
    """Limit on the fraction of a training's time that pictures take.

    shares: the fractions while a viewer moves, and while all are at rest.
    """

    def __init__(self, shares: tuple[float, float] = VIEWER_TIME_FRACTIONS) -> None:
        self._moving, self._still = shares
        self._end, self._seconds = -math.inf, 0.0

    def ready(self, now: float, *, moving: bool) -> bool:
        """True if another picture may be rendered now. moving: True if a viewer's camera moves."""
        share = self._moving if moving else self._still
        return now - self._end >= self._seconds * (1 - share) / share

    def spent(self, now: float, seconds: float) -> None:
        """Record that a picture took `seconds` and was finished at `now`."""
        self._end, self._seconds = now, seconds
