# SPDX-License-Identifier: Apache-2.0
"""The gradient of blending of lists that several groups share: lists of about PART_PAIRS pairs and of several parts."""

from __future__ import annotations

import numpy as np
import pytest
from pipeline import Pipeline, assert_gradients, shaped
from scenes import Scene, make_gaussians, random_sh, straight_camera, world_from_pixels

from clsplat.device.context import Device
from clsplat.layouts.columns import TILE
from clsplat.stages.blend import PART_PAIRS

LENGTHS = (1, PART_PAIRS - 1, PART_PAIRS, PART_PAIRS + 1, 2 * PART_PAIRS, 2 * PART_PAIRS + 1, 3000)


def one_list(count: int, walls: tuple[int, ...] = ()) -> Scene:
    """An image of one tile, whose list has `count` faint Gaussians.

    walls: places in the list of four opaque Gaussians each. The k-th of them finish all pixels of a strip of the image.
    """
    rng = np.random.default_rng(7)
    camera = straight_camera(TILE, TILE)
    pixels, depths = rng.uniform(0, TILE, (count, 2)), np.linspace(2.0, 6.0, count)
    axes, opacities = rng.uniform(1.0, 4.0, (count, 3)), rng.uniform(0.005, 0.02, count)
    quaternions = rng.normal(size=(count, 4))
    width = TILE / max(len(walls), 1)
    for k, place in enumerate(walls):
        own = slice(place, place + 4)
        pixels[own] = (k + 0.5) * width, TILE / 2
        axes[own], opacities[own], quaternions[own] = (width / 2, 4 * TILE, 1.0), 0.999, (1.0, 0.0, 0.0, 0.0)
    log_scales = np.log(depths[:, None] / camera.fx * axes)
    means = world_from_pixels(camera, pixels, depths)
    return make_gaussians(means, quaternions, log_scales, opacities, random_sh(rng, count)), camera


@pytest.mark.parametrize("count", LENGTHS)
def test_lists_of_any_length(device: Device, count: int) -> None:
    scene = one_list(count)
    run = Pipeline.run(shaped(device, 1, 64), scene)
    assert run.frame.listed.lists.ranges.get().tolist() == [[0, count]]
    assert_gradients(run, scene)
