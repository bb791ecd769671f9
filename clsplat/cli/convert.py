# SPDX-License-Identifier: Apache-2.0
"""`clsplat convert`: a model file to another format, edited on the way."""

from __future__ import annotations

import json
from dataclasses import dataclass, field, fields
from math import inf, isclose
from pathlib import Path
from typing import TYPE_CHECKING, Annotated, Any, Literal

from tyro.conf import Positional, arg

from clsplat.cli.options import DeviceOptions, Flag, RunOrModel, ScenePath, Verb
from clsplat.cli.session import Services
from clsplat.config.checks import Rule, check_rules
from clsplat.config.verbs import TEST_EVERY
from clsplat.errors import InputError, warn
from clsplat.progress import StageProgress

if TYPE_CHECKING:
    from clsplat.gaussians import Gaussians
    from clsplat.models.formats import Format

QUICK = 2.0
"""Seconds that writing a file may take without a word."""
NEAR_SLACK = 0.05
"""A part of a near plane: where a file has none it follows from positions, which a format may have rounded."""


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
    """Read, edit, write, read back. What is wrong with the call is found before anything is written."""
    from clsplat.cli import convert_edits
    from clsplat.files import check_new
    from clsplat.images import colour
    from clsplat.models import difference, edit
    from clsplat.models.formats import format_of, format_of_name, load, save
    from clsplat.runs.run import model_file

    source, merged = model_file(verb.source), [model_file(path) for path in verb.merge]
    _check(verb)
    matrix = convert_edits.similarity(verb)
    target_format = format_of_name(verb.target, writable=True)
    check_new(verb.target, overwrite=verb.overwrite, sources=[source, *merged])
    for companion in target_format.side_files(verb.target):
        check_new(companion, overwrite=verb.overwrite)
    original, space = load(source), colour.recorded_space(source)
    edited = convert_edits.edited(verb, services, (source, original), [(path, load(path)) for path in merged], matrix)
    comments = () if space == colour.SRGB else (colour.comment(space),)
    save(verb.target, edited, comments=comments, progress=StageProgress(after=QUICK))
    if space != colour.recorded_space(verb.target):
        warn(f"{verb.target}: {target_format.name} has no place for the colour space, which is {space}")
    read = load(verb.target)
    if not isclose(read.near, edited.near, rel_tol=NEAR_SLACK):
        warn(
            f"{verb.target}: {target_format.name} has no place for the near plane, which is {edited.near:.4g}; readers "
            f"will take {read.near:.4g}"
        )
    written = edit.take(edited, target_format.order(edited)) if target_format.order else edited
    result: dict[str, Any] = {
        "source": _described(source, format_of(source), original),
        "target": _described(verb.target, target_format, read),
        "errors": difference.errors(written, read),
    }
    if verb.scene is not None:
        result["scene"] = convert_edits.measured(verb, services, original, read, matrix)
    if verb.json:
        print(json.dumps(result, indent=2))
        return 0
    for model in (result["source"], result["target"]):
        gaussians = f"{model['gaussians']:,} Gaussians of SH degree {model['sh_degree']}"
        print(f"{model['path']}: {model['format']}, {gaussians}, {model['bytes']:,} bytes")
    print(difference.table(result["errors"]))
    if verb.scene is not None:
        scene = result["scene"]
        print(f"{len(scene['views'])} views  PSNR {scene['before']:.2f} dB before, {scene['after']:.2f} after; the "
              f"renders against each other {scene['between']:.2f}, at least {scene['least_between']:.2f}")  # fmt: skip
    return 0


def _check(verb: Convert) -> None:
    """Raise InputError for a number out of its range, and for flags that lack their companion."""
    from clsplat.gaussians import MAX_SH_DEGREE

    rules: tuple[Rule, ...] = (
        (("scale",), lambda value: value is None or 0 < value < inf, "a number over 0"),
        (("prune_opacity",), lambda value: value is None or 0 <= value <= 1, "0 to 1"),
        (("prune_contribution",), lambda value: value is None or 0 < value < inf, "pixels, a number over 0"),
        (("drop_sh",), lambda value: value is None or 0 <= value <= MAX_SH_DEGREE, f"0 to {MAX_SH_DEGREE}"),
        (("test_every", "resolution"), lambda value: value >= 0, "at least 0"),
    )
    check_rules(verb, "--", rules)
    if (verb.prune_contribution is None) != (verb.cameras is None):
        raise InputError("--prune-contribution and --cameras go together: contributions are to these cameras")
    defaults = {field.name: field.default for field in fields(verb)}
    names = [name for name in ("test_every", "resolution", "background") if getattr(verb, name) != defaults[name]]
    if verb.scene is None and names:
        flags = ", ".join(f"--{name.replace('_', '-')}" for name in names)
        raise InputError(f"{flags}: of measuring on a scene, expected --scene with it")


def _described(path: Path, form: Format, gaussians: Gaussians) -> dict[str, Any]:
    from clsplat.models.info import size

    file = {"path": str(path), "format": form.name, "bytes": size(path, form)}
    return file | {"gaussians": len(gaussians), "sh_degree": gaussians.sh_degree}
