# SPDX-License-Identifier: Apache-2.0
"""Pictures of the demo's still life from a ring of cameras."""

from __future__ import annotations

import numpy as np
from numpy.typing import NDArray

from clsplat.camera import Camera
from clsplat.demo import ray_caster


def photographs(places: range, width: int, height: int) -> tuple[list[NDArray[np.uint8]], list[Camera]]:
    """Pictures (height, width, 3) by these cameras of a ring of forty, and the cameras."""
    surfaces = ray_caster.still_life()
    ray_caster.bake(surfaces, seed=0)
    cameras = ray_caster.cameras(40, width, height, seed=0)[places.start : places.stop]
    return [np.rint(ray_caster.render(surfaces, camera) * 255).astype(np.uint8) for camera in cameras], cameras
