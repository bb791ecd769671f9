# SPDX-License-Identifier: Apache-2.0
"""Launches the kernels of colour models and of their update by Adam (appearance.cl).

A colour model removes a photograph's own colours. To add a colour model, add a row to COLOUR_MODELS
(config/colour_models.py), and a kernel file and a twin with the model's name.
"""

from __future__ import annotations

from dataclasses import dataclass
from typing import TYPE_CHECKING

import numpy as np
from numpy.typing import NDArray

from clsplat.config.colour_models import ColourModel
from clsplat.device.buffers import DeviceArray, Workspace, allocate, upload
from clsplat.device.context import Device
from clsplat.device.launch import launch_grid, launch_items
from clsplat.device.profile import stage
from clsplat.layouts.columns import TILE

if TYPE_CHECKING:
    from scipy.sparse import csr_array

APPEARANCE_BETA1, APPEARANCE_BETA2, APPEARANCE_EPSILON = 0.9, 0.999, 1e-15
_SUMMED_PHOTOGRAPHS = 256
"""Photographs whose changes a work-item sums: SUMMED in appearance.cl."""


@dataclass(frozen=True)
class PhotoLens:
    """Photograph and lens of a view, for the kernels.

    photograph, lens: row of the photograph, and row of the lens, in the arrays of colour entries (`Gains`).
    centre: the principal point, as fractions of the image's width and height.
    flat: False for a panorama, which cannot have a vignette.
    """

    photograph: int
    lens: int
    centre: tuple[float, float]
    flat: bool = True

    def place(self, width: int, height: int) -> tuple[float, float, float]:
        """The principal point x, y in pixels, and 1 / (half the image's diagonal)^2, which is 0 for a panorama."""
        scale = 4 / (width**2 + height**2) if self.flat else 0.0
        return self.centre[0] * width, self.centre[1] * height, scale


@dataclass(frozen=True)
class GainEntries:
    """Settings of `step_gains`, the update of colour entries by Adam.

    first_row: row of `entry_gradient`'s result that belongs to the first entry.
    mix_rate: learning rate of colour mixes, divided by the learning rate of gains.
    centred: True if the mean of each entry over all rows stays that of the initial values (`Gains.start`).
    """

    first_row: int = 0
    mix_rate: float = 1.0
    centred: bool = True

    @classmethod
    def of_lens(cls, model: ColourModel) -> GainEntries:
        """Settings for the update of a lens's entries. In the result of `entry_gradient`, these entries come after the
        photograph's entries. Their mean over the lenses may change."""
        return cls(first_row=model.entries, centred=False)


PLAIN_GAINS = GainEntries()


@dataclass(frozen=True, eq=False)
class Gains:
    """Colour entries of all photographs or of all lenses, with their Adam state: (photographs, entries) float32 each.

    logs: the first three entries are the base-2 logarithms of the gains; the others are colour mixes.
    start: initial values of `logs`.
    first, second: Adam's moments.
    gains: 2^logs.
    moved, changes: scratch arrays for the update.
    begins: (photographs + 1,), row starts of a sparse matrix, as in SciPy's `csr_array`. The matrix times `logs -
    start` is added to the gradient, which pulls the gains towards their initial values.
    others, weights: (n,), column indices and values of this matrix.
    """

    logs: DeviceArray
    start: DeviceArray
    first: DeviceArray
    second: DeviceArray
    gains: DeviceArray
    moved: DeviceArray
    changes: DeviceArray
    begins: DeviceArray
    others: DeviceArray
    weights: DeviceArray

    @classmethod
    def on(cls, device: Device, logs: NDArray[np.float32], pull: csr_array | None = None) -> Gains:
        """Make gains from initial logs, with zero moments. pull: the sparse matrix of `Gains`; None for zeros."""
        zeros = np.zeros_like(logs)
        gains = np.exp2(logs.astype(np.float64)).astype(np.float32)
        held, start, first, second, factors = (upload(device, value) for value in (logs, logs, zeros, zeros, gains))
        return cls(
            held, start, first, second, factors, **scratch_on(device, logs.shape), **rows_on(device, len(logs), pull)
        )


def scratch_on(device: Device, shape: tuple[int, ...]) -> dict[str, DeviceArray]:
    """Allocate the scratch arrays of `Gains`. shape: shape of `Gains.logs`."""
    sums = (-(-shape[0] // _SUMMED_PHOTOGRAPHS), shape[1])
    return {name: allocate(device, each, np.float32) for name, each in (("moved", shape), ("changes", sums))}


def rows_on(device: Device, photographs: int, pull: csr_array | None) -> dict[str, DeviceArray]:
    """Upload the arrays `begins`, `others` and `weights` of `Gains` for the sparse matrix `pull`; None for zeros."""
    from scipy.sparse import csr_array

    matrix = csr_array((photographs, photographs), dtype=np.float32) if pull is None else pull
    spare = np.zeros(1)  # device arrays need at least one element
    parts = {
        "begins": matrix.indptr.astype(np.int32),
        "others": np.append(matrix.indices, spare).astype(np.int32),
        "weights": np.append(matrix.data, spare).astype(np.float32),
    }
    return {name: upload(device, part) for name, part in parts.items()}


@stage("appearance", develop=1)
def develop(
    device: Device,
    model: ColourModel,
    colours: Gains,
    lenses: Gains | None,
    taken: PhotoLens,
    target: DeviceArray,
    size: tuple[int, int],
) -> None:
    """Remove the colours of a photograph and its lens from `target`, in place.

    colours: colour entries of all photographs, (photographs, model.entries).
    lenses: colour entries of all lenses, (lenses, model.lens_entries); None if a lens has no entries.
    target: planes (3 or more, rows, stride) of the photograph, the first three of which are colours.
    size: width and height in pixels.
    """
    _, rows, stride = target.shape
    of_view = (taken.photograph, taken.lens, stride, rows * stride, *taken.place(*size))
    entries = (colours.gains, colours.logs, (lenses or colours).logs)
    kernel = device.kernels(model.stem).develop
    launch_grid(device, kernel, (stride // device.shape.lanes, rows), *of_view, *entries, target)


@stage("appearance")
def entry_gradient(
    device: Device,
    work: Workspace,
    model: ColourModel,
    taken: PhotoLens,
    image: DeviceArray,
    gradient: DeviceArray,
    size: tuple[int, int],
    place: int = 0,
) -> DeviceArray:
    """Return the loss's gradient with respect to colour entries, summed over each pixel column: (model.sums, stride).

    It is the gradient at entries of 0 that are applied to the render, instead of removed from the photograph. Equations
    (184) to (186) of docs/gradients.md give the sum over the columns, times ln 2 for logarithms.

    image, gradient: (3, rows, stride), the render and the gradient with respect to it.
    size: width and height in pixels.
    place: index of the view in the batch; the result of each view is in an array of its own.
    """
    _, rows, stride = image.shape
    down = rows // TILE
    partials = work.array("appearance_partials", (model.sums, down, stride))
    columns = work.array(f"appearance_columns_{place}", (model.sums, stride))
    sizes = (size[1], stride, rows * stride, down, *taken.place(*size))
    kernel = device.kernels(model.stem).entry_sums
    launch_grid(device, kernel, (stride // device.shape.lanes, down), *sizes, image, gradient, partials)
    kernel = device.kernels("appearance", {"LANES": 1}).column_sums
    launch_grid(device, kernel, (stride, model.sums), stride, down, partials, columns)
    return columns


@stage("appearance")
def step_gains(
    device: Device,
    gains: Gains,
    photograph: int,
    columns: DeviceArray,
    step: int,
    rate: float,
    readback: DeviceArray,
    entries: GainEntries = PLAIN_GAINS,
) -> None:
    """Update the colour entries `gains` in place by Adam.

    photograph: the photograph or lens of the view, a row of `gains`. All other rows have a gradient of 0.
    columns: the result of `entry_gradient`, which contains the gradient with respect to this row.
    step: the number of this update, from 1.
    rate: learning rate of the gains.
    readback: counts of the step's pass (`READBACK`). Nothing changes if the pass has stopped (kernels/duplicate.cl).
    """
    kernels, (photographs, width) = device.kernels("appearance", {"LANES": 1}), gains.logs.shape
    count = photographs * width
    constants = (
        rate / (1 - APPEARANCE_BETA1**step),
        entries.mix_rate,
        (1 - APPEARANCE_BETA2**step) ** -0.5,
        APPEARANCE_BETA1,
        APPEARANCE_BETA2,
        APPEARANCE_EPSILON,
    )
    sizes = (count, width, photograph, columns.shape[1], entries.first_row)
    matrix = (gains.begins, gains.others, gains.weights)
    read = (readback, columns, gains.start, *matrix, gains.logs)
    launch_items(device, kernels.move_gains, count, *sizes, *constants, *read, gains.moved, gains.first, gains.second)
    groups = gains.changes.shape[0] if entries.centred else 0
    if groups:
        changed = (gains.start, gains.moved, gains.changes)
        launch_grid(device, kernels.change_sums, (width, groups), count, width, *changed)
    settled = (gains.changes, gains.moved, gains.logs, gains.gains)
    launch_items(device, kernels.centre_gains, count, count, width, groups, readback, *settled)
