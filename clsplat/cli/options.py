# SPDX-License-Identifier: Apache-2.0
"""The command line of the verbs for what has been trained, beside those of `clsplat.cli.main`."""

from __future__ import annotations

from dataclasses import dataclass
from pathlib import Path
from typing import Annotated, Literal

from tyro.conf import FlagCreatePairsOff, Positional, arg

from clsplat.config.verbs import HOST, PORT, TEST_EVERY

Flag = Annotated[bool, FlagCreatePairsOff]
Device = Annotated[str | None, arg(metavar="DEVICE")]
Memory = Annotated[str | None, arg(metavar="SIZE")]
Host = Annotated[str, arg(metavar="ADDRESS")]
Folder = Annotated[Path | None, arg(metavar="DIR")]


@dataclass(frozen=True)
class View:
    """Look at a model in the browser: the device renders, the page shows it. Ctrl-C ends it.

    docs/viewer.md has what the page can do.
    """

    model: Annotated[Positional[Path], arg(metavar="RUN|MODEL")]
    """A run's folder or a model file; for a file in a run's folder that run's settings hold."""
    scene: Annotated[Path | None, arg(metavar="SCENE")] = None
    """Folder with the scene, for its cameras and photos; the one the run was trained on if not given."""
    background: Annotated[Literal["black", "white"] | None, arg(metavar="black|white")] = None
    """Background behind the Gaussians. If not given: the run's setting, else black."""
    host: Host = HOST
    """Address that the page is served at: this machine alone, unless another is given."""
    port: int = PORT
    """Port of the page; 0 is any that is free."""
    paths: Folder = None
    """Folder in which the page may save camera paths; they can be downloaded without it."""
    device: Device = None
    """OpenCL device: an index, cpu, gpu, or a part of a name, as `clsplat devices` lists them.
    If not given: CLSPLAT_DEVICE, else the first GPU, else the first device."""
    max_device_mem: Memory = None
    """Most device memory to use, such as 256MiB or 2G. What needs more is done in pieces: slower, with the same result.
    If not given: all that the device has."""


@dataclass(frozen=True)
class Report:
    """Write a run's report: one HTML file with curves, pictures, figures and settings, that loads nothing else.

    docs/report.md says what is in it. A run that is not finished has a report too.
    """

    run: Annotated[Positional[Path], arg(metavar="RUN")]
    """A run's folder."""
    output: Annotated[Path | None, arg(aliases=("-o",), metavar="FILE")] = None
    """The file; report.html in the run's folder if not given."""
    overwrite: Flag = False
    """Replace the file of --output that is there."""
    views: int = 8
    """Number of held-out views that are shown with pictures, at most: the worst, the best and some between. The table
    has all views."""
    json: Flag = False
    """Print the figures as JSON."""


@dataclass(frozen=True)
class Compare:
    """Print runs side by side: scores, Gaussians, times, and the settings that differ."""

    runs: Annotated[Positional[tuple[Path, ...]], arg(metavar="RUN")]
    """Folders of runs, two or more."""
    output: Annotated[Path | None, arg(aliases=("-o",), metavar="FILE")] = None
    """Write a page too, with the curves overlaid and time against error: one HTML file that loads nothing else."""
    overwrite: Flag = False
    """Replace the page that is there."""
    json: Flag = False
    """Print JSON instead of the table."""


@dataclass(frozen=True)
class Convert:
    """Write a model in another format, by the files' endings, and say what was lost; or edit it on the way.

    Edits are made in this order: merge, crop, prune, transform, scale, drop-sh. docs/formats.md has the formats.
    """

    source: Annotated[Positional[Path], arg(metavar="RUN|MODEL")]
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
    scene: Annotated[Path | None, arg(metavar="SCENE")] = None
    """Measure PSNR on this scene's held-out views before and after, and of the two renders against each other."""
    test_every: int = TEST_EVERY
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
