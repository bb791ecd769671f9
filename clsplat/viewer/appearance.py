# SPDX-License-Identifier: Apache-2.0
"""Appearance of a model on the viewer's page: edits of the Gaussians, displayed channel, colour map. Uses no OpenCL and
no viser."""

from __future__ import annotations

import math
from dataclasses import dataclass, replace
from typing import Any, Literal, get_args

import numpy as np
from numpy.typing import NDArray

from clsplat.arrays import Float32
from clsplat.gaussians import Gaussians
from clsplat.images.writing import steps_of
from clsplat.models.edit import drop_sh, in_box, take

Image = NDArray[np.uint8]
Mode = Literal["colour", "depth", "alpha", "count"]
VIEWER_MODES: tuple[Mode, ...] = get_args(Mode)
Box = tuple[float, float, float, float, float, float]
"""Box in the world: smallest x, y, z, then largest x, y, z."""

MAX_EDITED_OPACITY = 0.999
"""Upper limit of an increased opacity. It is below 1, whose logit is infinite."""
SIZE_FACTOR_RANGE = (0.05, 2.0)
"""Smallest and largest value of the slider that multiplies all scales."""
OPACITY_FACTOR_RANGE = (0.0, 3.0)
"""Smallest and largest value of the slider that multiplies all opacities."""
VIRIDIS_RGB = np.array(
    [(68, 1, 84), (71, 44, 122), (59, 81, 139), (44, 113, 142), (33, 144, 141), (39, 173, 129), (92, 200, 99),
     (170, 220, 50), (253, 231, 37)],
    np.float64,
)  # fmt: skip
"""Colour map from dark to bright, 8-bit: every eighth entry of viridis.

Smith and van der Walt 2015, CC0, https://bids.github.io/colormap/.
"""


@dataclass(frozen=True)
class Look:
    """Appearance settings of a page.

    mode: the displayed channel.
    degree: highest SH degree used.
    size, opacity: factors of all scales and opacities.
    crop: box outside of which Gaussians are hidden; None for no box.
    """

    mode: Mode = "colour"
    degree: int = 3
    size: float = 1.0
    opacity: float = 1.0
    crop: Box | None = None

    def changes(self, degree: int) -> Look | None:
        """Return the settings that edit a model of this SH degree; None if no setting changes the model.

        The mode of the result is always "colour", as the displayed channel does not edit the model.
        """
        asked = replace(self, mode="colour", degree=min(self.degree, degree))
        return None if asked == Look(degree=degree) else asked


def read_look(mode: Any, degree: Any, size: Any, opacity: Any, crop: Any = None) -> Look:
    """Make a `Look` of the values of a page's controls. Numbers outside a slider's range are clamped.

    crop: two corners of the box; None for no box.
    """
    box = None
    if crop is not None:
        corners = np.asarray(crop, np.float64).reshape(2, 3)
        if np.isfinite(corners).all():
            box = tuple(float(value) for value in np.concatenate([corners.min(axis=0), corners.max(axis=0)]))
    return Look(
        mode if mode in VIEWER_MODES else "colour",
        int(_within(degree, 0, 3, 3)),
        _within(size, *SIZE_FACTOR_RANGE, 1.0),
        _within(opacity, *OPACITY_FACTOR_RANGE, 1.0),
        box,  # type: ignore[arg-type]  # six numbers
    )


def _within(value: Any, low: float, high: float, usual: float) -> float:
    number = float(value)
    return min(max(number, low), high) if math.isfinite(number) else usual


def edited(gaussians: Gaussians, look: Look) -> Gaussians:
    """Apply a look's SH degree, size, opacity and crop box to a model. Unchanged arrays are shared with the input."""
    model = drop_sh(gaussians, look.degree) if look.degree < gaussians.sh_degree else replace(gaussians)
    if look.size != 1:
        model.log_scales = gaussians.log_scales + np.float32(math.log(look.size))
    if look.opacity != 1:
        opacity = look.opacity / (1 + np.exp(-gaussians.opacity_logits.astype(np.float64)))
        opacity = np.clip(opacity, 1e-6, MAX_EDITED_OPACITY)
        model.opacity_logits = np.log(opacity / (1 - opacity)).astype(np.float32)
    if look.crop is not None:
        model = take(model, in_box(gaussians, look.crop[:3], look.crop[3:]))
    return model


def colour_picture(image: Float32) -> Image:
    """Convert a frame to (H, W, 3) uint8, with the bits that `clsplat render` writes to a PNG."""
    return steps_of([image], 8)


def alpha_picture(alpha: Float32) -> Image:
    """Convert alpha to a grey picture (H, W, 3) uint8, with black for transparent pixels."""
    return colour_picture(np.broadcast_to(alpha[:, :, None], (*alpha.shape, 3)))


def depth_picture(depth: Float32, alpha: Float32) -> tuple[Image, str]:
    """Convert depths to a picture (H, W, 3) uint8, and describe their range. Near is bright, transparent is black."""
    seen = alpha > 0.5
    if not seen.any():
        return np.zeros((*depth.shape, 3), np.uint8), "nothing is visible"
    near, far = (float(value) for value in np.quantile(depth[seen], [0.02, 0.98]))
    shade = (far - depth.astype(np.float64)) / ((far - near) or 1.0)
    return _shaded(shade, alpha), f"depth {near:.3g} (bright) to {far:.3g}"


def count_picture(count: NDArray[np.int32]) -> tuple[Image, str]:
    """Convert counts of Gaussians per pixel to a picture (H, W, 3) uint8, bright for many, and describe their range."""
    most = max(float(np.quantile(count, 0.995)), 1.0)
    return _shaded(count / most, None), f"0 to {most:,.0f} Gaussians per pixel (bright), maximum {int(count.max()):,}"


def _shaded(shade: NDArray[np.float64], alpha: Float32 | None) -> Image:
    """Convert values in [0, 1] to colours of the colour map, multiplied by alpha if there is one."""
    at = np.clip(np.nan_to_num(shade), 0, 1)
    stops = np.linspace(0, 1, len(VIRIDIS_RGB))
    table = np.stack([np.interp(np.linspace(0, 1, 256), stops, column) for column in VIRIDIS_RGB.T], axis=1)
    colours = table[np.rint(255 * at).astype(np.intp)]
    if alpha is not None:
        colours = colours * np.clip(alpha, 0, 1)[:, :, None]
    return np.asarray(np.rint(colours).astype(np.uint8))
