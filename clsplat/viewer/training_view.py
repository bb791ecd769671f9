# SPDX-License-Identifier: Apache-2.0
"""Viewer of `clsplat train --view`: pictures are rendered between training steps, in a limited fraction of the time.

The fraction is VIEWER_TIME_FRACTIONS of `viewer.refinement`.
"""

from __future__ import annotations

import math
from collections.abc import Callable
from typing import TYPE_CHECKING

from clsplat.process import MAX_SIGNAL_WAIT_SECONDS
from clsplat.viewer.models import LiveModel
from clsplat.viewer.refinement import Share
from clsplat.viewer.scheduler import Viewing
from clsplat.viewer.server import Server

if TYPE_CHECKING:
    from clsplat.training.trainer import Trainer


STATUS_INTERVAL_SECONDS = 0.5
"""Seconds between updates of the training's state on the pages."""


class TrainingView:
    """Hook that `clsplat.api.train` calls between two steps, to render pictures for all viewers.

    last: number of the last training step, for the progress text.
    """

    def __init__(self, viewing: Viewing, server: Server, background: tuple[float, float, float], last: int) -> None:
        self.viewing, self.server, self.background, self.last = viewing, server, background, last
        self.share = Share()
        self._told_at = -math.inf

    def __call__(self, trainer: Trainer, interrupted: Callable[[], bool]) -> None:
        """Render a picture if it is due, and wait while training is paused.

        interrupted: function that returns True when training must end.
        """
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
                viewing.wait(MAX_SIGNAL_WAIT_SECONDS)

    def _tell(self, trainer: Trainer, *, force: bool = False) -> None:
        now = self.viewing.clock()
        if force or now - self._told_at > STATUS_INTERVAL_SECONDS:
            state = "paused" if self.server.paused else "training"
            self.server.tell(f"{state}: step {trainer.step:,} of {self.last:,}, {trainer.parameters.count:,} Gaussians")
            self._told_at = now
