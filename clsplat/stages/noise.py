# SPDX-License-Identifier: Apache-2.0
"""Launches noise.cl, MCMC's noise: random moves of the means of nearly transparent Gaussians."""

from __future__ import annotations

from math import inf, log

import numpy as np

from clsplat.device.buffers import DeviceArray
from clsplat.device.command_buffer import LaunchParameter, LaunchParameterWord
from clsplat.device.context import Device
from clsplat.device.launch import launch_items
from clsplat.device.profile import stage
from clsplat.gaussians import PARAMETER_GROUPS
from clsplat.optimisation.step_noise import Exploration
from clsplat.optimisation.trained_region import TrainedRegion
from clsplat.stages.device_gaussians import DeviceGaussians
from clsplat.stages.region import region_build

NOISE_OPACITY_RANGE = 0.16
"""Width of the range of opacities above `Exploration.dead` in which noise is added. Above it, noise would be less than
1.2e-7 of the noise at opacity `dead`."""


def highest_logit(dead: float) -> float:
    """Return the logit of the opacity above which no noise is added.

    dead: opacity at which half of the noise is added (`Exploration.dead`).
    """
    highest = dead + NOISE_OPACITY_RANGE
    return log(highest / (1 - highest)) if highest < 1 else inf


def noise_numbers(explore: Exploration) -> tuple[float, ...]:
    """Return the arguments of the kernel add_noise that change from step to step: the two words of the random key, and
    the amount of noise. The result is empty without noise."""
    return () if explore.amount == 0 else (*map(LaunchParameterWord, explore.key), LaunchParameter(explore.amount))


def noise(
    device: Device,
    explore: Exploration,
    gaussians: DeviceGaussians,
    first_row: int,
    readback: DeviceArray,
    region: TrainedRegion | None = None,
) -> None:
    """Add a step's noise to the means. Nothing changes if `readback` says that the step's pass has stopped.

    gaussians: all Gaussians of the model, or consecutive rows of it.
    first_row: the model's row that is the first of `gaussians`.
    region: the region in which means move, in their coordinates; None for everywhere.
    """
    if explore.amount != 0:
        _add_noise(device, explore, gaussians, first_row, readback, region)


@stage("noise", add_noise=1)
def _add_noise(
    device: Device,
    explore: Exploration,
    gaussians: DeviceGaussians,
    first_row: int,
    readback: DeviceArray,
    region: TrainedRegion | None,
) -> None:
    """Launch add_noise. A separate function, so that the profile of a step without noise has no stage `noise`."""
    *words, amount = noise_numbers(explore)
    defines, bounds = region_build(region)
    highest, limit2 = min(highest_logit(explore.dead), 1e30), PARAMETER_GROUPS["means"].limit ** 2
    launch_items(
        device,
        device.kernels("noise", {"LANES": 1, **defines}).add_noise,
        gaussians.count,
        gaussians.count,
        np.uint32(first_row),
        *words,
        *(amount, explore.dead, highest, limit2),
        readback.buffer,
        *(gaussians[group] for group in ("quaternions", "log_scales", "opacity_logits", "means")),
        *bounds,
    )
