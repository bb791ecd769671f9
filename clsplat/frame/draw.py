# SPDX-License-Identifier: Apache-2.0
"""A `Draw` makes the named layers of a camera's picture; here, the one by the kernels."""

from __future__ import annotations

from collections.abc import Callable, Collection, Sequence
from typing import TYPE_CHECKING, Any

import numpy as np
from numpy.typing import NDArray

from clsplat.camera import Camera
from clsplat.config.channels import CHANNELS, kernel_names, light_and_rest
from clsplat.device.layout import TILE
from clsplat.frame.window import crop, reframed
from clsplat.stages.channels import Features

if TYPE_CHECKING:
    from clsplat.gaussians import Gaussians
    from clsplat.rendering.renderer import Renderer


Layers = dict[str, NDArray[Any]]
Draw = Callable[[Camera, Collection[str]], Layers]
"""(camera, names of layers) -> those layers, (height, width) or (height, width, channels); rgb over the background,
so over black it is associated with alpha."""


def drawn_by(
    renderer: Renderer,
    gaussians: Gaussians,
    background: Sequence[float] = (0.0, 0.0, 0.0),
    after: Camera | None = None,
) -> Draw:
    """A Draw by the kernels; after: the camera of a whole frame that motion goes to.

    Layers need not be contiguous: the encoder, which may be another thread, puts them in order.
    """

    def draw(camera: Camera, names: Collection[str]) -> Layers:
        camera, rows, columns = on_tiles(camera)
        _, rest = light_and_rest(names)
        planes: Layers = {}
        if not rest:
            picture = renderer.render(gaussians, camera, background, contiguous=False)
        else:
            picture, planes = renderer.render_channels(
                gaussians,
                camera,
                kernel_names(rest, "features"),
                after=after and reframed(after, camera),
                background=background,
                contiguous=False,
            )
        layers: Layers = {"rgb": picture.image, "alpha": picture.alpha}
        layers |= {name: _in_file(planes[CHANNELS[name].kernel], CHANNELS[name].signs) for name in rest}
        return {name: layers[name][rows, columns] for name in names}

    return draw


def _in_file(plane: NDArray[Any], signs: tuple[int, ...]) -> NDArray[Any]:
    return plane * np.array(signs, np.float32) if signs else plane


def feature_floats(names: Collection[str]) -> int:
    """Floats of each Gaussian's that these channels are blended from, 0 where they are colour alone."""
    _, rest = light_and_rest(names)
    return Features.of(kernel_names(rest, "features")).floats if rest else 0


def on_tiles(camera: Camera) -> tuple[Camera, slice, slice]:
    """A camera whose picture begins with a whole tile of its frame, and where the wanted one is in that."""
    if camera.window is None:
        return camera, slice(None), slice(None)
    left, top = camera.window.x % TILE, camera.window.y % TILE
    larger = crop(camera, -left, -top, camera.width + left, camera.height + top)
    return larger, slice(top, None), slice(left, None)
