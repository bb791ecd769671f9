# SPDX-License-Identifier: Apache-2.0
"""A frame with everything that is asked of it: framing, samples, colour, and strips where it is large.

One order for all of them: the kernels draw in the model's space; that becomes light, which is filtered and averaged;
what comes out is converted. A strip is a window of the picture, so that it goes through all of this alone.
"""

from __future__ import annotations

from collections.abc import Callable, Collection, Sequence
from dataclasses import replace
from pathlib import Path
from typing import TYPE_CHECKING

import numpy as np

from clsplat.camera import Camera
from clsplat.config.pictures import Encoding, PictureConfig
from clsplat.frame.draw import Draw, Planes, drawn_by
from clsplat.frame.shutter_and_lens import sample_cameras, sampled
from clsplat.frame.strips import in_strips, strip_rows, write_in_strips
from clsplat.frame.supersample import supersampled
from clsplat.frame.window import framed
from clsplat.images.colour import SRGB, Colours
from clsplat.images.exr_header import Header

if TYPE_CHECKING:
    from clsplat.gaussians import Gaussians
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
    ) -> None:
        """recorded: the model's colour space (`colour.recorded_space`); background: in that space, black where alpha is
        written. Raises InputError for settings and spaces that make no sense."""
        self.config = config or PictureConfig()
        self.config.check()
        self.colours = Colours(self.config.colour, recorded)
        self._renderer, self._gaussians, self._background = renderer, gaussians, background

    def camera(self, at: Callable[[float], Camera]) -> Camera:
        """The picture's camera, of the middle of the shutter: for its size, its window and the file's header."""
        return framed(at(self.config.sampling.middle), self.config.framing)

    def rows(self, camera: Camera, names: Collection[str]) -> int:
        """Rows of the strips that the camera's picture is rendered in, its height where that is none."""
        return strip_rows(self._renderer.device, camera, names, self.config.framing)

    def _draw(self, at: Callable[[float], Camera], after: Camera | None) -> tuple[Draw, Callable[[Planes], Planes]]:
        """The Draw of a camera that says size and window (`camera`, or a strip of it), and the last conversion."""
        config, colours, space = self.config, self.colours, self.colours.model
        draw = drawn_by(self._renderer, self._gaussians, self._background, after)
        if config.sampling.on or config.framing.supersample > 1:
            space, drawn = colours.light, draw

            def in_light(camera: Camera, names: Collection[str]) -> Planes:
                return converted(drawn(camera, names), colours, colours.model, colours.light)

            draw = supersampled(in_light, config.framing)
        if config.sampling.on:
            draw = sampled(draw, *sample_cameras(at, config.sampling))
        return draw, lambda planes: converted(planes, colours, space, colours.output)

    def unfinished(
        self, at: Callable[[float], Camera], names: Collection[str], after: Camera | None = None
    ) -> tuple[Planes, Callable[[Planes], Planes]]:
        """The picture's channels before the conversion on the way out, and that conversion, which needs no device.

        at: the camera of the whole frame, in its final size, at a time in frames from the frame: 0 if nothing moves;
        after: that of the next frame, for motion.
        """
        camera = self.camera(at)
        draw, finish = self._draw(at, after)
        return in_strips(draw, self.rows(camera, names))(camera, names), finish

    def is_blank(self, planes: Planes) -> bool | None:
        """True if planes of `unfinished` show nothing but the background, None where none of them tells."""
        for name in ("alpha", "count", "depth"):
            if name in planes:
                return not planes[name].any()
        if "rgb" not in planes:
            return None
        behind = np.array(self._background, np.float32).reshape(1, 1, 3)
        if self.config.sampling.on or self.config.framing.supersample > 1:
            behind = self.colours.convert(behind, None, self.colours.model, self.colours.light)
        return bool(np.abs(planes["rgb"] - behind).max() <= UNSEEN)

    def write(
        self,
        path: Path,
        at: Callable[[float], Camera],
        names: Collection[str],
        encoding: Encoding | None = None,
        header: Header | None = None,
        after: Camera | None = None,
    ) -> None:
        """Draw and write the picture in the strips that the memory has room for; an EXR's header gets the window."""
        camera, header = self.camera(at), header or Header()
        if path.suffix.lower() == ".exr":
            header = replace(header, window=camera.window)
        draw, finish = self._draw(at, after)

        def finished(strip: Camera, asked: Collection[str]) -> Planes:
            return finish(draw(strip, asked))

        write_in_strips(path, finished, camera, names, self.rows(camera, names), encoding, header)


def converted(planes: Planes, colours: Colours, source: str, target: str) -> Planes:
    """The same planes, rgb in another colour space: divided by alpha around the conversion if that is among them, else
    opaque."""
    if source == target or "rgb" not in planes:
        return planes
    return {**planes, "rgb": colours.convert(planes["rgb"], planes.get("alpha"), source, target)}
