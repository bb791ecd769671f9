# SPDX-License-Identifier: Apache-2.0
"""Launches settle.cl: the steps of Adam that Gaussians missed while no view showed them."""

from __future__ import annotations

import numpy as np

from clsplat.config.training import OptimiserConfig
from clsplat.device.buffers import DeviceArray
from clsplat.device.context import Device
from clsplat.device.launch import launch_items
from clsplat.device.profile import stage
from clsplat.gaussians import PARAMETER_GROUPS
from clsplat.stages.device_gaussians import DeviceGaussians


@stage("settle", settle=18)
def settle(
    device: Device,
    config: OptimiserConfig,
    model: tuple[DeviceGaussians, ...],
    step: int,
    last: DeviceArray,
    missed: DeviceArray,
    readback: DeviceArray,
    tile_counts: DeviceArray | None = None,
) -> None:
    """Settle Gaussians: take the steps of Adam that they missed, up to step number `step`.

    Nothing changes if `readback` says that the step's pass has stopped.

    model: parameters, first and second moments.
    last: (n,) uint32, the last step that each Gaussian took. For settled Gaussians it becomes `step`. With
    `tile_counts` it becomes `step + 1`, because visible Gaussians take step `step + 1` right after this call.
    missed: (MOST_MISSED + 1, groups, 3), the result of `MissedSteps.rounded` after step `step`.
    tile_counts: (n,) uint32, tile counts of the view of step `step + 1`. Only visible Gaussians, whose count is not 0,
    are settled. None settles all Gaussians.
    """
    n, coefficients = model[0].count, model[0].coefficients
    visible = {} if tile_counts is None else {"VISIBLE": True}
    launch_items(
        device,
        device.kernels("settle", {"LANES": 1, **visible}).settle,
        n,
        n,
        np.uint32(3 * (coefficients - 1)),
        np.uint32(step),
        np.uint32(step + (tile_counts is not None)),
        config.epsilon,
        PARAMETER_GROUPS["means"].limit ** 2,
        PARAMETER_GROUPS["sh_dc"].limit ** 2,
        readback.buffer,
        *([] if tile_counts is None else [tile_counts]),
        last,
        missed,
        *(arrays[group] for arrays in model for group in PARAMETER_GROUPS),
    )
