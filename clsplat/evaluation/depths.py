# SPDX-License-Identifier: Apache-2.0
"""Depth pictures of the held-out views that score worst, for the report."""

from __future__ import annotations

from collections.abc import Callable, Mapping, Sequence
from dataclasses import replace
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import NDArray

from clsplat.arrays import Float32
from clsplat.camera import Camera
from clsplat.evaluation.held_out import picture_names
from clsplat.files import remove
from clsplat.gaussians import Gaussians
from clsplat.images.writing import write_image
from clsplat.scenes.scene import View
from clsplat.spherical_harmonics import C0

WORST = 3
"""Views that have one."""
SEEN = 0.5
"""Alpha from which on a pixel has a depth."""
ENDS = (0.02, 0.98)
"""Quantiles of the depths that are white and dark."""
DARKEST = 0.15
"""Grey of what is far; black is nothing."""


def worst(records: Sequence[Mapping[str, Any]]) -> list[int]:
    """Places of the views of eval.json whose PSNR is least, the least first."""
    scored = [(record["psnr"], place) for place, record in enumerate(records) if record.get("psnr") is not None]
    return [place for _, place in sorted(scored)[:WORST]]


def depth_picture(depth: NDArray[Any], alpha: NDArray[Any]) -> Float32:
    """(H, W, 3) of depths (H, W): near is white, far is dark, nothing is black."""
    seen = alpha > SEEN
    grey = np.zeros(depth.shape, np.float32)
    if seen.any():
        near, far = np.quantile(depth[seen], ENDS)
        part = np.clip((depth[seen] - near) / ((far - near) or 1.0), 0, 1)
        grey[seen] = 1 - (1 - DARKEST) * part
    return np.repeat(grey[:, :, None], 3, axis=2)


def coloured(gaussians: Gaussians, camera: Camera) -> Gaussians:
    """The model with a grey for each Gaussian by its distance along the camera's axis, of fisheyes and panoramas
    from the camera: 0 to 1 between the ENDS of those ahead. A frame of it has depth for colour, by no other kernel than
    a frame's."""
    offsets = gaussians.means + gaussians.origin - camera.position
    depths = np.linalg.norm(offsets, axis=1) if camera.kind.rays else offsets @ camera.rotation[2]
    ahead = depths[depths > gaussians.near]
    near, far = np.quantile(ahead, ENDS) if len(ahead) else (0.0, 1.0)
    sh = np.zeros_like(gaussians.sh)
    sh[:, 0] = ((np.clip((depths - near) / ((far - near) or 1.0), 0, 1) - 0.5) / C0)[:, None]
    return replace(gaussians, sh=sh)


def keep_depths(
    render: Callable[[Gaussians, Camera], tuple[NDArray[Any], NDArray[Any]]],
    gaussians: Gaussians,
    views: Sequence[View],
    records: Sequence[Mapping[str, Any]],
    folder: Path,
) -> None:
    """Write them as PNG under the views' names, in place of those that are there. render: image (H, W, 3) over black
    and alpha (H, W) of a model; records: of eval.json, in the views' order."""
    for earlier in folder.glob("**/*.png"):
        remove(earlier)
    names = picture_names([view.name for view in views])
    for place in worst(records):
        path = folder / names[place]
        path.parent.mkdir(parents=True, exist_ok=True)
        camera = views[place].camera
        image, alpha = render(coloured(gaussians, camera), camera)
        write_image(path, depth_picture(image[:, :, 0] / np.maximum(alpha, SEEN), alpha))
