# SPDX-License-Identifier: Apache-2.0
"""Contributions of each Gaussian to the pictures of given cameras: the statistic that density control prunes by."""

from __future__ import annotations

from collections.abc import Sequence

import numpy as np

from clsplat.arrays import Float32
from clsplat.camera import Camera
from clsplat.config.rasterizer import RasterizerConfig
from clsplat.device.buffers import allocate
from clsplat.device.context import Device
from clsplat.device.layout import SlotFields
from clsplat.gaussians import Gaussians
from clsplat.models.edit import drop_sh
from clsplat.rendering.memory_needs import plan_step
from clsplat.rendering.rasterizer import Frame, Rasterizer
from clsplat.stages.device_gaussians import host_gaussians, upload_gaussians
from clsplat.stages.project import add_slots

FIELDS = SlotFields(contributions=True)


def largest_contributions(
    gaussians: Gaussians, cameras: Sequence[Camera], device: Device, config: RasterizerConfig | None = None
) -> Float32:
    """(n,) the most that each adds to one camera's picture: the sum over its pixels of alpha times transmittance, in
    pixels, like `--density.min-contribution`; 0 where no camera sees it.

    It comes from the gradient of blending, and is the same for any gradient of the image. Raises CapacityError where
    the device is too small.
    """
    config = config or RasterizerConfig()
    alpha_alone = drop_sh(gaussians, 0)  # colour does not matter
    plan = plan_step(device, len(gaussians), 1, cameras, config, fields=FIELDS, agreement=False)
    rasterizer = Rasterizer(device, config)
    rasterizer.antialias(on=gaussians.antialiased)
    rasterizer.follow(plan)
    model = host_gaussians(alpha_alone, plan.rows) if plan.streamed else upload_gaussians(device, alpha_alone)
    background = allocate(device, (3,), np.float32)
    background.fill(0.0)
    largest = np.zeros(len(gaussians), np.float32)
    for camera in cameras:
        frame = rasterizer.forward(model, gaussians.local(camera), background)
        largest = np.fmax(largest, sums_of_weights(rasterizer, frame))
    return largest


def sums_of_weights(rasterizer: Rasterizer, frame: Frame) -> Float32:
    """(n,) the sum over the frame's pixels of each Gaussian's alpha times transmittance."""
    slots = rasterizer.pair_gradients(frame, frame.blended.image, fields=FIELDS)
    sums, tile_counts = slots.values, frame.projected.tile_counts
    if slots.first_slots is not None:
        sums = add_slots(rasterizer.device, rasterizer.work, tile_counts, slots, None, fields=FIELDS)
    return np.where(tile_counts.get() > 0, sums.get()[:, -1], np.float32(0))
