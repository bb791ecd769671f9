# SPDX-License-Identifier: Apache-2.0
"""The type `Draw`, a function that renders channels of a camera's picture, and the `Draw` that calls the kernels."""

from __future__ import annotations

from collections.abc import Callable, Collection, Mapping, Sequence
from typing import Any

import numpy as np
from numpy.typing import NDArray

from clsplat.camera import Camera
from clsplat.config.channels import CRYPTOMATTE_CHANNELS, FRAME_CHANNELS, feature_names, light_and_rest
from clsplat.frame.holdout import Cut
from clsplat.frame.mattes import Matte
from clsplat.gaussians import Gaussians
from clsplat.layouts.columns import TILE
from clsplat.rendering.renderer import OBJECTS_PER_COVERAGE_PASS, Renderer
from clsplat.stages.channels import Features

Planes = dict[str, NDArray[Any]]
"""Channels by name, (height, width) or (height, width, floats). rgb is composited over the background. Over black it is
premultiplied by alpha."""
Draw = Callable[[Camera, Collection[str]], Planes]
"""Function that takes a camera and names of channels, renders the picture, and returns the channels' planes."""


def drawn_by(
    renderer: Renderer,
    gaussians: Gaussians,
    background: Sequence[float] = (0.0, 0.0, 0.0),
    after: Camera | None = None,
    before: Camera | None = None,
    cut: Cut | None = None,
    moved: Gaussians | None = None,
    earlier: Gaussians | None = None,
    mattes: Mapping[str, Matte] | None = None,
) -> Draw:
    """Return a function (`Draw`) that renders pictures with the kernels.

    after, before: cameras of the whole next and previous frame, for the channels motion and backward.
    cut: function from a camera to the holdout surfaces in its picture; None without a holdout.
    moved, earlier: the Gaussians at the next and the previous frame, for these channels; None if they do not move.
    mattes: Cryptomatte mattes, by channel name.

    The planes may be non-contiguous, because the encoder makes them contiguous, perhaps in another thread.
    """

    def draw(camera: Camera, names: Collection[str]) -> Planes:
        camera, rows, columns = on_tiles(camera)
        _, rest = light_and_rest(names)
        made: Planes = {}
        holdout = cut(camera) if cut else None
        of_objects = {name: (mattes or {})[name] for name in names if name in CRYPTOMATTE_CHANNELS}
        if not rest:
            picture = renderer.render(gaussians, camera, background, contiguous=False, holdout=holdout)
        else:
            picture, made = renderer.render_channels(
                gaussians,
                camera,
                feature_names(rest),
                after=after and after.reframed(camera),
                before=before and before.reframed(camera),
                moved=moved,
                earlier=earlier,
                background=background,
                contiguous=False,
                holdout=holdout,
            )
        planes: Planes = {"rgb": picture.image, "alpha": picture.alpha}
        for name in rest:
            plane, signs = made[FRAME_CHANNELS[name].kernel], FRAME_CHANNELS[name].signs
            planes[name] = plane * np.array(signs, np.float32) if signs else plane
        for name, matte in of_objects.items():
            planes[name] = renderer.render_shares(gaussians, camera, matte.owners, len(matte.names), holdout)
        return {name: planes[name][rows, columns] for name in names}

    return draw


def in_two(light: Draw, rest: Draw) -> Draw:
    """Return a function (`Draw`) that takes rgb and alpha from `light`, and the other channels from `rest`."""

    def draw(camera: Camera, names: Collection[str]) -> Planes:
        of_light, others = light_and_rest(names)
        planes = rest(camera, others) if others else {}
        return planes | light(camera, of_light) if of_light else planes

    return draw


def feature_floats(names: Collection[str]) -> int:
    """Number of floats per Gaussian that are blended for these channels in addition to colour."""
    _, rest = light_and_rest(names)
    floats = Features.of(feature_names(rest)).floats if rest else 0
    return max(floats, OBJECTS_PER_COVERAGE_PASS) if any(name in CRYPTOMATTE_CHANNELS for name in names) else floats


def on_tiles(camera: Camera) -> tuple[Camera, slice, slice]:
    """Extend a camera's picture so that it begins at a tile border of its frame. Returns the camera of the larger
    picture, and the rows and columns of the original picture in it."""
    if camera.window is None:
        return camera, slice(None), slice(None)
    left, top = camera.window.x % TILE, camera.window.y % TILE
    larger = camera.cropped(-left, -top, camera.width + left, camera.height + top)
    return larger, slice(top, None), slice(left, None)
