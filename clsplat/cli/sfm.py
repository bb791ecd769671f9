# SPDX-License-Identifier: Apache-2.0
"""`clsplat sfm`: structure from motion, which makes a COLMAP scene from photos and videos."""

from __future__ import annotations

import json
import sys
from dataclasses import dataclass
from pathlib import Path
from typing import Annotated, Literal

from tyro.conf import Positional, arg

from clsplat.cli.options import Flag, OptionalInt, Output, Verb
from clsplat.cli.session import Services
from clsplat.config.masks import MaskMeaning, MaskUse
from clsplat.config.orientation import FrameUse
from clsplat.errors import InputError
from clsplat.progress import StageProgress


@dataclass(frozen=True)
class SfmVerb(Verb):
    """Turn photos and videos into a scene: COLMAP's cameras and points, and the undistorted images."""

    photos: Annotated[Positional[Path], arg(metavar="PHOTOS|VIDEO")]
    """Folder with photos, videos or both, searched with its sub-folders; or a video. Each video is a camera. HEIC, AVIF
    and raw files need pip install 'clsplat[photos]'."""
    output: Output
    """Folder for the scene. The frames of videos are written to a folder beside it, NAME_frames."""
    frames: OptionalInt = None
    """Number of frames to take from each video: the sharpest of as many stretches of equal motion. If not given: frames
    that were taken before are used, of any number; otherwise length and motion decide, at most 300."""
    mapper: Literal["auto", "global", "incremental"] = "auto"
    """Place one camera after another, or all at once. auto: one after another, and all at once if few are placed. auto
    begins with all at once if there are many cameras, with fewer than 5 photos each in the mean."""
    features: Literal["sift", "aliked"] = "sift"
    """Features to match. aliked: features of a neural network, which needs the extra `learned`."""
    weights: Annotated[str | None, arg(metavar="PATH")] = None
    """Network of --features aliked: an ONNX file, or a name to fetch, aliked-n16rot or aliked-n32. If not given:
    aliked-n16rot. If it cannot be fetched within 30 seconds, SIFT features are used."""
    matching: Literal["auto", "exhaustive", "sequential", "spatial", "retrieval"] = "auto"
    """Pairs of photos to match: all, neighbours in name order or in a video, the nearest by GPS, or the most similar.
    auto: all up to 40 photos, neighbours and similar frames of videos, near photos with GPS, else similar photos. After
    near or similar photos, pairs that show the same by the first matches are matched too."""
    camera_model: Annotated[str, arg(metavar="MODEL")] = "auto"
    """Lens model to fit, by COLMAP's name. The scene's images are undistorted with it. auto: OPENCV for a camera with
    20 photos or more, else SIMPLE_RADIAL."""
    threads: OptionalInt = None
    """Number of CPU threads. If not given: one per core."""
    seed: int = 0
    """Random seed of matching and reconstruction. The same seed gives the same cameras, for up to 80 photos."""
    orient: Annotated[Literal["up", "none"] | None, arg(metavar="up|none")] = None
    """up: turn the scene upright, with up along -y, the ground at zero and the middle in the middle. none: COLMAP's own
    axes, which are arbitrary. If not given: up, but an existing scene keeps its frame. Cameras are not recovered anew.
    sparse/0/frame.json has the transform."""
    scale: str = ""
    """Length that makes the scene's units metres. A.JPG,B.JPG=METRES: the distance between the cameras of two photos.
    X,Y,Z,X,Y,Z=METRES: between two points of the scene, which the viewer measures. gps: the positions in the photos'
    EXIF, with z to the north if the scene is turned up too. If not given: no unit is known."""
    masks: Flag = False
    """Detect no features in the black areas of the photos' masks (masks/IMAGE.jpg.png and the like). The undistorted
    masks are written to the scene."""
    invert_masks: Flag = False
    """Invert the masks: use their black areas, and ignore the white ones."""
    alpha: Flag = False
    """Detect no features where the photos are transparent, and write these areas as masks to the scene."""
    overwrite: Flag = False
    """Replace an existing scene in the output folder that was made from other photos or with other settings."""
    json: Flag = False
    """Print the result as JSON: the scene's sfm.json, and its frame.json as `frame`."""


def run(verb: SfmVerb, services: Services) -> int:
    """Run structure from motion on the photos and videos, and write the scene."""
    if verb.frames is not None and verb.frames < 1:
        raise InputError(f"--frames {verb.frames}: expected at least 1")
    if not verb.photos.exists():
        raise InputError(f"{verb.photos}: no such file or folder, expected a folder with photos, or a video")
    if verb.threads is not None and verb.threads < 1:
        raise InputError(f"--threads {verb.threads}: expected at least 1")
    if verb.invert_masks and not verb.masks:
        raise InputError("--invert-masks: no masks are used without --masks, expected both flags")
    from clsplat.scenes.orientation.frame_record import read_frame
    from clsplat.scenes.sfm.captured_files import SFM_RECORD_FILE
    from clsplat.scenes.sfm.framing import MODEL_FOLDER
    from clsplat.scenes.sfm.reconstruct import SfmSettings

    frame = FrameUse(verb.orient, verb.scale)
    settings = SfmSettings(
        matching=verb.matching,
        camera_model=verb.camera_model,
        seed=verb.seed,
        mapper=verb.mapper,
        features=verb.features,
        weights=verb.weights,
        frame=frame,
    )
    settings.check()
    masks = None
    if verb.masks or verb.alpha:
        of_masks: MaskMeaning = "ignore" if verb.masks else "none"
        masks = MaskUse(of_masks, "ignore" if verb.alpha else "blend", verb.invert_masks)
    services.reconstruct(
        verb.photos,
        verb.output,
        settings,
        threads=verb.threads,
        overwrite=verb.overwrite,
        masks=masks,
        frames=verb.frames,
        progress=StageProgress(),
    )
    known = read_frame(verb.output / MODEL_FOLDER)
    for note in known.notes:
        print(note, file=sys.stderr)
    if verb.json:
        record = json.loads((verb.output / SFM_RECORD_FILE).read_text("utf-8"))
        print(json.dumps({**record, "frame": known.document()}, indent=2))
    print(f"scene in {verb.output}; next: clsplat train {verb.output} -o RUN", file=sys.stderr)
    return 0
