# SPDX-License-Identifier: Apache-2.0
"""A `Draw` makes the named channels of a camera's picture; here, the one by the kernels."""

from __future__ import annotations

from collections.abc import Callable, Collection, Mapping, Sequence
from typing import Any

import numpy as np
from numpy.typing import NDArray

from clsplat.camera import Camera
from clsplat.config.channels import CHANNELS, MATTES, feature_names, light_and_rest
from clsplat.device.layout import TILE
from clsplat.frame.holdout import Cut
from clsplat.frame.objects import Matte
from clsplat.frame.window import crop, reframed
from clsplat.gaussians import Gaussians
from clsplat.rendering.renderer import SHARES, Renderer
from clsplat.stages.channels import Features

Planes = dict[str, NDArray[Any]]
"""Channels by name, (height, width) or (height, width, floats); rgb over the background, so over black it is associated
with alpha."""
Draw = Callable[[Camera, Collection[str]], Planes]
"""From a camera and the names of channels to their planes."""


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
    """A Draw by the kernels; after, before: the cameras of a whole frame that motion and backward motion go to; cut: of
    the frame's hold-out; moved, earlier: the Gaussians that these motions go to, where they do not stand still; mattes:
    by the names of their channels.

    Planes need not be contiguous: the encoder, which may be another thread, puts them in order.
    """

    def draw(camera: Camera, names: Collection[str]) -> Planes:
        camera, rows, columns = on_tiles(camera)
        _, rest = light_and_rest(names)
        made: Planes = {}
        holdout = cut(camera) if cut else None
        of_objects = {name: (mattes or {})[name] for name in names if name in MATTES}
        if not rest:
            picture = renderer.render(gaussians, camera, background, contiguous=False, holdout=holdout)
        else:
            picture, made = renderer.render_channels(
                gaussians,
                camera,
                feature_names(rest),
                after=after and reframed(after, camera),
                before=before and reframed(before, camera),
                **{name: then for name, then in (("moved", moved), ("earlier", earlier)) if then is not None},
                background=background,
                contiguous=False,
                holdout=holdout,
            )
        planes: Planes = {"rgb": picture.image, "alpha": picture.alpha}
        for name in rest:
            plane, signs = made[CHANNELS[name].kernel], CHANNELS[name].signs
            planes[name] = plane * np.array(signs, np.float32) if signs else plane
        for name, matte in of_objects.items():
            planes[name] = renderer.render_shares(gaussians, camera, matte.owners, len(matte.names), holdout)
        return {name: planes[name][rows, columns] for name in names}

    return draw


def in_two(light: Draw, rest: Draw) -> Draw:
    """A Draw that takes the channels that light is added up in from one, and the others from another."""

    def draw(camera: Camera, names: Collection[str]) -> Planes:
        of_light, others = light_and_rest(names)
        planes = rest(camera, others) if others else {}
        return planes | light(camera, of_light) if of_light else planes

    return draw


def feature_floats(names: Collection[str]) -> int:
    """Floats of each Gaussian's that these channels are blended from, 0 where they are colour alone."""
    _, rest = light_and_rest(names)
    floats = Features.of(feature_names(rest)).floats if rest else 0
    return max(floats, SHARES) if any(name in MATTES for name in names) else floats


def on_tiles(camera: Camera) -> tuple[Camera, slice, slice]:
    """A camera whose picture begins with a whole tile of its frame, and where the wanted one is in that."""
    if camera.window is None:
        return camera, slice(None), slice(None)
    left, top = camera.window.x % TILE, camera.window.y % TILE
    larger = crop(camera, -left, -top, camera.width + left, camera.height + top)
    return larger, slice(top, None), slice(left, None)
