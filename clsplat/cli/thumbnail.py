# SPDX-License-Identifier: Apache-2.0
"""`clsplat thumbnail`: a picture of a model, for lists and galleries."""

from __future__ import annotations

from dataclasses import dataclass
from pathlib import Path
from typing import Annotated, Any

from tyro.conf import arg

from clsplat.cli import render
from clsplat.cli.options import Flag, RunOrModel, Verb
from clsplat.cli.session import Services
from clsplat.config.pictures import ColourConfig
from clsplat.errors import InputError

SMALLEST, LARGEST = 16, 8192
"""Sides in pixels."""


@dataclass(frozen=True)
class Thumbnail(Verb):
    """Draw one picture of a model: of a run from among its photographs, of a file of all of it, or of what a scene has
    most detail of.

    It is the first frame of `clsplat render MODEL --path turntable`.
    """

    model: RunOrModel
    """A run's folder or a model file."""
    output: Annotated[Path | None, arg(aliases=("-o",), metavar="FILE")] = None
    """The picture: PNG, JPEG, TIFF or EXR; the model's name with .png behind it, in this folder, if not given."""
    size: int = 512
    """Width and height in pixels."""
    up: Annotated[str | None, arg(metavar="AXIS|X,Y,Z")] = None
    """Direction that is up: x, y, z, -x, -y, -z or three numbers; -y if not given, as in a COLMAP scene. With it a run
    is drawn from outside too. Write --up=-z if it begins with a minus."""
    background: Annotated[str | None, arg(metavar="black|white|R,G,B")] = None
    """Colour behind the Gaussians, the numbers from 0 to 1; black if not given."""
    alpha: Flag = False
    """Write alpha, and no background."""
    overwrite: Flag = False
    """Replace a file that clsplat did not make."""
    device: Annotated[str | None, arg(metavar="DEVICE")] = None
    """OpenCL device: an index, cpu, gpu, or a part of a name, as `clsplat devices` lists them. If not given:
    CLSPLAT_DEVICE, else the first GPU, else the first device."""


def run(verb: Thumbnail, services: Services) -> int:
    """The first frame of a turntable around the model."""
    from clsplat.images.frame_files import check_format
    from clsplat.shots.frame_numbers import FIELD, ODD

    if not SMALLEST <= verb.size <= LARGEST:
        raise InputError(f"--size {verb.size}: expected {SMALLEST} to {LARGEST} pixels")
    output = verb.output or Path(f"{verb.model.resolve().name}.png")
    check_format(str(output), ("rgb",))
    if FIELD.search(str(output)) or ODD.search(output.name):
        raise InputError(f"{output}: has a place for frames' numbers, expected the name of one picture, given with -o")
    same: dict[str, Any] = {name: getattr(verb, name) for name in ("up", "background", "alpha", "overwrite", "device")}
    if output.suffix.lower() != ".exr":  # a model of linear colours has a picture too
        same["colour"] = ColourConfig(colorspace="sRGB")
    same |= {"width": verb.size, "height": verb.size}
    frame = render.Render(verb.model, str(output), path="turntable", count=1, **same)
    return render.run(frame.completed(frozenset()), services)
