# SPDX-License-Identifier: Apache-2.0
"""Base class of the components of a training, its parts in addition to the Gaussians.

Components are appearance, refined cameras, the mip filter, known depths, late Adam, and chunks in view.

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
"""Function of a prefix. It returns the arrays of a checkpoint whose names have the prefix, by name without it.

Arrays of the Gaussians may be in a scratch file. Slices of them are then read from the file.
"""


class Component:
    """Component of a training, with state of its own. By default no method does anything."""

    @property
    def on(self) -> bool:
        """True if the settings use the component. Otherwise no step calls it."""
        return True

    @property
    def models(self) -> int:
        """Number of arrays that the device needs for each parameter of the model; 0 if the usual number is enough."""
        return 0

    @property
    def row_bytes(self) -> int:
        """Bytes per Gaussian that the component takes on the device."""
        return 0

    @property
    def pixel_bytes(self) -> int:
        """Bytes per pixel that the component takes on the device."""
        return 0

    @property
    def reads_all_rows(self) -> bool:
        """True if all postponed changes to Gaussians must be made before `before_step`."""
        return True

    def is_due(self, step: int, views: int) -> bool:  # noqa: ARG002
        """True if `before_step` has work to do before a step of the training.

        step: number of the last view of this step, counted from the start of the training.
        views: number of views of this step.
        """
        return False

    def before_step(self, gaussians: AnyGaussians) -> None:
        """Do the work that is due before a step. A second call before the same step must change nothing more."""

    def join(self, inputs: Sequence[ViewInputs], step: int, count: int) -> Sequence[ViewInputs]:  # noqa: ARG002
        """Return the views of a step, each with the component's part in it (`ViewPart`).

        step: number of the last view.
        count: number of Gaussians.
        """
        return inputs

    def after_adam(self, gaussians: AnyGaussians) -> None:
        """Change the parameters after Adam's step."""

    def step_back(self, step: int) -> None:
        """Return to the state after step number `step`. Later steps failed before they changed a Gaussian."""

    def complete_exactly(self, parameters: AnyGaussians, first: AnyGaussians, second: AnyGaussians) -> None:
        """Make those postponed changes to parameters and moments whose bits do not depend on when they are made."""

    def complete(self, parameters: AnyGaussians, first: AnyGaussians, second: AnyGaussians) -> None:
        """Make all postponed changes to parameters and moments. Called when every row is needed."""
        self.complete_exactly(parameters, first, second)

    def completed(self, parameters: AnyGaussians, first: AnyGaussians, second: AnyGaussians) -> AnyGaussians:  # noqa: ARG002
        """Return the parameters with all postponed changes, but leave the arrays unchanged."""
        return parameters

    def rows_changed(self, groups: set[str]) -> None:
        """Forget data that depends on these parameter groups, because density control or a repair has changed
        parameters in them."""

    def rows_moved(self, listed: DeviceArray | HostArray) -> None:
        """Move data of individual Gaussians along with their rows, or forget it.

        listed: (m,), for each new row the row that it is copied from, with the bit FRESH set if it is new.
        """

    def arrays(self) -> dict[str, NDArray[Any]]:
        """Arrays of the component's state, keyed by their names in a checkpoint."""
        return {}

    def load(self, named: Named, step: int, count: int) -> None:
        """Load the state from a checkpoint of `count` Gaussians after `step` views. Raises ValueError for other views.

        named: function from a prefix to the checkpoint's arrays whose names have this prefix (`Named`).
        """

    def write(self, run: Run) -> None:
        """Write the component's files of a finished training into the run's folder."""
