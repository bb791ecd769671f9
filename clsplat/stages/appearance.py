# SPDX-License-Identifier: Apache-2.0
"""Launches appearance.cl: a photograph's gains, their gradient and their update by Adam."""

from __future__ import annotations

from dataclasses import dataclass
from typing import TYPE_CHECKING

import numpy as np
from numpy.typing import NDArray

from clsplat.device.buffers import DeviceArray, Workspace, allocate, upload
from clsplat.device.context import Device
from clsplat.device.launch import launch_grid, launch_items
from clsplat.device.profile import stage
from clsplat.layouts.columns import TILE

if TYPE_CHECKING:
    from scipy.sparse import csr_array

GAINS_PIXEL_BYTES = 2
"""Bytes of the partial sums per pixel, padding included."""
APPEARANCE_BETA1, APPEARANCE_BETA2, APPEARANCE_EPSILON = 0.9, 0.999, 1e-15


@dataclass(frozen=True)
class GainEntries:
    """The column sums from which gains are updated, and settings of the update by Adam.

    first_row: row of the first entry in the column sums.
    mix_rate: learning rate of mixes, as a fraction of the rate of gains.
    centred: True if the mean of each entry over all rows is subtracted after a step.
    """

    first_row: int = 0
    mix_rate: float = 1.0
    centred: bool = True


PLAIN_GAINS = GainEntries()


@dataclass(frozen=True, eq=False)
class Gains:
    """Gains of all photographs, (photographs, entries) float32 each.

    logs: the first three entries are the base-2 logarithms of the gains; the others are colour mixes.
    start: initial values of `logs`.
    first, second: Adam's moments.
    gains: 2^logs.
    moved: scratch.
    begins (photographs + 1,), others, weights (n,): a sparse matrix, stored like a `csr_array`. The matrix times
    `logs - start` is added to the gradient, so that the gains are pulled towards their initial values.
    """

    logs: DeviceArray
    start: DeviceArray
    first: DeviceArray
    second: DeviceArray
    gains: DeviceArray
    moved: DeviceArray
    begins: DeviceArray
    others: DeviceArray
    weights: DeviceArray

    @classmethod
    def on(cls, device: Device, logs: NDArray[np.float32], pull: csr_array | None = None) -> Gains:
        """Gains with these initial logs, and zero moments. pull: the sparse matrix; zero if not given."""
        zeros = np.zeros_like(logs)
        gains = np.exp2(logs.astype(np.float64)).astype(np.float32)
        held, start, first, second, factors = (upload(device, value) for value in (logs, logs, zeros, zeros, gains))
        moved = allocate(device, logs.shape, np.float32)
        return cls(held, start, first, second, factors, moved, **rows_on(device, len(logs), pull))


def rows_on(device: Device, photographs: int, pull: csr_array | None) -> dict[str, DeviceArray]:
    """The arrays `begins`, `others` and `weights` of a sparse matrix; None gives a zero matrix."""
    from scipy.sparse import csr_array

    matrix = csr_array((photographs, photographs), dtype=np.float32) if pull is None else pull
    spare = np.zeros(1)  # device arrays need at least one element
    parts = {
        "begins": matrix.indptr.astype(np.int32),
        "others": np.append(matrix.indices, spare).astype(np.int32),
        "weights": np.append(matrix.data, spare).astype(np.float32),
    }
    return {name: upload(device, part) for name, part in parts.items()}


@stage("appearance", remove_gains=1)
def remove_gains(device: Device, gains: Gains, photograph: int, target: DeviceArray) -> None:
    """Divide the colours, the first three planes of `target` (3 or more, rows, stride), by the photograph's gains."""
    _, rows, stride = target.shape
    kernel = device.kernels("appearance", {"LANES": 1}).remove_gains
    launch_grid(device, kernel, (stride, rows), photograph, stride, rows * stride, gains.gains, target)


@stage("appearance")
def gain_gradient(
    device: Device,
    work: Workspace,
    image: DeviceArray,
    gradient: DeviceArray,
    height: int,
    place: int = 0,
) -> DeviceArray:
    """Column sums (3, stride) of the image times the gradient of the loss with respect to the image.

    Summed over the columns and multiplied by ln 2, they are the gradient with respect to the photograph's logs.
    place: the view's number in the batch; each has its own array.
    """
    _, rows, stride = image.shape
    down = rows // TILE
    partials, columns = (
        work.array("appearance_partials", (3, down, stride)),
        work.array(f"appearance_columns_{place}", (3, stride)),
    )
    kernels = device.kernels("appearance", {"LANES": 1})
    sizes = (height, stride, rows * stride, down)
    launch_grid(device, kernels.gain_sums, (stride, down), *sizes, image, gradient, partials)
    launch_grid(device, kernels.column_sums, (stride, 3), stride, down, partials, columns)
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
    """Update the gains by Adam, from their column sums. step: the number of this update, from 1.

    Nothing changes if the step's pass has stopped for lack of capacity (kernels/duplicate.cl).
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
    settled = (gains.moved, gains.logs, gains.gains)
    launch_items(device, kernels.centre_gains, count, count, width, int(entries.centred), readback, *settled)
