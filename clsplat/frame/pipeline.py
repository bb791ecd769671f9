# SPDX-License-Identifier: Apache-2.0
"""All steps that make a frame: framing, samples, colour, and strips if it is large.

The order is always the same. The kernels render in the model's colour space. The result is converted to linear light,
filtered and averaged, and then converted to the output's space. A strip is a window of the picture, and passes all
steps on its own.
"""

from __future__ import annotations

from collections.abc import Callable, Collection, Mapping, Sequence

import numpy as np

from clsplat.camera import Camera
from clsplat.config.pictures import PictureConfig, SamplingConfig, WarpConfig
from clsplat.frame.deep import (
    Convert,
    DrawDeep,
    Merge,
    deep_converted,
    deep_in_strips,
    deep_rows,
    deep_sampled,
    deep_warped,
    drawn_in_slices,
)
from clsplat.frame.draw import Draw, Planes, drawn_by
from clsplat.frame.holdout import Cut
from clsplat.frame.lens import Places, Warp
from clsplat.frame.mattes import Matte
from clsplat.frame.samples import sample_cameras, sampled, supersampled
from clsplat.frame.shutter_times import sample_moments
from clsplat.frame.strips import in_strips, strip_rows
from clsplat.frame.warp import warped
from clsplat.gaussians import Gaussians
from clsplat.images.colour import SRGB, Colours
from clsplat.images.cryptomatte import ranked
from clsplat.rendering.renderer import Renderer
from clsplat.stages.holdout import held_bytes

BLANK_COLOUR_TOLERANCE = 1e-6
"""Largest difference from the background's colour at which a pixel counts as empty, since averages of equal samples are
rounded."""


class FramePipeline:
    """Renders the frames of one job."""

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
        background: colour of the background in that space; black if alpha is written.
        mattes: mattes by the names of their channels.
        Raises InputError for settings and colour spaces that do not fit together.
        """
        self.config = config or PictureConfig()
        self.config.check()
        self.colours = Colours(self.config.colour, recorded)
        self._renderer, self._gaussians, self._background = renderer, gaussians, background
        self._mattes = mattes or {}

    def draw(
        self,
        at: Callable[[float], Camera],
        after: Camera | None = None,
        before: Camera | None = None,
        lens: Places | None = None,
        sampling: SamplingConfig | None = None,
        cut: Cut | None = None,
        models: Callable[[float], Gaussians] | None = None,
        moved: tuple[Gaussians | None, Gaussians | None] = (None, None),
    ) -> tuple[Draw, Callable[[Planes], Planes]]:
        """The Draw of a frame, and the conversion of its planes to the file's colours, which needs no device.

        The camera that is passed to the Draw gives only size and window, of the picture or of a strip.
        at: camera of the whole frame, in its final size, at a time in frames from the frame; the time is 0 if nothing
          moves.
        after, before: cameras of the next and the previous frame, for motion.
        lens: warps the picture.
        sampling: sampling of this frame; None means the job's.
        cut: cuts the surfaces of the frame's holdout, for every sample of the frame; None without one.
        models: the Gaussians at a time, None for the pipeline's own.
        moved: Gaussians that motion and backward motion lead to, None if these stand still.
        """
        sampling = sampling or self.config.sampling
        config, colours, space = self.config, self.colours, self.colours.model
        in_light = self._made_in_light(sampling) or lens is not None

        def drawn_at(time: float, moved: tuple[Gaussians | None, Gaussians | None] = (None, None)) -> Draw:
            def draw(camera: Camera, names: Collection[str]) -> Planes:
                gaussians = self._gaussians if models is None else models(time)  # when they are drawn, not before
                cameras, mattes = (self._background, after, before), self._mattes
                return drawn_by(self._renderer, gaussians, *cameras, cut, *moved, mattes)(camera, names)

            return supersampled(self._in_light(draw), config.framing) if in_light else draw

        if in_light:
            space = colours.light
        draw = drawn_at(sampling.middle, moved)
        if sampling.on:
            times = sample_moments(sampling)
            light = None if models is None else lambda index: drawn_at(times[index])
            draw = sampled(draw, *sample_cameras(at, sampling), light)
        if lens is not None:
            device, straight = self._renderer.device, draw

            def rows(camera: Camera, names: Collection[str]) -> Planes:
                planes = held_bytes(cut(camera)) if cut else 0
                return in_strips(straight, strip_rows(device, camera, names, config.framing, planes))(camera, names)

            draw = warped(rows, Warp(lens, at(sampling.middle)))
        return draw, lambda planes: self._with_ranks(converted(planes, colours, space, colours.output))

    def draw_deep(
        self,
        bins: int,
        at: Callable[[float], Camera],
        lens: Places | None = None,
        sampling: SamplingConfig | None = None,
        models: Callable[[float], Gaussians] | None = None,
    ) -> tuple[DrawDeep, Convert, Callable[[Camera], int]]:
        """Deep counterpart of `draw`: the DrawDeep, and the conversion of its colours to the file's.

        Also returns a function from a camera to the rows of its strips.
        """
        sampling = sampling or self.config.sampling
        colours, device = self.colours, self._renderer.device
        space = colours.light if self._made_in_light(sampling) or lens is not None else colours.model

        def drawn_at(time: float) -> DrawDeep:
            draw = drawn_in_slices(self._renderer, lambda: models(time) if models else self._gaussians, bins)
            return draw if space == colours.model else deep_converted(draw, between(colours.model, space))

        def between(source: str, target: str) -> Convert:
            return lambda rgb, alpha: colours.convert(rgb, alpha, source, target)

        def rows(camera: Camera) -> int:
            return deep_rows(device, camera, bins, len(cameras))

        draw, (middle, cameras) = drawn_at(sampling.middle), sample_cameras(at, sampling)
        if len(cameras) > 1:
            draws = [drawn_at(time) for time in sample_moments(sampling)]
            draw = deep_sampled(draws, cameras, Merge(device, bins))
        if lens is not None:
            draw = deep_warped(deep_in_strips(draw, rows), Warp(lens, middle), Merge(device, bins))
        return draw, between(space, colours.output), rows

    def _with_ranks(self, planes: Planes) -> Planes:
        """The same planes, with mattes in the form in which they are written."""
        return {
            name: ranked(plane, self._mattes[name].names) if name in self._mattes else plane
            for name, plane in planes.items()
        }

    def _in_light(self, draw: Draw) -> Draw:
        """The same picture in linear light."""
        colours = self.colours
        return lambda camera, names: converted(draw(camera, names), colours, colours.model, colours.light)

    def _made_in_light(self, sampling: SamplingConfig) -> bool:
        """True if frames are averages of several, in linear light."""
        return sampling.on or self.config.framing.supersample > 1

    def is_blank(self, planes: Planes, sampling: SamplingConfig | None = None) -> bool | None:
        """True if planes of `draw`, before conversion, show only the background; None if no channel can tell."""
        sampling = sampling or self.config.sampling
        for name in ("alpha", "count", "depth"):
            if name in planes:
                return not planes[name].any()
        if "rgb" not in planes:
            return None
        behind = np.array(self._background, np.float32).reshape(1, 1, 3)
        if self._made_in_light(sampling) or self.config.warp != WarpConfig():
            behind = self.colours.convert(behind, None, self.colours.model, self.colours.light)
        return bool(np.abs(planes["rgb"] - behind).max() <= BLANK_COLOUR_TOLERANCE)


def converted(planes: Planes, colours: Colours, source: str, target: str) -> Planes:
    """The same planes with rgb in another colour space.

    rgb is divided by alpha for the conversion and multiplied again if alpha is present, else it is treated as opaque.
    """
    if source == target or "rgb" not in planes:
        return planes
    return {**planes, "rgb": colours.convert(planes["rgb"], planes.get("alpha"), source, target)}
