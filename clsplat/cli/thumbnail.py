# SPDX-License-Identifier: Apache-2.0
"""`clsplat thumbnail`: a small picture of a model, for lists and galleries."""

from __future__ import annotations

from dataclasses import dataclass
from pathlib import Path
from typing import Annotated

from tyro.conf import arg

from clsplat.cli.options import Flag, RunOrModel, Verb
from clsplat.cli.render import verb as render
from clsplat.cli.render.flags import RenderVerb
from clsplat.cli.session import Services
from clsplat.config.pictures import ColourConfig
from clsplat.errors import InputError

MIN_THUMBNAIL_SIDE_PX, MAX_THUMBNAIL_SIDE_PX = 16, 8192
"""Smallest and largest side of a thumbnail in pixels."""


@dataclass(frozen=True)
class ThumbnailVerb(Verb):
    """Draw one picture of a model, for lists and galleries.

    A run is seen from among its cameras. A model file is seen from outside: an object as a whole, a scene at its most
    detailed part. The picture is the first frame of `clsplat render MODEL --path turntable`.
    """

    model: RunOrModel
    """A run's folder or a model file."""
    output: Annotated[Path | None, arg(aliases=("-o",), metavar="FILE")] = None
    """Output file: PNG, JPEG, TIFF or EXR. If not given: the model's name plus .png, in the working directory."""
    size: int = 512
    """Width and height in pixels."""
    up: Annotated[str | None, arg(metavar="AXIS|X,Y,Z")] = None
    """Up direction: x, y, z, -x, -y, -z or three numbers; -y if not given, as in a COLMAP scene. Without this flag a
    run is drawn from among its own cameras; with it, from outside, like a model file. Write --up=-z if the value begins
    with a minus."""
    background: Annotated[str | None, arg(metavar="black|white|R,G,B")] = None
    """Colour behind the Gaussians: black, white or three numbers from 0 to 1; black if not given."""
    alpha: Flag = False
    """Write alpha, without a background."""
    overwrite: Flag = False
    """Replace a file that clsplat did not make."""
    device: Annotated[str | None, arg(metavar="DEVICE")] = None
    """OpenCL device: an index, cpu, gpu, or part of a name, as listed by `clsplat devices`. If not given:
    CLSPLAT_DEVICE, else the first GPU, else the first device."""


def run(verb: ThumbnailVerb, services: Services) -> int:
    """Render the first frame of a turntable around the model."""
    from clsplat.images.frame_files import check_format
    from clsplat.shots.frame_numbers import FRAME_FIELD_PATTERN, UNKNOWN_FIELD_PATTERN

    if not MIN_THUMBNAIL_SIDE_PX <= verb.size <= MAX_THUMBNAIL_SIDE_PX:
        raise InputError(f"--size {verb.size}: expected {MIN_THUMBNAIL_SIDE_PX} to {MAX_THUMBNAIL_SIDE_PX} pixels")
    output = verb.output or Path(f"{verb.model.resolve().name}.png")
    check_format(str(output), ("rgb",))
    if FRAME_FIELD_PATTERN.search(str(output)) or UNKNOWN_FIELD_PATTERN.search(output.name):
        raise InputError(f"{output}: is a pattern for frame numbers, expected the name of a single picture after -o")
    is_exr = output.suffix.lower() == ".exr"  # only EXR files keep a model's linear colours
    frame = RenderVerb(
        verb.model,
        str(output),
        path="turntable",
        up=verb.up,
        count=1,
        background=verb.background,
        alpha=verb.alpha,
        width=verb.size,
        height=verb.size,
        colour=ColourConfig() if is_exr else ColourConfig(colorspace="sRGB"),
        overwrite=verb.overwrite,
        device=verb.device,
    )
    return render.run(frame.completed(frozenset()), services)
