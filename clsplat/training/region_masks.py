# SPDX-License-Identifier: Apache-2.0
"""Masks of the photographs' pixels that show the region of a training. Its loss leaves out the others."""

from __future__ import annotations

from dataclasses import replace
from math import inf

import numpy as np

from clsplat.arrays import Bool, Float32
from clsplat.config.rasterizer import RasterizerConfig
from clsplat.device.context import Device
from clsplat.errors import InputError
from clsplat.rendering.renderer import Renderer
from clsplat.scenes.scene import Scene, View
from clsplat.scenes.supervision.region_mask import RegionMask
from clsplat.training.start import Start

MIN_REGION_SHARE = 0.25
"""A pixel is used if Gaussians inside the region make up at least this share of its coverage."""
MIN_USED_PIXELS = 0.01
"""A photograph is used if at least this fraction of its pixels shows the region. The loss is a mean over these
pixels, so that few of them would count as much as a whole photograph."""
DRAWN_SIZE_RATIO = 0.5
"""Size at which the initial model is drawn, as a fraction of the photograph's. The coarse model of blocks was trained
on photographs of this size."""


def with_region_masks(scene: Scene, start: Start, device: Device, config: RasterizerConfig) -> Scene:
    """Return the scene with masks of the training photographs' pixels that show the start's region, by its model.

    In other pixels the frozen Gaussians differ from the photograph, and Gaussians inside the region would grow and move
    to make up for it. Photographs that hardly show the region are left out. Returns the scene itself if there is no
    region. Raises InputError if no photograph shows it, and CapacityError if the device's memory is too small.
    """
    model, region = start.model, start.region
    if model is None or region is None:
        return scene
    renderer = Renderer(device, config=config)
    owners = np.where(region.contains(model.means, model.origin), 0, 1).astype(np.int32)
    unbounded = region.farthest == inf

    def masked(view: View) -> View | None:
        camera = view.camera
        if camera.window is None:  # the edges of a window have to be at whole pixels
            size = (max(round(DRAWN_SIZE_RATIO * side), 1) for side in (camera.width, camera.height))
            camera = camera.resized(*size)
        shares = renderer.render_shares(model, camera.before(scene.near), owners, 2)
        pixels = shows_region(shares, unbounded=unbounded)
        if (pixels & (shares[:, :, 0] > 0)).mean() < MIN_USED_PIXELS:
            return None
        return view if pixels.all() else replace(view, region_mask=RegionMask.of(pixels))

    found = (masked(view) if view.split == "train" else view for view in scene.views)
    views = [view for view in found if view is not None]
    if not any(view.split == "train" for view in views):
        raise InputError(
            f"start: none of the {len(scene.train_views):,} training photographs shows the region in at least "
            f"{100 * MIN_USED_PIXELS:g} % of its pixels, expected photographs of its Gaussians"
        )
    return replace(scene, views=views, whole_extent=scene.extent)


def shows_region(shares: Float32, *, unbounded: bool) -> Bool:
    """Mask (H, W) of the pixels that show a region, or nothing.

    shares: (H, W, 2), coverage of each pixel by the Gaussians inside and outside the region.
    unbounded: True if the uncovered part of a pixel belongs to the region too, as the sky.
    """
    inside, outside = shares[:, :, 0], shares[:, :, 1]
    if unbounded:
        inside = inside + np.maximum(1 - inside - outside, 0)
    return np.asarray(inside >= MIN_REGION_SHARE * (inside + outside))
