# SPDX-License-Identifier: Apache-2.0
"""Base class of the appearance models, which learn the colours of each photograph together with the model."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import replace
from typing import Any

from numpy.typing import NDArray

from clsplat.runs.run import Run
from clsplat.training.step.component import Component, Named
from clsplat.training.step.inputs import ViewInputs, ViewPart


class Appearance(Component):
    """Appearance model of the training photographs. This base class learns nothing and leaves colours unchanged."""

    @property
    def on(self) -> bool:
        """True if appearance is learnt: for every subclass."""
        return type(self) is not Appearance

    def of_views(self, views: Sequence[int], step: int) -> Sequence[ViewPart]:  # noqa: ARG002
        """Appearance of each view of a step. The list is empty if the views have the model's own colours.

        step: number of the last view.
        """
        return ()

    def join(self, inputs: Sequence[ViewInputs], step: int, count: int) -> Sequence[ViewInputs]:  # noqa: ARG002
        """Return the views, each with its appearance among its parts."""
        shares = self.of_views([each.view for each in inputs], step)
        if not shares:
            return inputs
        return [replace(each, parts=(*each.parts, share)) for each, share in zip(inputs, shares, strict=True)]

    def record(self) -> dict[str, Any] | None:
        """Content of appearance.json; None if there is nothing to write."""
        return None

    def tables(self) -> dict[str, NDArray[Any]]:
        """Arrays of appearance.npz, by name; empty if there is no such file."""
        return {}

    def load(self, named: Named, step: int, count: int) -> None:  # noqa: ARG002
        """Load the arrays of a checkpoint. Raises ValueError for arrays of other photographs."""
        self.take(named("appearance/"))

    def take(self, arrays: Mapping[str, NDArray[Any]]) -> None:
        """Load the arrays of a checkpoint, by name without "appearance/"."""

    def write(self, run: Run) -> None:
        """Write appearance.json and appearance.npz into the run's folder, as far as there is content for them."""
        if (record := self.record()) is not None:
            run.write_appearance(record, self.tables())
