# SPDX-License-Identifier: Apache-2.0
"""Contributions of each Gaussian to the images of given cameras: the statistic for pruning in density control.

The pruning: `training/density/adaptive.py`; its threshold: `config/training.py`.
"""

from __future__ import annotations

from collections.abc import Iterator, Sequence

import numpy as np

from clsplat.arrays import Float32
from clsplat.camera import Camera
from clsplat.config.rasterizer import RasterizerConfig
from clsplat.device.buffers import allocate
from clsplat.device.context import Device
from clsplat.gaussians import Gaussians
from clsplat.layouts.columns import SlotFields
from clsplat.models.edit import drop_sh
from clsplat.rendering.memory_needs import StepMemory, plan_step
from clsplat.rendering.rasterizer import ForwardPass, Rasterizer
from clsplat.stages.device_gaussians import host_gaussians, upload_gaussians
from clsplat.stages.project import add_slots

CONTRIBUTION_SLOT_FIELDS = SlotFields(contributions=True)


def largest_contributions(
    gaussians: Gaussians, cameras: Sequence[Camera], device: Device, config: RasterizerConfig | None = None
) -> Float32:
    """Each Gaussian's largest contribution (n,) to the image of any of the cameras, in pixels.

    A contribution is the sum over the image's pixels of alpha times transmittance, as in `--density.min-contribution`.
    It is 0 if the camera does not see the Gaussian. The kernel blend_grad computes contributions, whatever the
    gradient of the image is. Raises CapacityError if the device's memory is too small.
    """
    largest = np.zeros(len(gaussians), np.float32)
    for contributions in contributions_by_camera(gaussians, cameras, device, config):
        largest = np.fmax(largest, contributions)
    return largest


def contributions_by_camera(
    gaussians: Gaussians, cameras: Sequence[Camera], device: Device, config: RasterizerConfig | None = None
) -> Iterator[Float32]:
    """Yield each Gaussian's contribution (n,) to the image of each camera, in pixels, as in `largest_contributions`.

    Raises CapacityError if the device's memory is too small.
    """
    config = config or RasterizerConfig()
    alpha_alone = drop_sh(gaussians, 0)  # contributions do not depend on colour
    plan = plan_step(device, len(gaussians), 1, cameras, config, StepMemory(CONTRIBUTION_SLOT_FIELDS))
    rasterizer = Rasterizer(device, config, antialiased=gaussians.antialiased)
    rasterizer.follow(plan)
    model = host_gaussians(alpha_alone, plan.rows) if plan.streamed else upload_gaussians(device, alpha_alone)
    background = allocate(device, (3,), np.float32)
    background.fill(0.0)
    for camera in cameras:
        yield sums_of_weights(rasterizer, rasterizer.forward(model, gaussians.local(camera), background))


def sums_of_weights(rasterizer: Rasterizer, frame: ForwardPass) -> Float32:
    """The sum (n,) over the frame's pixels of each Gaussian's alpha times transmittance."""
    slots = rasterizer.pair_gradients(frame, frame.blended.image, fields=CONTRIBUTION_SLOT_FIELDS)
    sums, tile_counts = slots.values, frame.projected.tile_counts
    if slots.first_slots is not None:
        sums = add_slots(rasterizer.device, rasterizer.work, tile_counts, slots, None)
    return np.where(tile_counts.get() > 0, sums.get()[:, -1], np.float32(0))
