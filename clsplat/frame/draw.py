# SPDX-License-Identifier: Apache-2.0
"""A `Draw` makes the named layers of a camera's picture; here, the one by the kernels."""

from __future__ import annotations

from collections.abc import Callable, Collection, Sequence
from typing import TYPE_CHECKING, Any

import numpy as np
from numpy.typing import NDArray

from clsplat.camera import Camera
from clsplat.device.layout import TILE
from clsplat.frame.window import crop, reframed
from clsplat.images.channels import LAYERS

if TYPE_CHECKING:
    from clsplat.gaussians import Gaussians
    from clsplat.rendering.renderer import Renderer


Layers = dict[str, NDArray[Any]]
Draw = Callable[[Camera, Collection[str]], Layers]
"""(camera, names of layers) -> those layers, (height, width) or (height, width, channels); rgb over the background,
so over black it is associated with alpha."""
COLOUR = ("rgb", "alpha")
"""Layers that light is added up in; the other layers have no mean."""
_FEATURES = {"normals": "normal", "position": "position", "motion": "motion"}


def drawn_by(
    renderer: Renderer,
    gaussians: Gaussians,
    background: Sequence[float] = (0.0, 0.0, 0.0),
    after: Camera | None = None,
) -> Draw:
    """A Draw by the kernels; after: the camera of a whole frame that motion goes to.

    Motion is turned over: in files v is up, and docs/channels.md has y down. Layers need not be contiguous: the
    encoder, which may be another thread, puts them in order.
    """

    def draw(camera: Camera, names: Collection[str]) -> Layers:
        camera, rows, columns = on_tiles(camera)
        if set(names) <= set(COLOUR):
            picture = renderer.render(gaussians, camera, background, contiguous=False)
            layers: Layers = {"rgb": picture.image, "alpha": picture.alpha}
        else:
            wanted = renderer_channels(names)
            picture, found = renderer.render_channels(
                gaussians,
                camera,
                wanted,
                after=after and reframed(after, camera),
                background=background,
                contiguous=False,
            )
            layers = {"rgb": picture.image, "alpha": picture.alpha, "depth": found.depth, "median": found.median}
            layers |= {"first": found.first, "count": found.count, "id": found.index}
            layers |= {name: found.fields[_FEATURES[name]] for name in names if name in _FEATURES}
            if "motion" in layers:
                layers["motion"] = layers["motion"] * np.array([1, -1], np.float32)
        return {name: layers[name][rows, columns] for name in LAYERS if name in names}

    return draw


def renderer_channels(names: Collection[str]) -> tuple[str, ...]:
    """Names, in `Renderer.render_channels`, of those layers that it makes only when asked."""
    return tuple(own for name, own in _FEATURES.items() if name in names)


def on_tiles(camera: Camera) -> tuple[Camera, slice, slice]:
    """A camera whose picture begins with a whole tile of its frame, and where the wanted one is in that."""
    if camera.window is None:
        return camera, slice(None), slice(None)
    left, top = camera.window.x % TILE, camera.window.y % TILE
    larger = crop(camera, -left, -top, camera.width + left, camera.height + top)
    return larger, slice(top, None), slice(left, None)
