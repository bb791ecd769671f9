# SPDX-License-Identifier: Apache-2.0
"""Refinement of lenses (--refine-lenses): focal lengths and principal points, learnt with the model."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import replace
from typing import Any

import numpy as np
from numpy.typing import NDArray

from clsplat.arrays import Float64
from clsplat.camera import Camera
from clsplat.config.training import TrainConfig
from clsplat.scenes.dataset import Lens
from clsplat.scenes.scene import View
from clsplat.training.cameras.poses import checked_arrays, descend, fallen, first_step

LENS_PARAMETERS = 3
"""Number of parameters of a lens: a common change of ln fx and ln fy, and changes of cx and cy in focal lengths."""


class RefinedLenses:
    """Refined lenses of the training views. Views of one lens share its change. Without refinement no lens changes."""

    def __init__(self, config: TrainConfig, views: Sequence[View]) -> None:
        self.on, self._config = config.refine_lenses, config
        self._rows: dict[Lens, int] = {}
        if not self.on:
            return
        self._rows = {lens: row for row, lens in enumerate(dict.fromkeys(view.lens for view in views))}
        self._of_view = [self._rows[view.lens] for view in views]
        self._start, count = first_step(config), len(self._rows)
        self._shares = np.bincount(self._of_view) / len(views)
        self.changes = np.zeros((count, LENS_PARAMETERS))
        # `descend` works on six parameters. A lens has three of them; the moments of the others stay 0.
        self._first, self._second = np.zeros((count, 6)), np.zeros((count, 6, 6))
        self._visits = np.zeros(count, np.int64)

    def moves(self, step: int) -> bool:
        """True if step number `step` refines lenses."""
        return self.on and step > self._start

    def move(self, view: int, step: int, camera: Camera, gradient: Float64) -> None:
        """Take Adam's step for the lens of training view `view`. A gradient that is not finite causes no step.

        step: number of the training step, by which the learning rate falls.
        camera: the camera with which the gradient was computed.
        gradient: (4,), with respect to ln fx, ln fy, cx and cy.
        """
        if not np.isfinite(gradient).all():
            return
        lens, by = self._of_view[view], np.zeros(6)
        by[:LENS_PARAMETERS] = gradient[0] + gradient[1], camera.fx * gradient[2], camera.fy * gradient[3]
        self._visits[lens] += 1
        down = descend(self._first[lens], self._second[lens], by, int(self._visits[lens]))[:LENS_PARAMETERS]
        steps = self._config.iterations - self._start
        part = (step - self._start) / steps
        rate = fallen(self._config.lens_reach / 100, part, steps * float(self._shares[lens]))
        self.changes[lens] += rate * down

    def _change(self, lens: Lens) -> tuple[float, float, float] | None:
        """Change of a lens (`LENS_PARAMETERS`), as arguments of `Camera.refocused`; None if the lens is not refined."""
        row = self._rows.get(lens)
        return None if row is None else tuple(self.changes[row].tolist())

    def seen(self, lens: Lens, camera: Camera) -> Camera:
        """`camera` with the refined intrinsics of its lens; the same object if the lens is not refined."""
        change = self._change(lens)
        return camera if change is None else camera.refocused(*change)

    def refined(self, lens: Lens) -> Lens:
        """The lens with its refined intrinsics; the same object if it is not refined."""
        change = self._change(lens)
        return lens if change is None else lens.refocused(*change)

    @property
    def largest(self) -> float:
        """Largest change of a focal length or principal point, as a fraction of the focal length."""
        return float(np.abs(self.changes).max()) if self.on else 0.0

    def arrays(self) -> dict[str, NDArray[Any]]:
        """Changes of the lenses and Adam's moments, keyed by their names in a checkpoint."""
        if not self.on:
            return {}
        moments = {"lenses/first": self._first, "lenses/second": self._second, "lenses/visits": self._visits}
        return {"lenses/changes": self.changes, **moments}

    def load(self, arrays: Mapping[str, NDArray[Any]]) -> None:
        """Load the lenses from a checkpoint's arrays, by name without "lenses/". Raises ValueError for other lenses."""
        if not self.on:
            return
        values = checked_arrays(self.arrays(), arrays, "lenses/")
        self.changes, self._visits = values["changes"], values["visits"]
        self._first, self._second = values["first"], values["second"]

    def of_views(self, views: Sequence[View]) -> list[View]:
        """Copies of held-out views whose cameras have the refined lenses, for rendering."""
        return [replace(view, camera=self.seen(view.lens, view.camera)) for view in views] if self.on else list(views)
