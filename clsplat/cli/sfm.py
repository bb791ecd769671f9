# SPDX-License-Identifier: Apache-2.0
"""`clsplat sfm`: photos to a COLMAP scene."""

from __future__ import annotations

import sys
from dataclasses import dataclass
from pathlib import Path
from typing import Annotated, Literal

from tyro.conf import Positional, arg

from clsplat.cli.options import Flag, OptionalInt, Output, Verb
from clsplat.cli.session import Services
from clsplat.config.masks import MaskMeaning, MaskUse
from clsplat.errors import InputError
from clsplat.progress import StageProgress


@dataclass(frozen=True)
class Sfm(Verb):
    """Turn a folder of photos into a scene: COLMAP's cameras and points, and the undistorted images."""

    photos: Annotated[Positional[Path], arg(metavar="PHOTOS")]
    """Folder with the photos; sub-folders are searched too."""
    output: Output
    """Folder for the scene."""
    matching: Literal["auto", "exhaustive", "sequential"] = "auto"
    """Match every pair of photos, or only neighbours by name, for video frames; auto: every pair up to 100 photos."""
    camera_model: Annotated[str, arg(metavar="MODEL")] = "auto"
    """Lens model to fit, by COLMAP's name; the scene's images are undistorted with it.
    auto is OPENCV for a camera with 20 photos or more, else SIMPLE_RADIAL."""
    threads: OptionalInt = None
    """Number of CPU threads; if not given, one for each core."""
    seed: int = 0
    """Seed of what is random in matching and reconstruction. The same seed gives the same cameras, for up to 80
    photos."""
    masks: Flag = False
    """Look for no features under the masks beside the photos (masks/IMAGE.jpg.png and the like), where they are black,
    and put the masks, undistorted, beside the scene's images."""
    invert_masks: Flag = False
    """Take the masks' black parts for those that count, and their white ones for those that do not."""
    alpha: Flag = False
    """Look for no features where the photos are transparent, and put that as masks beside the scene's images."""
    overwrite: Flag = False
    """Replace a scene in the output folder that was made of other photos or with other settings."""
    json: Flag = False
    """Print what was recovered as JSON, as in the scene's sfm.json."""


def run(verb: Sfm, services: Services) -> int:
    """Recover the cameras."""
    if not verb.photos.is_dir():
        raise InputError(f"{verb.photos}: no such folder, expected one with photos")
    if verb.threads is not None and verb.threads < 1:
        raise InputError(f"--threads {verb.threads}: expected at least 1")
    names = ("matching", "camera_model", "threads", "seed", "overwrite")
    settings = {name: getattr(verb, name) for name in names}
    if verb.invert_masks and not verb.masks:
        raise InputError("--invert-masks: no masks are used, expected --masks too")
    if verb.masks or verb.alpha:
        of_masks: MaskMeaning = "ignore" if verb.masks else "none"
        settings["masks"] = MaskUse(of_masks, "ignore" if verb.alpha else "blend", verb.invert_masks)
    services.reconstruct(verb.photos, verb.output, **settings, progress=StageProgress())
    if verb.json:
        from clsplat.scenes.sfm import RECORD

        print((verb.output / RECORD).read_text("utf-8").rstrip())
    print(f"scene in {verb.output}; next: clsplat train {verb.output} -o RUN", file=sys.stderr)
    return 0
