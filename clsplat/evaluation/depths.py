# SPDX-License-Identifier: Apache-2.0
"""Depth pictures of the held-out views with the lowest PSNR, for the report."""

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
from clsplat.files.atomic import remove
from clsplat.gaussians import Gaussians
from clsplat.images.writing import write_image
from clsplat.scenes.scene import View
from clsplat.spherical_harmonics import SH_C0

DEPTH_PICTURE_VIEWS = 3
"""Number of views that get a depth picture."""
MIN_DEPTH_PICTURE_ALPHA = 0.5
"""Alpha above which a pixel of a depth picture shows a depth. Other pixels are black."""
DEPTH_GREY_QUANTILES = (0.02, 0.98)
"""Quantiles of the depths that map to white and to the darkest grey."""
FARTHEST_DEPTH_GREY = 0.15
"""Grey of the farthest depths. Black is for empty pixels."""


def worst(records: Sequence[Mapping[str, Any]]) -> list[int]:
    """Return the indices of the DEPTH_PICTURE_VIEWS views with the lowest PSNR, lowest first.

    records: records of the views in eval.json.
    """
    scored = [(record["psnr"], place) for place, record in enumerate(records) if record.get("psnr") is not None]
    return [place for _, place in sorted(scored)[:DEPTH_PICTURE_VIEWS]]


def depth_picture(depth: NDArray[Any], alpha: NDArray[Any]) -> Float32:
    """Convert depths (H, W) to a grey picture (H, W, 3): near is white, far is dark, pixels without depth are black."""
    seen = alpha > MIN_DEPTH_PICTURE_ALPHA
    grey = np.zeros(depth.shape, np.float32)
    if seen.any():
        near, far = np.quantile(depth[seen], DEPTH_GREY_QUANTILES)
        part = np.clip((depth[seen] - near) / ((far - near) or 1.0), 0, 1)
        grey[seen] = 1 - (1 - FARTHEST_DEPTH_GREY) * part
    return np.repeat(grey[:, :, None], 3, axis=2)


def coloured(gaussians: Gaussians, camera: Camera) -> Gaussians:
    """Return a copy of the model in which each Gaussian's colour is a grey that encodes the Gaussian's depth.

    Grey is 0 up to the first of the DEPTH_GREY_QUANTILES of the depths in front of the camera, and 1 from the second
    on. Depths are z, or distances from the camera for fisheyes and panoramas. A render of the copy shows depths, with
    the kernels of a normal frame.
    """
    offsets = gaussians.means + gaussians.origin - camera.position
    depths = camera.drawn_depths(offsets)
    ahead = depths[depths > gaussians.near]
    near, far = np.quantile(ahead, DEPTH_GREY_QUANTILES) if len(ahead) else (0.0, 1.0)
    sh = np.zeros_like(gaussians.sh)
    sh[:, 0] = ((np.clip((depths - near) / ((far - near) or 1.0), 0, 1) - 0.5) / SH_C0)[:, None]
    return replace(gaussians, sh=sh)


def keep_depths(
    render: Callable[[Gaussians, Camera], tuple[NDArray[Any], NDArray[Any]]],
    gaussians: Gaussians,
    views: Sequence[View],
    records: Sequence[Mapping[str, Any]],
    folder: Path,
) -> None:
    """Replace the PNG files in `folder` by depth pictures of the views with the lowest PSNR, with the views' names.

    render: function that returns a model's image (H, W, 3) over black, and its alpha (H, W).
    records: records of the views in eval.json, in the order of `views`.
    """
    for earlier in folder.glob("**/*.png"):
        remove(earlier)
    names = picture_names([view.name for view in views])
    for place in worst(records):
        path = folder / names[place]
        path.parent.mkdir(parents=True, exist_ok=True)
        camera = views[place].camera
        image, alpha = render(coloured(gaussians, camera), camera)
        write_image(path, depth_picture(image[:, :, 0] / np.maximum(alpha, MIN_DEPTH_PICTURE_ALPHA), alpha))
