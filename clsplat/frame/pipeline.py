# SPDX-License-Identifier: Apache-2.0
"""A frame with everything that is asked of it: framing, samples, colour, and strips where it is large.

One order for all of them: the kernels draw in the model's space; that becomes light, which is filtered and averaged;
what comes out is converted. A strip is a window of the picture, so that it goes through all of this alone.
"""

from __future__ import annotations

from collections.abc import Callable, Collection, Mapping, Sequence

import numpy as np

from clsplat.camera import Camera
from clsplat.config.pictures import PictureConfig, SamplingConfig, WarpConfig
from clsplat.frame.draw import Draw, Planes, drawn_by
from clsplat.frame.holdout import Cut
from clsplat.frame.lens import Places, Warp
from clsplat.frame.objects import Matte
from clsplat.frame.samples import sample_cameras, sampled, supersampled
from clsplat.frame.strips import in_strips, strip_rows
from clsplat.frame.times import sample_moments
from clsplat.frame.warp import warped
from clsplat.gaussians import Gaussians
from clsplat.images.colour import SRGB, Colours
from clsplat.images.cryptomatte import ranked
from clsplat.rendering.renderer import Renderer
from clsplat.stages.holdout import held_bytes

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
        before: Camera | None = None,
        lens: Places | None = None,
        sampling: SamplingConfig | None = None,
        cut: Cut | None = None,
        models: Callable[[float], Gaussians] | None = None,
        moved: tuple[Gaussians | None, Gaussians | None] = (None, None),
    ) -> tuple[Draw, Callable[[Planes], Planes]]:
        """The Draw of a camera that says size and window, of the picture or a strip of it; and the conversion that
        makes its planes the file's, which needs no device.

        at: the camera of the whole frame, in its final size, at a time in frames from the frame: 0 if nothing moves;
        after, before: those of the next frame and of the frame before, for motion; lens: it bends the picture;
        sampling: of this frame, else that of all; cut: of the frame's hold-out, for every sample of the frame. models:
        the Gaussians at these times, where they are not the pipeline's own; moved: those that motion and backward
        motion go to, where they do not stand still.
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

    def _made_in_light(self, sampling: SamplingConfig) -> bool:
        """True if frames are made of several, in linear light."""
        return sampling.on or self.config.framing.supersample > 1

    def is_blank(self, planes: Planes, sampling: SamplingConfig | None = None) -> bool | None:
        """True if planes of `draw`, not converted, show nothing but the background, None where none of them tells."""
        sampling = sampling or self.config.sampling
        for name in ("alpha", "count", "depth"):
            if name in planes:
                return not planes[name].any()
        if "rgb" not in planes:
            return None
        behind = np.array(self._background, np.float32).reshape(1, 1, 3)
        if self._made_in_light(sampling) or self.config.warp != WarpConfig():
            behind = self.colours.convert(behind, None, self.colours.model, self.colours.light)
        return bool(np.abs(planes["rgb"] - behind).max() <= UNSEEN)


def converted(planes: Planes, colours: Colours, source: str, target: str) -> Planes:
    """The same planes, rgb in another colour space: divided by alpha around the conversion if that is among them, else
    opaque."""
    if source == target or "rgb" not in planes:
        return planes
    return {**planes, "rgb": colours.convert(planes["rgb"], planes.get("alpha"), source, target)}
