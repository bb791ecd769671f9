# SPDX-License-Identifier: Apache-2.0
"""Launches catch_up.cl: the steps of Adam that chunks of a model missed while no view showed them."""

from __future__ import annotations

from collections.abc import Iterable
from dataclasses import dataclass
from math import prod

import numpy as np

from clsplat.arrays import Float32
from clsplat.config.training import OptimiserConfig
from clsplat.device.buffers import DeviceArray
from clsplat.device.context import Device
from clsplat.device.launch import DEFAULT_GROUP_ITEMS, launch_groups, launch_items
from clsplat.device.profile import stage
from clsplat.gaussians import PARAMETER_GROUPS, group_shapes
from clsplat.layouts.columns import CHUNK_ROWS
from clsplat.optimisation.step_noise import NO_EXPLORATION
from clsplat.stages.adam import AdamStep
from clsplat.stages.chunk_lists import ChunkList
from clsplat.stages.device_gaussians import DeviceGaussians
from clsplat.stages.project import CPU_STEP_ROWS, step_numbers

_TABLE_NUMBERS = 2 + len(PARAMETER_GROUPS)
"""Number of columns of a step table. The first two are 1 / sqrt(1 - beta2^t), for all parameter groups but sh_rest and
for sh_rest. The others are the learning rate / (1 - beta1^t) of each group (`step_numbers`)."""
_ABREAST = 4
"""Number of elements that a work-item updates at once in kernel shapes of one lane (`kernels/shared/adam.h`)."""


def step_table(steps: Iterable[AdamStep]) -> Float32:
    """Return the table (steps, _TABLE_NUMBERS) for `catch_up`, with a row of constants of Adam for each step."""
    return np.array([step_numbers(step, NO_EXPLORATION) for step in steps], np.float32).reshape(-1, _TABLE_NUMBERS)


@dataclass(frozen=True, eq=False)
class StepTable:
    """A table of consecutive steps of Adam on the device.

    numbers: (steps, _TABLE_NUMBERS), the result of `step_table`.
    first_step: the number of the step in row 0.
    """

    numbers: DeviceArray
    first_step: int

    @property
    def last_step(self) -> int:
        """Number of the last step."""
        return self.first_step + self.numbers.shape[0] - 1


@stage("catch_up", catch_up=18)
def catch_up(
    device: Device,
    config: OptimiserConfig,
    model: tuple[DeviceGaussians, ...],
    chunks: ChunkList,
    last: DeviceArray,
    caught: DeviceArray,
    step: int,
    table: StepTable,
    readback: DeviceArray,
) -> None:
    """Take the steps of Adam that the listed chunks missed, up to step `step`, with gradients of zero.

    The model has the same bits as if each step had updated all of its rows. Nothing changes if `readback` says that the
    step's pass has stopped.

    model: parameters, first and second moments of the whole model.
    last: (k,) uint32, for each of the k entries of `chunks` the last step that updated the chunk with its gradients.
    caught: (chunks of the model,) uint32, the step up to which each chunk has caught up. The call writes `step` for
    the listed chunks, so that a second call for the same step changes nothing.
    table: constants of consecutive steps, which must include all missed steps.
    readback: (READBACK_SIZE,) uint32. Its last four entries count the refused updates; an element counts once for each
        step that refuses it.
    """
    if step > table.last_step:
        raise ValueError(f"table: has steps {table.first_step} to {table.last_step}, but step {step} is needed")
    entries, coefficients = chunks.numbers.shape[0], model[0].coefficients
    sh_width = 3 * (coefficients - 1)
    if device.shape.lanes > 1:
        items, pieces = 1, CHUNK_ROWS // CPU_STEP_ROWS
        defines: dict[str, object] = {"ROWS": CPU_STEP_ROWS}
    else:
        items = DEFAULT_GROUP_ITEMS if device.max_group >= DEFAULT_GROUP_ITEMS else 1
        floats = sum(prod(shape) for shape in group_shapes(1, coefficients).values())
        pieces = CHUNK_ROWS // _ABREAST // items * floats
        defines = {"ITEMS": items}
    launch_groups(
        device,
        device.kernels("catch_up", defines).catch_up,
        entries * pieces,
        items,
        *chunks.arguments,
        last,
        caught,
        np.uint32(step),
        table.numbers,
        np.uint32(table.first_step),
        np.uint32(sh_width),
        *(config.beta1, config.beta2, config.epsilon),
        *(PARAMETER_GROUPS["means"].limit ** 2, PARAMETER_GROUPS["sh_dc"].limit ** 2),
        readback.buffer,  # a plain buffer: the profile must not count readback's bytes, which are rarely written
        *(arrays[group] for arrays in model for group in PARAMETER_GROUPS),
    )
    noted = (chunks.model_rows, chunks.numbers, np.uint32(step), readback.buffer, caught)
    launch_items(device, device.kernels("catch_up", defines).note_caught_up, entries, entries, *noted)
