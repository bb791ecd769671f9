# SPDX-License-Identifier: Apache-2.0
"""`clsplat stmaps`: STMaps of the lens distortion of photographs, for compositing."""

from __future__ import annotations

import json
from dataclasses import dataclass
from pathlib import Path
from typing import Annotated, Any

from tyro.conf import Positional, arg

from clsplat.cli.options import Flag, Verb
from clsplat.cli.session import Services
from clsplat.errors import InputError, examples, reason_of


@dataclass(frozen=True)
class StmapsVerb(Verb):
    """Write the lenses of a scene's photographs as STMaps, to distort a render and to undistort a photograph.

    NAME.distort.exr adds the photograph's distortion to an undistorted picture, such as a frame of `clsplat render
    --cameras SCENE`. NAME.undistort.exr removes it from the photograph.
    """

    scene: Annotated[Positional[Path], arg(metavar="SCENE")]
    """Folder of a COLMAP model or of a scene that contains one, a transforms.json, or cameras of a survey."""
    output: Annotated[Path, arg(aliases=("-o",), metavar="FOLDER")]
    """Folder for the maps, created if missing. Each lens has a pair: lens-1.distort.exr, lens-1.undistort.exr and so
    on."""
    json: Flag = False
    """Print the lenses as JSON: name, model, size, undistorted size, files, pictures."""


def run(verb: StmapsVerb, _: Services) -> int:
    """Write the two STMaps of each lens that has distortion."""
    import numpy as np

    from clsplat.frame.lens import distorted_places, undistorted_places
    from clsplat.images.stmap import write_stmap
    from clsplat.shots.read import photographed

    if not verb.scene.exists():
        raise InputError(
            f"{verb.scene}: no such folder or file, expected a COLMAP model, a transforms.json or cameras of a survey"
        )
    pictures: dict[Any, list[str]] = {}
    for image in photographed(verb.scene):
        if not image.lens.is_pinhole:
            pictures.setdefault(image.lens, []).append(image.name)
    if not pictures:
        raise InputError(
            f"{verb.scene}: its lenses have no distortion, expected the cameras of the original photographs"
        )
    if verb.output.exists() and not verb.output.is_dir():
        raise InputError(f"{verb.output}: is a file, expected a folder for the STMaps")
    try:
        verb.output.mkdir(parents=True, exist_ok=True)
    except OSError as error:
        raise InputError(f"{verb.output}: cannot be created: {reason_of(error)}") from None
    records = []
    for index, (lens, names) in enumerate(pictures.items(), 1):
        straight = lens.pinhole(np.eye(3), np.zeros(3))
        files = [verb.output / f"lens-{index}.{direction}.exr" for direction in ("distort", "undistort")]
        write_stmap(files[0], distorted_places(lens, straight), straight.width, straight.height)
        write_stmap(files[1], undistorted_places(lens, straight), lens.width, lens.height)
        records.append(
            {
                "name": f"lens-{index}",
                "model": lens.model,
                "size": [lens.width, lens.height],
                "undistorted": [straight.width, straight.height],
                "files": [str(file) for file in files],
                "pictures": names,
            }
        )
        if not verb.json:
            sizes = f"{lens.width}x{lens.height}, undistorted {straight.width}x{straight.height}"
            print(f"{files[0]}, {files[1]}: {lens.model} {sizes}, for {examples(names)}")
    if verb.json:
        print(json.dumps(records, indent=2))
    return 0
