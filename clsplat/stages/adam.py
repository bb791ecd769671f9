# SPDX-License-Identifier: Apache-2.0
"""Launches adam.cl for every parameter group. In a step of one view, `stages.project.project_step` does Adam
instead."""

from __future__ import annotations

from collections.abc import Mapping

import numpy as np

from clsplat.config.training import OptimiserConfig
from clsplat.device.buffers import DeviceArray, allocate
from clsplat.device.context import Device
from clsplat.device.launch import launch_items
from clsplat.device.profile import stage
from clsplat.gaussians import PARAMETER_GROUPS
from clsplat.layouts.columns import READBACK
from clsplat.stages.device_gaussians import DeviceGaussians


def updates_sh_rest(config: OptimiserConfig, step: int) -> bool:
    """True if step number `step` (from 1) updates the higher SH bands."""
    return step % config.sh_rest_every == 0


def corrected(config: OptimiserConfig, step: int, group: str, rate: float) -> tuple[float, float]:
    """Return rate / (1 - beta1^t) and 1 / sqrt(1 - beta2^t) of a group's t-th update, in step number `step` (from
    1)."""
    updates = step // config.sh_rest_every if group == "sh_rest" else step
    return rate / (1.0 - config.beta1**updates), (1.0 - config.beta2**updates) ** -0.5


@stage("adam", adam=4)
def adam(
    device: Device,
    step: int,
    rates: Mapping[str, float],
    config: OptimiserConfig,
    parameters: DeviceGaussians,
    gradients: DeviceGaussians,
    first: DeviceGaussians,
    second: DeviceGaussians,
    tile_counts: DeviceArray,
    readback: DeviceArray | None = None,
) -> None:
    """Adam's step number `step` (from 1), with the constants of `config` and a rate per group. It leaves the gradients
    zero.

    tile_counts: (n,) uint32, 0 where the view does not show a Gaussian, for `config.sparse`.
    readback: (READBACK_SIZE,) uint32. Its last four count the elements whose step was refused, by reason
    (`columns.REFUSED`).
    """
    readback = readback or allocate(device, (len(READBACK),), np.uint32)
    counts = (
        readback.buffer
    )  # passed as a buffer, so that its bytes do not count as traffic: it is written only on a fault
    beta1, beta2, epsilon = config.beta1, config.beta2, config.epsilon
    lanes = device.shape.lanes
    for group, about in PARAMETER_GROUPS.items():
        if group == "sh_rest" and not updates_sh_rest(config, step):
            continue
        rate, root = corrected(config, step, group, rates[group])
        constants = (rate, root, beta1, beta2, epsilon, about.limit**2, counts)
        arrays = (parameters[group], gradients[group], first[group], second[group])
        size, rows = parameters[group].size, parameters.count
        if size == 0:
            continue
        if config.sparse:
            kernel = device.kernels("adam", WIDTH=size // rows).adam_visible
            launch_items(device, kernel, -(-rows // lanes), rows, *constants, tile_counts, *arrays)
        else:
            kernel = device.kernels("adam").adam
            # SH coefficients need an index of more than 32 bits from 95 million Gaussians.
            launch_items(device, kernel, -(-size // lanes), np.uint64(size), *constants, *arrays)


@stage("adam", add_view=1, join_view=1)
def add_view(
    device: Device,
    tile_counts: DeviceArray,
    gradients: DeviceGaussians,
    sums: DeviceGaussians,
    shown: DeviceArray | None = None,
    *,
    sh_rest: bool = True,
) -> None:
    """Add the rows of `gradients` that a view shows to the sums over the earlier views.

    tile_counts: (n,) uint32, of the view.
    shown: (n,) uint32, if given; becomes nonzero where any of the views shows a Gaussian.
    sh_rest: also add the higher SH bands.
    """
    rows = tile_counts.shape[0]
    for group in PARAMETER_GROUPS:
        size = sums[group].size
        if size and (sh_rest or group != "sh_rest"):
            kernel = device.kernels("adam", WIDTH=size // rows).add_view
            launch_items(device, kernel, size, np.uint64(size), tile_counts, gradients[group], sums[group])
    if shown is not None:
        launch_items(device, device.kernels("adam").join_view, rows, rows, tile_counts, shown)
