# SPDX-License-Identifier: Apache-2.0
"""The frame pipeline: all passes that make a frame, always in the same order.

The kernels render in the model's colour space. The result is converted to linear light, filtered, averaged over
samples, and warped; at the end it is converted to the colour space of the file. A strip is a window of the picture, and
goes through all passes by itself.
"""

from __future__ import annotations

from collections.abc import Callable, Collection, Mapping, Sequence
from dataclasses import dataclass
from functools import partial

import numpy as np

from clsplat.camera import Camera
from clsplat.config.pictures import PictureConfig, SamplingConfig
from clsplat.frame.deep import (
    Convert,
    DrawDeep,
    Merge,
    deep_converted,
    deep_in_strips,
    deep_sampled,
    deep_warped,
    drawn_in_slices,
)
from clsplat.frame.draw import Draw, Planes, drawn_by
from clsplat.frame.holdout import Cut
from clsplat.frame.lens import Places, Warp
from clsplat.frame.mattes import Matte
from clsplat.frame.samples import sample_cameras, sampled, supersampled
from clsplat.frame.strips import deep_rows, in_strips, strip_rows
from clsplat.frame.warp import warped
from clsplat.gaussians import Gaussians
from clsplat.images.colour import SRGB, Colours
from clsplat.images.cryptomatte import ranked
from clsplat.rendering.renderer import Renderer
from clsplat.stages.holdout import held_bytes

BLANK_COLOUR_TOLERANCE = 1e-6
"""Maximum difference from the background's colour at which a pixel counts as empty. It is not 0, because a mean of
equal samples may differ from them by rounding."""


DrawAt = Callable[[float], Draw]
"""Function that takes a time and returns the function (`Draw`) that renders the frame as it is at this time.

The time is relative to the frame, in frames; 0 if nothing moves."""
Pass = Callable[[DrawAt], DrawAt]
"""A step in making a frame. It takes the drawing function (`DrawAt`) of the previous step, and returns its own."""


@dataclass(frozen=True)
class FrameRequest:
    """A frame to render by a `FramePipeline`.

    at: function that returns the camera of the whole frame, in its final size, at a time in frames; 0 is this frame.
    after, before: cameras of the next and the previous frame, for the channels motion and backward.
    lens: mapping from the distorted frame to an undistorted frame; None for a frame without distortion.
    sampling: settings of this frame's samples of shutter and lens; None uses the job's settings.
    cut: function from a camera to the holdout surfaces in its picture; None without a holdout.
    models: function from a time to the Gaussians; None uses the pipeline's model.
    moved: the model at the next and at the previous frame, for the channels motion and backward; None if it does not
        move.
    """

    at: Callable[[float], Camera]
    after: Camera | None = None
    before: Camera | None = None
    lens: Places | None = None
    sampling: SamplingConfig | None = None
    cut: Cut | None = None
    models: Callable[[float], Gaussians] | None = None
    moved: tuple[Gaussians | None, Gaussians | None] = (None, None)


def at_each_time(apply: Callable[[Draw], Draw]) -> Pass:
    """Return a `Pass` that applies `apply` to the drawing function (`Draw`) of each time."""
    return lambda draw: lambda time: apply(draw(time))


def _at_its_samples(at: Callable[[float], Camera], sampling: SamplingConfig, draw: DrawAt) -> DrawAt:
    """Average, over the shutter's time and the lens's area, the pictures that `draw` renders.

    Returns a function like `draw`. at: function from a time to the camera of the whole frame.
    """
    (middle, cameras), times = sample_cameras(at, sampling), sampling.sample_times
    return lambda time: sampled(draw(time), middle, cameras, lambda index: draw(times[index]))


class FramePipeline:
    """Renderer of the frames of a job: runs the kernels and all later passes, then converts to the file's colours."""

    def __init__(
        self,
        renderer: Renderer,
        gaussians: Gaussians,
        config: PictureConfig | None = None,
        *,
        background: Sequence[float] = (0.0, 0.0, 0.0),
        recorded: str = SRGB,
        mattes: Mapping[str, Matte] | None = None,
    ) -> None:
        """Prepare colours, and check the settings of a job.

        recorded: the model's colour space (`colour.recorded_space`).
        background: colour of the background in the model's colour space; black if alpha is written.
        mattes: Cryptomatte mattes, by channel name.
        Raises InputError for settings and colour spaces that are not compatible.
        """
        self.config = config or PictureConfig()
        self.config.check()
        self.colours = Colours(self.config.colour, recorded)
        self._renderer, self._gaussians, self._background = renderer, gaussians, background
        self._mattes = mattes or {}

    def draw(self, frame: FrameRequest) -> tuple[Draw, Callable[[Planes], Planes]]:
        """Return a function (`Draw`) that renders a frame, and one that converts the result to the file's colours.

        The first is called with the camera of the picture or of a strip, and uses only this camera's size and window.
        The second does not use the device.
        """
        draw = self._by_kernels(frame)
        for apply in self._passes(frame):
            draw = apply(draw)
        colours = self.colours
        space = colours.light if self._in_light(frame) else colours.model
        return draw(self._sampling(frame).middle), lambda planes: self._with_ranks(
            converted(planes, colours, space, colours.output)
        )

    def _by_kernels(self, frame: FrameRequest) -> DrawAt:
        def draw_at(time: float) -> Draw:
            def draw(camera: Camera, names: Collection[str]) -> Planes:
                gaussians = self._gaussians if frame.models is None else frame.models(time)  # made when drawn
                cameras, mattes = (self._background, frame.after, frame.before), self._mattes
                return drawn_by(self._renderer, gaussians, *cameras, frame.cut, *frame.moved, mattes)(camera, names)

            return draw

        return draw_at

    def _passes(self, frame: FrameRequest) -> list[Pass]:
        """The passes of a frame that follow the kernels, in order."""
        sampling, framing = self._sampling(frame), self.config.framing
        passes: list[Pass] = []
        if self._in_light(frame):
            passes += [at_each_time(self._to_light), at_each_time(lambda draw: supersampled(draw, framing))]
        if sampling.on:
            passes.append(partial(_at_its_samples, frame.at, sampling))
        if frame.lens is not None:
            warp = Warp(frame.lens, frame.at(sampling.middle))
            passes += [
                at_each_time(partial(self._in_strips, frame)),
                at_each_time(lambda draw: warped(draw, warp)),
            ]
        return passes

    def _to_light(self, draw: Draw) -> Draw:
        """Return a function (`Draw`) that converts the pictures of `draw` to linear light."""
        colours = self.colours
        return lambda camera, names: converted(draw(camera, names), colours, colours.model, colours.light)

    def _in_strips(self, frame: FrameRequest, draw: Draw) -> Draw:
        """Return a function (`Draw`) that renders in strips, so that the model and its pairs fit into device memory."""
        device, framing = self._renderer.device, self.config.framing

        def drawn(camera: Camera, names: Collection[str]) -> Planes:
            planes = held_bytes(frame.cut(camera)) if frame.cut else 0
            return in_strips(draw, strip_rows(device, camera, names, framing, planes))(camera, names)

        return drawn

    def draw_deep(self, bins: int, frame: FrameRequest) -> tuple[DrawDeep, Convert, Callable[[Camera], int]]:
        """Prepare a deep frame, as `draw` prepares a flat one.

        bins: maximum number of slices per pixel.
        Returns three functions. The first renders the frame, the second converts its colours to the file's colour
        space, and the third gives the number of rows of a strip for a camera.
        """
        sampling, colours, device = self._sampling(frame), self.colours, self._renderer.device
        space = colours.light if self._in_light(frame) else colours.model
        middle, cameras = sample_cameras(frame.at, sampling)

        def draw_at(time: float) -> DrawDeep:
            models = frame.models
            draw = drawn_in_slices(self._renderer, lambda: models(time) if models else self._gaussians, bins)
            return draw if space == colours.model else deep_converted(draw, between(colours.model, space))

        def between(source: str, target: str) -> Convert:
            return lambda rgb, alpha: colours.convert(rgb, alpha, source, target)

        def rows(camera: Camera) -> int:
            return deep_rows(device, camera, bins, len(cameras))

        draw = draw_at(sampling.middle)
        if len(cameras) > 1:
            draw = deep_sampled([draw_at(time) for time in sampling.sample_times], cameras, Merge(device, bins))
        if frame.lens is not None:
            draw = deep_warped(deep_in_strips(draw, rows), Warp(frame.lens, middle), Merge(device, bins))
        return draw, between(space, colours.output), rows

    def _with_ranks(self, planes: Planes) -> Planes:
        """The planes, with mattes converted to Cryptomatte's ranks of ids and coverages, as files store them."""
        return {
            name: ranked(plane, self._mattes[name].names) if name in self._mattes else plane
            for name, plane in planes.items()
        }

    def _sampling(self, frame: FrameRequest) -> SamplingConfig:
        """The sampling settings of the frame if it has its own, otherwise those of the job."""
        return frame.sampling or self.config.sampling

    def _in_light(self, frame: FrameRequest) -> bool:
        """True if pixels of the frame are averages of samples, which must be computed in linear light."""
        return self._sampling(frame).on or self.config.framing.supersample > 1 or frame.lens is not None

    def is_blank(self, planes: Planes, frame: FrameRequest) -> bool | None:
        """True if the planes of `draw`, before conversion, show only the background; None if no channel can tell."""
        for name in ("alpha", "count", "depth"):
            if name in planes:
                return not planes[name].any()
        if "rgb" not in planes:
            return None
        behind = np.array(self._background, np.float32).reshape(1, 1, 3)
        if self._in_light(frame):
            behind = self.colours.convert(behind, None, self.colours.model, self.colours.light)
        return bool(np.abs(planes["rgb"] - behind).max() <= BLANK_COLOUR_TOLERANCE)


def converted(planes: Planes, colours: Colours, source: str, target: str) -> Planes:
    """The planes with rgb converted from colour space `source` to `target`.

    If the planes have alpha, rgb is divided by alpha before the conversion and multiplied by it afterwards.
    """
    if source == target or "rgb" not in planes:
        return planes
    return {**planes, "rgb": colours.convert(planes["rgb"], planes.get("alpha"), source, target)}
