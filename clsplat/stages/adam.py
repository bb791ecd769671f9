# SPDX-License-Identifier: Apache-2.0
"""Launches adam.cl on every parameter group."""

from __future__ import annotations

from collections.abc import Mapping

import numpy as np

from clsplat.config import OptimiserConfig
from clsplat.device.context import Device
from clsplat.device.launch import launch_items
from clsplat.device.profile import stage
from clsplat.stages.project import GROUPS, DeviceGaussians


@stage("adam")
def adam(
    device: Device,
    step: int,
    rates: Mapping[str, float],
    config: OptimiserConfig,
    parameters: DeviceGaussians,
    gradients: DeviceGaussians,
    first: DeviceGaussians,
    second: DeviceGaussians,
) -> None:
    """Step number `step` (from 1) with the constants of `config` and a rate per group; leaves the gradients zero."""
    kernel, lanes = device.kernels("adam").adam, device.shape.lanes
    beta1, beta2, epsilon = config.beta1, config.beta2, config.epsilon
    root = (1.0 - beta2**step) ** -0.5
    for group in GROUPS:
        n = parameters[group].size
        launch_items(
            device,
            kernel,
            -(-n // lanes),
            np.uint64(n),  # of SH more than 32 bits count, from 95 million Gaussians on
            rates[group] / (1.0 - beta1**step),
            root,
            beta1,
            beta2,
            epsilon,
            parameters[group],
            gradients[group],
            first[group],
            second[group],
        )
