# SPDX-License-Identifier: Apache-2.0
"""Which pixels of a frame are rendered, and how finely: overscan, region of interest, supersampling.

A `Draw` makes the named layers of a camera's picture; what is here takes one and gives another. A picture is a window
of its frame (`Camera.window`), and its pixels have the bits that the frame's have there (docs/pictures.md).
"""

from __future__ import annotations

from collections.abc import Callable, Collection, Sequence
from dataclasses import replace
from typing import TYPE_CHECKING, Any

import numpy as np
from numpy.typing import NDArray

from clsplat.camera import FRAME_CLAMP, Camera, Window
from clsplat.config.pictures import Filter, FramingConfig, parse_overscan, parse_region
from clsplat.device.layout import TILE
from clsplat.errors import InputError
from clsplat.images.channels import LAYERS

if TYPE_CHECKING:
    from clsplat.gaussians import Gaussians
    from clsplat.rendering.rasterizer import Renderer

Float32 = NDArray[np.float32]
Layers = dict[str, NDArray[Any]]
Draw = Callable[[Camera, Collection[str]], Layers]
"""(camera, names of layers) -> those layers, (height, width) or (height, width, channels); rgb over the background,
so over black it is associated with alpha."""

COLOUR = ("rgb", "alpha")
"""What light is added up in; of the other layers there is no mean."""
_RADII: dict[Filter, float] = {"box": 0.5, "blackman-harris": 1.5}
_FEATURES = {"normals": "normal", "position": "position", "motion": "motion"}


def framed(camera: Camera, config: FramingConfig) -> Camera:
    """The camera of the picture that is written, of one whose size is the frame's.

    Its window is None where it is the frame. Raises InputError for a region that is not in the frame.
    """
    pixels, share = parse_overscan(config.overscan)
    if config.region:
        x, y, width, height = parse_region(config.region)
        if x + width > camera.width or y + height > camera.height:
            raise InputError(
                f"--region {config.region}: ends at {x + width},{y + height}, expected at most the frame's "
                f"{camera.width},{camera.height}"
            )
        return crop(camera, x, y, width, height)
    across = pixels or round(share * camera.width)
    down = pixels or round(share * camera.height)
    if across == down == 0:
        return camera
    larger = crop(camera, -across, -down, camera.width + 2 * across, camera.height + 2 * down)
    assert larger.window is not None
    clamp = max(FRAME_CLAMP, 2 * across / camera.width, 2 * down / camera.height)
    return replace(larger, window=replace(larger.window, clamp=clamp))


def crop(camera: Camera, x: int, y: int, width: int, height: int) -> Camera:
    """The part of a picture from its pixel (x, y) on, which may lie beyond it."""
    window = camera.window or Window(0, 0, camera.width, camera.height)
    return replace(camera, width=width, height=height, window=replace(window, x=window.x + x, y=window.y + y))


def reframed(camera: Camera, like: Camera) -> Camera:
    """A camera of a whole frame with the size and window of another, whose frame may be larger or smaller."""
    frame = like.window or like
    sized = camera if (camera.width, camera.height) == (frame.width, frame.height) else None
    sized = sized or camera.resized(frame.width, frame.height)
    return replace(sized, width=like.width, height=like.height, window=like.window)


def drawn_by(
    renderer: Renderer,
    gaussians: Gaussians,
    background: Sequence[float] = (0.0, 0.0, 0.0),
    after: Camera | None = None,
) -> Draw:
    """A Draw by the kernels; after: the camera of a whole frame that motion goes to. Motion is turned over: in files v
    is up, and docs/channels.md has y down. Layers need not be contiguous: what puts them in order is left to who
    encodes them, which may be another thread."""

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
    """What `Renderer.render_channels` calls those of the layers that it makes only when asked."""
    return tuple(own for name, own in _FEATURES.items() if name in names)


def on_tiles(camera: Camera) -> tuple[Camera, slice, slice]:
    """A camera whose picture begins with a whole tile of its frame, and where the wanted one is in that."""
    if camera.window is None:
        return camera, slice(None), slice(None)
    left, top = camera.window.x % TILE, camera.window.y % TILE
    larger = crop(camera, -left, -top, camera.width + left, camera.height + top)
    return larger, slice(top, None), slice(left, None)


def filter_taps(config: FramingConfig) -> NDArray[np.float32]:
    """Weights of the samples across a pixel and its margins, symmetric; they add up to 1."""
    samples, radius = config.supersample, _RADII[config.filter]
    margin = samples * _margin(config)
    at = (np.arange(-margin, samples + margin) + 0.5) / samples - 0.5
    if config.filter == "box":
        weights = np.ones(len(at))
    else:
        turn = np.pi * (at / radius + 1)
        weights = 0.35875 - 0.48829 * np.cos(turn) + 0.14128 * np.cos(2 * turn) - 0.01168 * np.cos(3 * turn)
    return np.asarray(weights / weights.sum(), np.float32)


def _margin(config: FramingConfig) -> int:
    """Pixels beyond the picture that its filter looks at."""
    return int(np.ceil(_RADII[config.filter] - 0.5))


def finer(camera: Camera, config: FramingConfig) -> Camera:
    """What is drawn for a picture that is supersampled: larger, with what its filter looks at around it.

    Raises InputError for a panorama, which has nothing around it, where the filter looks beyond a pixel."""
    margin, samples = _margin(config), config.supersample
    if margin == 0:
        return camera.resized(camera.width * samples, camera.height * samples)
    if camera.projection == "equirectangular":
        raise InputError(f"--filter {config.filter}: needs pixels beyond a panorama's edges, expected box")
    padded = crop(camera, -margin, -margin, camera.width + 2 * margin, camera.height + 2 * margin)
    return padded.resized(padded.width * samples, padded.height * samples)


def supersampled(draw: Draw, config: FramingConfig) -> Draw:
    """rgb and alpha from a frame `supersample` times larger, filtered; other layers as without.

    `draw` has to give rgb in linear light: what falls on a pixel adds up in that alone. The sums are in the same order
    wherever the picture is in its frame.
    """
    samples = config.supersample
    if samples == 1:
        return draw
    taps = filter_taps(config)

    def shrunk(plane: Float32, axis: int, size: int) -> Float32:
        parts = [slice(None)] * plane.ndim
        total: Float32 | None = None
        for at, weight in enumerate(taps):
            parts[axis] = slice(at, at + samples * (size - 1) + 1, samples)
            each = weight * plane[tuple(parts)]
            total = each if total is None else total + each
        assert total is not None
        return total

    def fine(camera: Camera, names: Collection[str]) -> Layers:
        light = [name for name in COLOUR if name in names]
        rest = [name for name in names if name not in COLOUR]
        layers = draw(camera, rest) if rest else {}
        if light:
            for name, plane in draw(finer(camera, config), light).items():
                layers[name] = shrunk(shrunk(plane, 0, camera.height), 1, camera.width)
        return {name: layers[name] for name in LAYERS if name in names}

    return fine
