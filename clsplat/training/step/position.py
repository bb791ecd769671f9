# SPDX-License-Identifier: Apache-2.0
"""Position of a training: step, random state and views left in the epoch. It is the JSON state of a checkpoint."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import asdict, dataclass, field
from typing import Any

import numpy as np

from clsplat.runs.checkpoints import Checkpoint, unusable
from clsplat.training.stability.health import RetryBudget


@dataclass
class Mark:
    """Copy of a `Position` and of the random generator's state, at a point where a checkpoint can be written."""

    step: int
    rng: Mapping[str, Any]
    queue: list[int]
    controlled: bool


@dataclass
class Position:
    """Position of a training: step, random generator, and views left in the epoch.

    step: number of views that training has used so far.
    queue: indices of the views left in the epoch, the next one last.
    controlled: True if the density control before the next step has been done.
    last_views: number of views of the last step.
    """

    _rng: np.random.Generator
    step: int = 0
    queue: list[int] = field(default_factory=list)
    controlled: bool = False
    last_views: int = 1
    _rng_state: Mapping[str, Any] | None = None

    @property
    def rng(self) -> np.random.Generator:
        """Random generator. Reading it drops the saved copy of its state, because the caller may draw numbers."""
        self._rng_state = None
        return self._rng

    def mark(self, *, begun: bool = False) -> Mark:
        """Return a copy of this position, with the state of the random generator.

        begun: True if the step number has already been increased for the current step, which has one view.
        """
        self._rng_state = self._rng_state or self._rng.bit_generator.state
        return Mark(self.step - begun, self._rng_state, list(self.queue), self.controlled)

    def go_back(self, mark: Mark) -> None:
        """Return to the position that `mark` copied, with its random state."""
        self.step, self.queue, self.controlled = mark.step, list(mark.queue), mark.controlled
        self.rng.bit_generator.state = mark.rng

    def state(self, retries: RetryBudget) -> dict[str, Any]:
        """Position and `retries` as JSON state of a checkpoint."""
        state = {"rng": self.rng.bit_generator.state, "queue": self.queue, "patience": asdict(retries)}
        views = {"views": self.last_views} if self.last_views > 1 else {}
        return {**state, **views, **({"controlled": True} if self.controlled else {})}

    def load(self, checkpoint: Checkpoint, views: int) -> RetryBudget:
        """Continue from a checkpoint, in a scene with `views` training views. Returns the checkpoint's `RetryBudget`.

        Raises InputError for a state that cannot be read.
        """
        try:
            self.rng.bit_generator.state = checkpoint.state["rng"]
            queue = list(checkpoint.state["queue"])
            if not all(type(index) is int and index >= 0 for index in queue):
                raise ValueError(f"the queue of views begins with {queue[:3]}, expected indices from 0 on")
            retries = RetryBudget(**checkpoint.state.get("patience", {}))
            last_views = checkpoint.state.get("views", 1)
            if type(last_views) is not int or not 1 <= last_views <= max(checkpoint.step, 1):
                raise ValueError(f"the last step had {last_views!r:.20} views, expected 1 to {max(checkpoint.step, 1)}")
        except (KeyError, TypeError, ValueError, IndexError) as error:
            why = f"{type(error).__name__}: {error}"
            raise unusable(checkpoint, f"its state cannot be read ({why})") from None
        self.step, self.last_views = checkpoint.step, last_views
        self.queue = queue if max(queue, default=0) < views else []  # if there are fewer views now, begin an epoch
        self.controlled = bool(checkpoint.state.get("controlled", False))
        return retries
