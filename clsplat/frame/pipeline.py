# SPDX-License-Identifier: Apache-2.0
"""A frame with everything that is asked of it: framing, samples, colour, and strips where it is large.

One order for all of them: the kernels draw in the model's space; that becomes light, which is filtered and averaged;
what comes out is converted. A strip is a window of the picture, so that it goes through all of this alone.
"""

from __future__ import annotations

from collections.abc import Callable, Collection, Mapping, Sequence

import numpy as np

from clsplat.camera import Camera
from clsplat.config.pictures import PictureConfig
from clsplat.frame.draw import Draw, Planes, drawn_by
from clsplat.frame.holdout import Cut
from clsplat.frame.moments import sample_moments
from clsplat.frame.objects import Matte
from clsplat.frame.samples import sample_cameras, sampled, supersampled
from clsplat.gaussians import Gaussians
from clsplat.images.colour import SRGB, Colours
from clsplat.images.cryptomatte import ranked
from clsplat.rendering.renderer import Renderer

UNSEEN = 1e-6
"""Most that a colour differs from the background's where nothing is seen: averages of equal samples are rounded."""


class FramePipeline:
    """Makes the frames of one job."""

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
        """recorded: the model's colour space (`colour.recorded_space`); background: in that space, black where alpha is
        written; mattes: by the names of their channels. Raises InputError for settings and spaces that make no
        sense."""
        self.config = config or PictureConfig()
        self.config.check()
        self.colours = Colours(self.config.colour, recorded)
        self._renderer, self._gaussians, self._background = renderer, gaussians, background
        self._mattes = mattes or {}

    def draw(
        self,
        at: Callable[[float], Camera],
        after: Camera | None = None,
        cut: Cut | None = None,
        models: Callable[[float], Gaussians] | None = None,
        moved: Gaussians | None = None,
    ) -> tuple[Draw, Callable[[Planes], Planes]]:
        """The Draw of a camera that says size and window, of the picture or a strip of it; and the conversion that
        makes its planes the file's, which needs no device.

        at: the camera of the whole frame, in its final size, at a time in frames from the frame: 0 if nothing moves;
        after: that of the next frame, for motion; cut: of the frame's hold-out, for every sample of the frame. models:
        the Gaussians at these times, where they are not the pipeline's own; moved: those that motion goes to, where
        they do not stand still.
        """
        config, colours, space = self.config, self.colours, self.colours.model
        in_light = config.sampling.on or config.framing.supersample > 1

        def drawn_at(time: float, moved: Gaussians | None = None) -> Draw:
            def draw(camera: Camera, names: Collection[str]) -> Planes:
                gaussians = self._gaussians if models is None else models(time)  # when they are drawn, not before
                how = (self._background, after, cut, moved, self._mattes)
                return drawn_by(self._renderer, gaussians, *how)(camera, names)

            return supersampled(self._in_light(draw), config.framing) if in_light else draw

        if in_light:
            space = colours.light
        draw = drawn_at(config.sampling.middle, moved)
        if config.sampling.on:
            times = sample_moments(config.sampling)
            light = None if models is None else lambda index: drawn_at(times[index])
            draw = sampled(draw, *sample_cameras(at, config.sampling), light)
        return draw, lambda planes: self._with_ranks(converted(planes, colours, space, colours.output))

    def _with_ranks(self, planes: Planes) -> Planes:
        """The same planes, those of mattes as they are written."""
        return {
            name: ranked(plane, self._mattes[name].names) if name in self._mattes else plane
            for name, plane in planes.items()
        }

    def _in_light(self, draw: Draw) -> Draw:
        """The same picture in linear light."""
        colours = self.colours
        return lambda camera, names: converted(draw(camera, names), colours, colours.model, colours.light)

    def is_blank(self, planes: Planes) -> bool | None:
        """True if planes of `draw`, not converted, show nothing but the background, None where none of them tells."""
        for name in ("alpha", "count", "depth"):
            if name in planes:
                return not planes[name].any()
        if "rgb" not in planes:
            return None
        behind = np.array(self._background, np.float32).reshape(1, 1, 3)
        if self.config.sampling.on or self.config.framing.supersample > 1:
            behind = self.colours.convert(behind, None, self.colours.model, self.colours.light)
        return bool(np.abs(planes["rgb"] - behind).max() <= UNSEEN)


def converted(planes: Planes, colours: Colours, source: str, target: str) -> Planes:
    """The same planes, rgb in another colour space: divided by alpha around the conversion if that is among them, else
    opaque."""
    if source == target or "rgb" not in planes:
        return planes
    return {**planes, "rgb": colours.convert(planes["rgb"], planes.get("alpha"), source, target)}
