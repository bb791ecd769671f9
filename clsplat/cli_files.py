# SPDX-License-Identifier: Apache-2.0
"""The command line of the verbs for model files, as `clsplat.cli` has it for the others."""

from __future__ import annotations

from dataclasses import dataclass
from pathlib import Path
from typing import Annotated, Literal

from tyro.conf import FlagCreatePairsOff, Positional, arg

Flag = Annotated[bool, FlagCreatePairsOff]


@dataclass(frozen=True)
class Convert:
    """Write a model in another format, by the files' endings, and say what was lost; or edit it on the way.

    Edits are made in this order: merge, crop, prune, transform, scale, drop-sh. docs/formats.md has the formats.
    """

    source: Annotated[Positional[Path], arg(metavar="RUN|MODEL")]
    """A run's folder or a model file."""
    target: Annotated[Positional[Path], arg(metavar="OUTPUT")]
    """The file to write."""
    merge: Annotated[tuple[Path, ...], arg(metavar="FILE...")] = ()
    """Add the Gaussians of these model files."""
    crop: Annotated[str | None, arg(metavar="X0,Y0,Z0,X1,Y1,Z1")] = None
    """Keep the Gaussians with their middle in this box. Write --crop=-1,... if it begins with a negative number."""
    crop_sphere: Annotated[str | None, arg(metavar="X,Y,Z,R")] = None
    """Keep the Gaussians with their middle in this sphere."""
    prune_opacity: Annotated[float | None, arg(metavar="FLOAT")] = None
    """Leave out Gaussians of less opacity, 0 to 1."""
    prune_contribution: Annotated[float | None, arg(metavar="PIXELS")] = None
    """Leave out Gaussians that add less than this to the picture of every one of --cameras: alpha times transmittance,
    summed over the picture, in pixels, as --density.min-contribution in training."""
    cameras: Annotated[Path | None, arg(metavar="PATH")] = None
    """Cameras for --prune-contribution, any that `clsplat render` takes."""
    transform: Annotated[str | None, arg(metavar="FILE|M00,M01,...")] = None
    """Move the model by a 4 x 4 matrix of rotation, one scale and translation (a mirror is allowed too), row by row:
    16 numbers with commas, or a text file with them. SH are turned too."""
    scale: Annotated[float | None, arg(metavar="FLOAT")] = None
    """Scale the model about the world's origin."""
    drop_sh: Annotated[int | None, arg(metavar="DEGREE")] = None
    """Leave out SH beyond this degree, 0 to 3."""
    scene: Annotated[Path | None, arg(metavar="SCENE")] = None
    """Measure PSNR on this scene's held-out views before and after, and of the two renders against each other."""
    test_every: int = 8
    """Every n-th view of --scene by name is held out; 0: all its views are measured."""
    resolution: int = 0
    """Longest image side for --scene; 0: the images' size up to 1600."""
    background: Literal["black", "white"] = "black"
    """Background behind the Gaussians and behind images with alpha, for --scene."""
    device: Annotated[str | None, arg(metavar="DEVICE")] = None
    """OpenCL device for --scene and --prune-contribution: an index, cpu, gpu, or a part of a name.
    If not given: CLSPLAT_DEVICE, else the first GPU, else the first device."""
    max_device_mem: Annotated[str | None, arg(metavar="SIZE")] = None
    """Most device memory to use, such as 256MiB or 2G. If not given: all that the device has."""
    json: Flag = False
    """Print the result as JSON."""


@dataclass(frozen=True)
class Info:
    """Say what a model file holds: format, count, SH, bounds, scales, opacities, colour space, what is not finite."""

    model: Annotated[Positional[Path], arg(metavar="RUN|MODEL")]
    """A run's folder or a model file of any format."""
    json: Flag = False
    """Print the result as JSON."""
