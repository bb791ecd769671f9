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
from clsplat.frame.draw import Draw, Layers, drawn_by
from clsplat.frame.shutter_and_lens import sample_cameras, sampled
from clsplat.frame.strips import in_strips, strip_rows, write_in_strips
from clsplat.frame.supersample import supersampled
from clsplat.frame.window import framed
from clsplat.images.channels import write_channels
from clsplat.images.colour import SRGB, Colours
from clsplat.images.exr_header import Header

if TYPE_CHECKING:
    from clsplat.gaussians import Gaussians
    from clsplat.rendering.renderer import Renderer


UNSEEN = 1e-6
"""Most that a colour differs from the background's where nothing is seen: averages of equal samples are rounded."""


class Pictures:
    """Makes the pictures of one job."""

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
        return framed(sample_cameras(at, replace(self.config.sampling, samples=1))[0], self.config.framing)

    def rows(self, camera: Camera, names: Collection[str]) -> int:
        """Rows of the strips that the camera's picture is rendered in, its height where that is none."""
        return strip_rows(self._renderer.device, camera, names, self.config.framing)

    def drawn(self, at: Callable[[float], Camera], after: Camera | None = None) -> Draw:
        """The Draw of a frame's layers, of a camera that says size and window (`camera`, or a strip of it).

        at: the camera of the whole frame, in its final size, at a time in frames from the frame: 0 if nothing moves;
        after: that of the next frame, for motion.
        """
        draw, space = self._in_light(at, after)
        return converted(draw, self.colours, space, self.colours.output)

    def _in_light(self, at: Callable[[float], Camera], after: Camera | None) -> tuple[Draw, str]:
        """`drawn` without the last conversion, and the space that its colours are in."""
        config, colours = self.config, self.colours
        draw = drawn_by(self._renderer, self._gaussians, self._background, after)
        space = colours.model
        if config.sampling.on or config.framing.supersample > 1:
            draw, space = converted(draw, colours, space, colours.light), colours.light
            draw = supersampled(draw, config.framing)
        if config.sampling.on:
            draw = sampled(draw, *sample_cameras(at, config.sampling))
        return draw, space

    def unfinished(
        self, at: Callable[[float], Camera], names: Collection[str], after: Camera | None = None
    ) -> tuple[Layers, Callable[[Layers], Layers]]:
        """The picture's layers before the conversion on the way out, and that conversion, which needs no device."""
        camera = self.camera(at)
        draw, space = self._in_light(at, after)
        colours, rows = self.colours, self.rows(camera, names)
        made = (in_strips(draw, rows) if rows < camera.height else draw)(camera, names)
        return made, lambda layers: in_space(layers, colours, space, colours.output)

    def is_blank(self, layers: Layers) -> bool | None:
        """True if layers of `unfinished` show nothing but the background, None where none of them tells."""
        for name in ("alpha", "count", "depth"):
            if name in layers:
                return not layers[name].any()
        if "rgb" not in layers:
            return None
        behind = np.array(self._background, np.float32).reshape(1, 1, 3)
        if self.config.sampling.on or self.config.framing.supersample > 1:
            behind = self.colours.convert(behind, None, self.colours.model, self.colours.light)
        return bool(np.abs(layers["rgb"] - behind).max() <= UNSEEN)

    def layers(self, at: Callable[[float], Camera], names: Collection[str], after: Camera | None = None) -> Layers:
        """The picture's layers, all at once; its window is `camera(at).window`."""
        return self.drawn(at, after)(self.camera(at), names)

    def write(
        self,
        path: Path,
        at: Callable[[float], Camera],
        names: Collection[str],
        encoding: Encoding | None = None,
        header: Header | None = None,
        after: Camera | None = None,
    ) -> None:
        """Draw and write, in strips where the picture is too large for the memory; the header gets the window."""
        camera, header = self.camera(at), header or Header()
        if path.suffix.lower() == ".exr":
            header = replace(header, window=camera.window)
        rows, draw = self.rows(camera, names), self.drawn(at, after)
        if rows < camera.height:
            write_in_strips(path, draw, camera, names, rows, encoding, header)
        else:
            write_channels(path, draw(camera, names), encoding, header)


def converted(draw: Draw, colours: Colours, source: str, target: str) -> Draw:
    """rgb in another colour space: divided by alpha around the conversion if alpha is drawn too, else opaque."""
    if source == target:
        return draw

    return lambda camera, names: in_space(draw(camera, names), colours, source, target)


def in_space(layers: Layers, colours: Colours, source: str, target: str) -> Layers:
    """The same layers, rgb in another colour space, as `converted`."""
    if source == target or "rgb" not in layers:
        return layers
    return {**layers, "rgb": colours.convert(layers["rgb"], layers.get("alpha"), source, target)}
