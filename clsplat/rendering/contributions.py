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
from clsplat.errors import InputError
from clsplat.gaussians import Gaussians
from clsplat.models.edit import drop_sh
from clsplat.rendering.memory_needs import plan_step
from clsplat.rendering.rasterizer import Rasterizer
from clsplat.stages.device_gaussians import allocate_gaussians, host_gaussians, parts, upload_gaussians

FIELDS = SlotFields(contributions=True)


def largest_contributions(
    gaussians: Gaussians, cameras: Sequence[Camera], device: Device, config: RasterizerConfig | None = None
) -> Float32:
    """(n,) the most that each adds to one camera's picture: the sum over its pixels of alpha times transmittance, in
    pixels, as `--density.min-contribution` has it; 0 where no camera sees it.

    It comes from the backward pass, whose image gradient is 0 here. Raises InputError for a camera without an image
    plane, CapacityError where the device is too small.
    """
    config = config or RasterizerConfig()
    for camera in cameras:
        if not camera.kind.flat:
            raise InputError(
                f"contributions to {camera.projection} cameras are not known, expected perspective or orthographic ones"
            )
    alpha_alone = drop_sh(gaussians, 0)  # colour does not matter
    plan = plan_step(device, len(gaussians), 1, cameras, config, fields=FIELDS, agreement=False)
    rasterizer = Rasterizer(device, config)
    rasterizer.follow(plan)
    model = host_gaussians(alpha_alone, plan.rows) if plan.streamed else upload_gaussians(device, alpha_alone)
    gradients = allocate_gaussians(device, plan.rows if plan.streamed else len(gaussians), 1)
    background = allocate(device, (3,), np.float32)
    background.fill(0.0)
    largest = np.zeros(len(gaussians), np.float32)
    for camera in cameras:
        frame = rasterizer.forward(model, gaussians.local(camera), background)
        image_gradient = rasterizer.work.array("image_gradient", frame.blended.image.shape)
        image_gradient.fill(0.0)
        slots = rasterizer.pair_gradients(frame, image_gradient, fields=FIELDS, contributions_alone=True)
        for start, stop, (part,) in parts(rasterizer.work, model):
            projected = frame.projected.rows(start, stop)
            rows = slots.rows(start, stop)
            screen = rasterizer.row_gradients(part, frame, projected, rows, gradients, fields=FIELDS)
            assert screen.contributions is not None
            seen = projected.tile_counts.get() > 0
            contributions = np.where(seen, screen.contributions.get()[: stop - start], 0)
            largest[start:stop] = np.fmax(largest[start:stop], contributions)
    return largest
