# SPDX-License-Identifier: Apache-2.0
"""Pictures of the demo's still life from a ring of cameras."""

from __future__ import annotations

from functools import cache

import numpy as np
from numpy.typing import NDArray

from clsplat.camera import Camera
from clsplat.demo import ray_caster


@cache
def baked_still_life() -> list[ray_caster.Surface]:
    """The demo's surfaces with their textures, not to be changed. Baking takes 3.7 processor seconds."""
    surfaces = ray_caster.still_life()
    ray_caster.bake(surfaces, seed=0)
    return surfaces


def photographs(places: range, width: int, height: int) -> tuple[list[NDArray[np.uint8]], list[Camera]]:
    """Pictures (height, width, 3) by these cameras of a ring of forty, and the cameras."""
    surfaces = baked_still_life()
    cameras = ray_caster.cameras(40, width, height, seed=0)[places.start : places.stop]
    return [np.rint(ray_caster.render(surfaces, camera) * 255).astype(np.uint8) for camera in cameras], cameras
