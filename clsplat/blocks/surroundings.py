# SPDX-License-Identifier: Apache-2.0
"""The model that a block's training begins with: the coarse model, without Gaussians that the block has no use for."""

from __future__ import annotations

from pathlib import Path

import numpy as np

from clsplat.chunks.bounds import ChunkBounds
from clsplat.chunks.culling import PictureBorders, visible
from clsplat.config.training import TrainConfig
from clsplat.gaussians import Gaussians
from clsplat.layouts.columns import CHUNK_ROWS
from clsplat.models.edit import merge, take
from clsplat.models.formats import ply
from clsplat.optimisation.trained_region import TrainedRegion
from clsplat.scenes.scene import Scene
from clsplat.training.preparation import is_along_rays


def first_model_of_block(
    path: Path, region: TrainedRegion, scene: Scene, config: TrainConfig, rows: int = CHUNK_ROWS
) -> Gaussians:
    """Return the Gaussians of the coarse model that are in a block's widened cell, or that its photographs may show.

    The file is read in blocks of rows, so that main memory holds one block and the result.

    path: PLY of the coarse model.
    region: the widened cell.
    scene: the block's scene.
    config: settings of the block's training.
    rows: number of consecutive Gaussians that are kept or left out together, unless they are in the widened cell.
    """
    parts, pictures = list[Gaussians](), list[PictureBorders]()
    for some in ply.local_blocks(path):
        pictures = pictures or _pictures(some, scene, config)
        bounds = ChunkBounds.measured(some.means, some.log_scales, rows)
        shown = np.repeat(np.logical_or.reduce([visible(picture, bounds) for picture in pictures]), rows)[: len(some)]
        parts.append(take(some, shown | region.contains(some.means, some.origin)))
    return merge(parts)


def _pictures(model: Gaussians, scene: Scene, config: TrainConfig) -> list[PictureBorders]:
    """Return the borders of the training photographs, in the coordinates of the model."""
    by_rays = is_along_rays(config, scene.train_views)
    cameras = (view.camera.from_origin(model.origin).before(scene.near) for view in scene.train_views)
    factor = 1 / (1 - config.thinning)  # dropout multiplies the opacities of the other Gaussians
    return [PictureBorders.of(camera.along_rays(by_rays), config.rasterizer, factor) for camera in cameras]
