# SPDX-License-Identifier: Apache-2.0
"""`clsplat convert`: a model file to another format, edited on the way."""

from __future__ import annotations

from dataclasses import dataclass, field
from pathlib import Path
from typing import Annotated, Literal

from tyro.conf import Positional, arg

from clsplat.cli.options import DeviceOptions, Flag, RunOrModel, ScenePath, Verb
from clsplat.cli.session import Services
from clsplat.config.verbs import TEST_EVERY


@dataclass(frozen=True)
class Convert(Verb):
    """Write a model in another format, by the files' endings, and say what was lost; or edit it on the way.

    Edits are made in this order: merge, crop, prune, transform, scale, drop-sh. A device is needed for --scene and
    --prune-contribution alone. docs/formats.md has the formats.
    """

    source: RunOrModel
    """A run's folder or a model file."""
    target: Annotated[Positional[Path], arg(metavar="OUTPUT")]
    """The file to write."""
    overwrite: Flag = False
    """Replace a file that is there, the source too."""
    merge: Annotated[tuple[Path, ...], arg(metavar="FILE...")] = ()
    """Add the Gaussians of these model files."""
    crop: Annotated[str | None, arg(metavar="X0,Y0,Z0,X1,Y1,Z1")] = None
    """Keep the Gaussians with their middle in this box. Write --crop=-1,... if it begins with a negative number."""
    crop_sphere: Annotated[str | None, arg(metavar="X,Y,Z,R")] = None
    """Keep the Gaussians with their middle in this sphere."""
    prune_opacity: Annotated[float | None, arg(metavar="FLOAT")] = None
    """Leave out Gaussians whose opacity is less than this, 0 to 1."""
    prune_contribution: Annotated[float | None, arg(metavar="PIXELS")] = None
    """Leave out Gaussians that add less than this to the picture of every one of --cameras: alpha times transmittance,
    summed over the picture, in pixels, as --density.min-contribution in training."""
    cameras: Annotated[Path | None, arg(metavar="PATH")] = None
    """Cameras for --prune-contribution, any that `clsplat render` takes."""
    transform: Annotated[str | None, arg(metavar="FILE|M00,M01,...")] = None
    """Move the model by a 4 x 4 matrix of rotation, one scale and translation (a mirror is allowed too), row by row:
    16 numbers with commas, or a text file with them. Spherical harmonics are turned too."""
    scale: Annotated[float | None, arg(metavar="FLOAT")] = None
    """Multiply positions and sizes by this factor, about the world's origin."""
    drop_sh: Annotated[int | None, arg(metavar="DEGREE")] = None
    """Leave out the spherical harmonics (colour by direction) beyond this degree, 0 to 3."""
    scene: ScenePath = None
    """Measure PSNR on this scene's held-out views before and after, and of the two renders against each other."""
    test_every: int = TEST_EVERY
    """Every n-th view of --scene by name is held out; 0: all its views are measured."""
    resolution: int = 0
    """Longest image side for --scene; 0: the images' size up to 1600."""
    background: Literal["black", "white"] = "black"
    """Background behind the Gaussians and behind images with alpha, for --scene."""
    device: Annotated[DeviceOptions, arg(name="")] = field(default_factory=DeviceOptions)
    json: Flag = False
    """Print the result as JSON."""


def run(verb: Convert, services: Services) -> int:
    """Read, edit, write, read back."""
    from clsplat.cli.convert_work import convert

    return convert(verb, services)
