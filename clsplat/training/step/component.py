# SPDX-License-Identifier: Apache-2.0
"""Components of a training in addition to the Gaussians: appearance, refined cameras, mip filter, known depths, late
Adam, chunks in view.

`Trainer` loops over a list of components. A new one is a subclass of `Component` and a line in `Trainer._start`.
"""

from __future__ import annotations

from collections.abc import Callable, Mapping, Sequence
from typing import Any

from numpy.typing import NDArray

from clsplat.device.buffers import DeviceArray
from clsplat.runs.run import Run
from clsplat.stages.device_gaussians import AnyGaussians, HostArray
from clsplat.training.step.inputs import ViewInputs

Named = Callable[[str], Mapping[str, Any]]
"""Arrays of a checkpoint by the rest of their names. Those of the Gaussians may be files that are read by slices."""
"""Arrays of a checkpoint whose names have a prefix, by name without the prefix."""


class Component:
    """Component of a training, with state of its own. By default no method does anything."""

    @property
    def on(self) -> bool:
        """False if the settings do without it: no step asks it for anything."""
        return True

    @property
    def models(self) -> int:
        """Number of arrays that the device needs for each parameter; 0 if the usual number is enough."""
        return 0

    @property
    def row_bytes(self) -> int:
        """Bytes per Gaussian on the device."""
        return 0

    @property
    def pixel_bytes(self) -> int:
        """Bytes per pixel on the device."""
        return 0

    @property
    def reads_all_rows(self) -> bool:
        """True if `before_step` wants every postponed change to the Gaussians made."""
        return True

    def is_due(self, step: int, views: int) -> bool:  # noqa: ARG002
        """True if `before_step` has work before a step of `views` views that ends with view number `step`."""
        return False

    def before_step(self, gaussians: AnyGaussians) -> None:
        """Do the work that is due. A second call must not change anything more."""

    def join(self, inputs: Sequence[ViewInputs], step: int, count: int) -> Sequence[ViewInputs]:  # noqa: ARG002
        """Views of a step, each with the component's part in it (`ViewPart`).

        step: number of the last view.
        count: number of Gaussians.
        """
        return inputs

    def after_adam(self, gaussians: AnyGaussians) -> None:
        """Change the parameters after Adam's step."""

    def step_back(self, step: int) -> None:
        """Return to the state after step number `step`: later ones have failed before they changed a Gaussian."""

    def complete_exactly(self, parameters: AnyGaussians, first: AnyGaussians, second: AnyGaussians) -> None:
        """Make the postponed changes that may be made at any time, because they give the same bits."""

    def complete(self, parameters: AnyGaussians, first: AnyGaussians, second: AnyGaussians) -> None:
        """Make all changes to the parameters and their moments that are postponed, because all rows are now needed."""
        self.complete_exactly(parameters, first, second)

    def completed(self, parameters: AnyGaussians, first: AnyGaussians, second: AnyGaussians) -> AnyGaussians:  # noqa: ARG002
        """The parameters as `complete` would leave them, without changing any array."""
        return parameters

    def rows_changed(self) -> None:
        """Forget data about the values of Gaussians, which have changed between two steps."""

    def rows_moved(self, listed: DeviceArray | HostArray) -> None:
        """Follow rows that have moved, or forget data about individual rows.

        listed: the old row of each row, or FRESH (`DeviceRowList`).
        """

    def arrays(self) -> dict[str, NDArray[Any]]:
        """Arrays of a checkpoint, by name."""
        return {}

    def load(self, named: Named, step: int, count: int) -> None:
        """Load the arrays of a checkpoint of `count` Gaussians after `step` views. Raises ValueError for arrays of
        other views."""

    def write(self, run: Run) -> None:
        """Write the files of a finished training."""
