# SPDX-License-Identifier: Apache-2.0
"""Base class of the appearance models, which learn the colours of each photograph together with the model."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import replace
from pathlib import Path
from typing import Any

from numpy.typing import NDArray

from clsplat.runs.run import Run
from clsplat.training.step.component import Component, Named
from clsplat.training.step.inputs import ViewInputs, ViewPart


class Appearance(Component):
    """Appearance model of the training photographs. This base class learns nothing and leaves colours unchanged."""

    @property
    def on(self) -> bool:
        """True if appearance is learnt, as in every subclass."""
        return type(self) is not Appearance

    def of_views(self, views: Sequence[int], step: int) -> Sequence[ViewPart]:  # noqa: ARG002
        """Return, for each view of a step, the part (`ViewPart`) that learns its appearance; () if nothing is learnt.

        views: indices of the step's views among the training views.
        step: number of views that training has used, including the views of this step.
        """
        return ()

    def join(self, inputs: Sequence[ViewInputs], step: int, count: int) -> Sequence[ViewInputs]:  # noqa: ARG002
        """Return `inputs`. Each view has the part that learns its appearance in addition to its other parts.

        step: number of views that training has used, including the views of this step.
        count: number of Gaussians; not used.
        """
        shares = self.of_views([each.view for each in inputs], step)
        if not shares:
            return inputs
        return [replace(each, parts=(*each.parts, share)) for each, share in zip(inputs, shares, strict=True)]

    def begin_from(self, folder: Path, *, keeps_lenses: bool) -> None:
        """Begin with the appearance that the files in `folder` have for the photographs of the same names. Its mean
        over these photographs stays.

        keeps_lenses: True if the lenses' part of the appearance is not trained. Photographs that count in one region
            only do not tell a vignette from the region's own shades.
        Raises InputError if the files do not have this appearance of all training photographs.
        """

    def record(self) -> dict[str, Any] | None:
        """Return the content of appearance.json; None if no appearance is learnt."""
        return None

    def tables(self) -> dict[str, NDArray[Any]]:
        """Return the arrays of appearance.npz, by name; {} if no such file is written."""
        return {}

    def load(self, named: Named, step: int, count: int) -> None:  # noqa: ARG002
        """Load the appearance from a checkpoint. Raises ValueError for arrays of other photographs.

        named: function from a prefix to the checkpoint's arrays whose names have this prefix.
        step, count: step and number of Gaussians of the checkpoint; not used.
        """
        self.take(named("appearance/"))

    def take(self, arrays: Mapping[str, NDArray[Any]]) -> None:
        """Load the appearance from a checkpoint's `arrays`, by name without "appearance/". Raises ValueError for arrays
        of other photographs."""

    def write(self, run: Run) -> None:
        """Write `record` as appearance.json and `tables` as appearance.npz into the run's folder; nothing if `record`
        is None."""
        if (record := self.record()) is not None:
            run.write_appearance(record, self.tables())
