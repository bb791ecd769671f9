# SPDX-License-Identifier: Apache-2.0
"""Averages of a frame over samples: over the area of a pixel (supersampling), the time of the shutter, and the lens.

The positions of samples are fixed, and samples of shutter and lens have equal weights. So a frame has the same bits
each time it is rendered. Only linear light is averaged. Channels that cannot be averaged come from a single sample.

Number and times of a frame's samples: `SamplingConfig` in `config/pictures.py`.
"""

from __future__ import annotations

from collections.abc import Callable, Collection, Sequence
from dataclasses import replace
from functools import reduce

import numpy as np
from numpy.typing import NDArray

from clsplat.arrays import Float32, Float64
from clsplat.camera import Camera
from clsplat.config.pictures import SENSOR_WIDTH_MM, Filter, FramingConfig, SamplingConfig
from clsplat.errors import InputError
from clsplat.frame.draw import Draw, Planes, in_two

_FILTER_RADII_PX: dict[Filter, float] = {"box": 0.5, "blackman-harris": 1.5}
"""Radius of each pixel filter, in pixels."""
GOLDEN_ANGLE = np.pi * (3 - 5**0.5)
"""Angle between successive points of Vogel's spiral, in radians."""


def filter_taps(config: FramingConfig) -> NDArray[np.float32]:
    """Weights of the pixel filter for the samples in a line across a pixel and its margins. Their sum is 1."""
    samples, radius = config.supersample, _FILTER_RADII_PX[config.filter]
    margin = samples * _margin(config)
    at = (np.arange(-margin, samples + margin) + 0.5) / samples - 0.5
    if config.filter == "box":
        weights = np.ones(len(at))
    else:
        turn = np.pi * (at / radius + 1)
        weights = 0.35875 - 0.48829 * np.cos(turn) + 0.14128 * np.cos(2 * turn) - 0.01168 * np.cos(3 * turn)
    return np.asarray(weights / weights.sum(), np.float32)


def _margin(config: FramingConfig) -> int:
    """Number of pixels beyond the picture's edge that the pixel filter reads."""
    return int(np.ceil(_FILTER_RADII_PX[config.filter] - 0.5))


def finer(camera: Camera, config: FramingConfig) -> Camera:
    """The camera of the supersampled picture: `supersample` times larger, with the margin that the filter reads.

    Raises InputError like `FramingConfig.check_model`.
    """
    margin, samples = _margin(config), config.supersample
    if margin == 0:
        return camera.resized(camera.width * samples, camera.height * samples)
    config.check_model(camera.model)
    padded = camera.cropped(-margin, -margin, camera.width + 2 * margin, camera.height + 2 * margin)
    return padded.resized(padded.width * samples, padded.height * samples)


def supersampled(draw: Draw, config: FramingConfig) -> Draw:
    """Return a function (`Draw`) that filters rgb and alpha of pictures `supersample` times larger.

    Other channels are not filtered. `draw` must return rgb in linear light, because only linear light may be averaged.
    The order of summation does not depend on the position of the picture in its frame.
    """
    samples = config.supersample
    if samples == 1:
        return draw
    taps = filter_taps(config)

    def shrunk(plane: Float32, axis: int, size: int) -> Float32:
        lines, reach = np.moveaxis(plane, axis, 0), samples * (size - 1) + 1
        parts = (weight * lines[at : at + reach : samples] for at, weight in enumerate(taps))
        return np.moveaxis(reduce(np.add, parts), 0, axis)

    def filtered(camera: Camera, names: Collection[str]) -> Planes:
        planes = draw(finer(camera, config), names)
        return {name: shrunk(shrunk(plane, 0, camera.height), 1, camera.width) for name, plane in planes.items()}

    return in_two(filtered, draw)


def lens_points(count: int) -> Float64:
    """Points (count, 2) on the unit disc, evenly distributed (Vogel's spiral)."""
    index = np.arange(count)
    radius, angle = np.sqrt((index + 0.5) / count), GOLDEN_ANGLE * index
    return np.stack([radius * np.cos(angle), radius * np.sin(angle)], axis=1)


def lens_radius(camera: Camera, config: SamplingConfig) -> float:
    """Radius of the lens opening in scene units. camera: the camera of a whole frame."""
    if config.f_stop is None:
        return config.aperture or 0.0
    focal_length = camera.fx * (config.sensor_width or SENSOR_WIDTH_MM) / camera.width / 1000 / (config.metres or 1.0)
    return focal_length / (2 * config.f_stop)


def through_lens(camera: Camera, x: float, y: float, focus: float) -> Camera:
    """The camera moved to a point (x, y) of its lens, in scene units.

    Its principal point moves too, so that points at depth `focus` do not move in the picture. Raises InputError for a
    camera without an image plane.
    """
    if not camera.is_pinhole:
        raise InputError(f"depth of field is not defined for {camera.projection} cameras; use a perspective camera")
    return replace(
        camera,
        translation=camera.translation - np.array([x, y, 0.0]),
        cx=camera.cx + camera.fx * x / focus,
        cy=camera.cy + camera.fy * y / focus,
    )


def sample_cameras(at: Callable[[float], Camera], config: SamplingConfig) -> tuple[Camera, list[Camera]]:
    """The camera at the middle of shutter time and lens, and the camera of each sample. All show whole frames.

    at: function that returns the camera at a time in frames, relative to the frame.
    A single sample has the camera at the middle.
    """
    middle = at(config.middle)
    if not config.on or config.samples == 1:
        return middle, [middle]
    cameras = [at(time) for time in config.sample_times] if config.moves else [middle] * config.samples
    if config.has_lens:
        focus = config.focus or 0.0
        cameras = [
            through_lens(camera, lens_radius(camera, config) * x, lens_radius(camera, config) * y, focus)
            for camera, (x, y) in zip(cameras, lens_points(config.samples).tolist(), strict=True)
        ]
    return middle, cameras


def sampled(draw: Draw, middle: Camera, cameras: Sequence[Camera], light: Callable[[int], Draw] | None = None) -> Draw:
    """Return a function (`Draw`) whose rgb and alpha are means over samples. Other channels cannot be averaged and come
    from the middle camera.

    The returned function uses only size and window of its camera.

    middle, cameras: cameras of whole frames.
    light: function from a sample's number to the sample's `Draw`; None uses `draw` for all samples.
    `draw` must return rgb in linear light. Sums are float64, in the order of the cameras.
    """

    def blurred(camera: Camera, names: Collection[str]) -> Planes:
        sums: dict[str, Float64] = {}
        for index, sample in enumerate(cameras):
            drawn = draw if light is None else light(index)
            for name, plane in drawn(sample.reframed(camera), names).items():
                if name in sums:
                    sums[name] += plane
                else:
                    sums[name] = plane.astype(np.float64)
        return {name: (total / len(cameras)).astype(np.float32) for name, total in sums.items()}

    return in_two(blurred, lambda camera, names: draw(middle.reframed(camera), names))
