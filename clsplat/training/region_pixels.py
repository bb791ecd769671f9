# SPDX-License-Identifier: Apache-2.0
"""The pixels of photographs that show the region of a training. Its loss leaves out the others."""

from __future__ import annotations

from dataclasses import replace
from math import inf

import numpy as np

from clsplat.arrays import Bool, Float32
from clsplat.config.rasterizer import RasterizerConfig
from clsplat.device.context import Device
from clsplat.rendering.renderer import Renderer
from clsplat.scenes.scene import Scene, View
from clsplat.scenes.supervision.kept_pixels import KeptPixels
from clsplat.training.start import Start

MIN_REGION_SHARE = 0.25
"""A pixel is kept if at least this share of it shows Gaussians inside the region, by the initial model."""
DRAWN_SIZE_RATIO = 0.5
"""Size at which the initial model is drawn, as a fraction of the photograph's. The coarse model of blocks was trained
on photographs of this size."""


def with_region_pixels(scene: Scene, start: Start, device: Device, config: RasterizerConfig) -> Scene:
    """Return the scene with masks of the training photographs' pixels that show the start's region.

    In other pixels the frozen Gaussians differ from the photograph, and Gaussians inside the region would grow and move
    to make up for it. Returns the scene itself if there is no region. Raises CapacityError if the device's memory is
    too small.
    """
    model, region = start.model, start.region
    if model is None or region is None:
        return scene
    renderer = Renderer(device, config=config)
    owners = np.where(region.contains(model.means, model.origin), 0, 1).astype(np.int32)

    def masked(view: View) -> View:
        size = (max(round(DRAWN_SIZE_RATIO * side), 1) for side in (view.camera.width, view.camera.height))
        camera = view.camera.resized(*size).before(scene.near)
        mask = shows_region(renderer.render_shares(model, camera, owners, 2), unbounded=region.farthest == inf)
        return view if mask.all() else replace(view, kept=KeptPixels.of(mask))

    return replace(scene, views=[masked(view) if view.split == "train" else view for view in scene.views])


def shows_region(shares: Float32, *, unbounded: bool) -> Bool:
    """Mask (H, W) of the pixels that show a region.

    shares: (H, W, 2), coverage of each pixel by the Gaussians inside and outside the region.
    unbounded: True if what no Gaussian covers belongs to the region too, as the sky.
    """
    inside, outside = shares[:, :, 0], shares[:, :, 1]
    if unbounded:
        inside = inside + np.maximum(1 - inside - outside, 0)
    return np.asarray((inside > 0) & (inside >= MIN_REGION_SHARE * (inside + outside)))
