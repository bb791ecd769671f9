# SPDX-License-Identifier: Apache-2.0
"""The page of a training: pictures between its steps, within a share of its time."""

from __future__ import annotations

import math
from collections.abc import Callable
from typing import TYPE_CHECKING

from clsplat.viewer.models import LiveModel
from clsplat.viewer.refinement import Share
from clsplat.viewer.scheduler import Viewing
from clsplat.viewer.server import Server

if TYPE_CHECKING:
    from clsplat.training.trainer import Trainer


LONGEST_WAIT = 0.5
"""Seconds, so that a signal is seen to on systems where it does not end a wait."""
TELL_EVERY = 0.5
"""Seconds between words of a training on its page."""


class TrainingView:
    """The viewer's part of `clsplat.api.train`, called between two steps: pictures for all viewers, within their
    share."""

    def __init__(self, viewing: Viewing, server: Server, background: tuple[float, float, float], last: int) -> None:
        self.viewing, self.server, self.background, self.last = viewing, server, background, last
        self.share = Share()
        self._told_at = -math.inf

    def __call__(self, trainer: Trainer, interrupted: Callable[[], bool]) -> None:
        """Show pictures; returns at once where there are no viewers."""
        viewing = self.viewing
        if viewing.model is None:
            viewing.model = LiveModel(trainer, self.background)
        if not len(viewing) and not self.server.paused:
            return
        viewing.work(self.share)
        self._tell(trainer)
        while self.server.paused and not interrupted():
            self._tell(trainer, force=True)
            if not viewing.work():
                viewing.wait(LONGEST_WAIT)

    def _tell(self, trainer: Trainer, *, force: bool = False) -> None:
        now = self.viewing.clock()
        if force or now - self._told_at > TELL_EVERY:
            state = "paused" if self.server.paused else "training"
            self.server.tell(f"{state}: step {trainer.step:,} of {self.last:,}, {trainer.parameters.count:,} Gaussians")
            self._told_at = now
