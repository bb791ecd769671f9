# SPDX-License-Identifier: Apache-2.0
"""The components of a training (`clsplat/training/step/component.py`), in the order in which they act in a step."""

from __future__ import annotations

from collections.abc import Callable, Sequence

from clsplat.camera import Camera
from clsplat.config.training import TrainConfig
from clsplat.optimisation.trained_region import TrainedRegion
from clsplat.rendering.rasterizer import Rasterizer
from clsplat.training.step.component import Component
from clsplat.training.step.late_adam import LateAdam
from clsplat.training.step.mip_filter import MipFilter
from clsplat.training.step.visible_chunks import VisibleChunks


def components_of(
    config: TrainConfig,
    rasterizer: Rasterizer,
    others: Sequence[Component],
    cameras: Sequence[Camera],
    region: TrainedRegion | None,
    count: int,
    unit: float,
    next_cameras: Callable[[bool], Sequence[Camera]],
) -> tuple[Component, ...]:
    """Make the components for Gaussians, and return them in order with the others.

    others: components for photographs.
    cameras: the training cameras, in the coordinates of the model.
    region: the region of the training, in the coordinates of the model; None for everywhere.
    count: number of Gaussians at the start.
    unit: the scene's length unit.
    next_cameras: function that returns the cameras of the next step's views, as far as they are known
        (`VisibleChunks`).
    """
    late = [LateAdam(config.optimiser, rasterizer, count)] if config.optimiser.late else []
    mip_filter = MipFilter(config, rasterizer.device, rasterizer.work, cameras, region)
    return (*late, mip_filter, *others, VisibleChunks(config, rasterizer, unit, count, next_cameras))
