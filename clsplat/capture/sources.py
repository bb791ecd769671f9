# SPDX-License-Identifier: Apache-2.0
"""Input of a capture: a folder with photographs, videos or both, or else video files."""

from __future__ import annotations

import os
from collections.abc import Sequence
from dataclasses import dataclass
from pathlib import Path

from clsplat.capture.folder import CaptureFolder
from clsplat.errors import InputError
from clsplat.images.reading import find_images
from clsplat.progress import Progress
from clsplat.scenes.sfm.video_frames import frames_of_videos
from clsplat.scenes.video.frames import take_frames
from clsplat.scenes.video.reading import VIDEO_INPUT_SUFFIXES, is_video_name


@dataclass(frozen=True)
class PhotographSource:
    """Photographs for structure from motion.

    path: folder of the photographs. It may also contain videos, whose frames are used.
    count: number of photographs and of frames together.
    frames: number of frames of each video in `path`; None for a number by the video's length and motion.
    frames_to: folder of the frames of these videos; None if `path` has no videos.
    """

    path: Path
    count: int
    frames: int | None = None
    frames_to: Path | None = None


def check_sources(sources: Sequence[Path], output: Path, frames: int | None = None) -> None:
    """Check the input of a capture before anything is written.

    frames: number of frames of each video, as given; None if not given.
    Raises InputError for input that is missing or is not a video or folder, and for a folder among several inputs. An
    output inside the input is an error too, because its pictures would count as photographs.
    """
    if not sources:
        raise InputError("INPUT is missing, expected a folder of photographs, or videos")
    if frames is not None and frames < 1:
        raise InputError(f"--frames {frames}: expected at least 1")
    for path in sources:
        if not path.exists():
            raise InputError(f"{path}: no such file or folder, expected a video or a folder of photographs")
        if path.is_dir() and len(sources) > 1:
            raise InputError(
                f"{path}: is a folder among {len(sources)} inputs, expected a single folder, or only videos; put the "
                "videos into the folder"
            )
        if path.is_dir() and output.resolve().is_relative_to(path.resolve()):
            raise InputError(
                f"{output}: is inside the input {path}, where its pictures would count as photographs; choose another "
                "output folder"
            )
        if not path.is_dir() and not is_video_name(path):
            raise InputError(
                f"{path}: is a file, expected a folder of photographs or a video ({' '.join(VIDEO_INPUT_SUFFIXES)})"
            )
    if len({path.absolute().anchor for path in sources}) > 1:
        raise InputError("the videos are on several drives, expected one; copy them into one folder, and give that")
    if twice := [path for at, path in enumerate(sources) if path.resolve() in {one.resolve() for one in sources[:at]}]:
        raise InputError(f"{twice[0]}: an input is given twice, expected each video once")
    if output.exists() and not output.is_dir():
        raise InputError(f"{output}: is a file, expected a folder for the results, or a new name")


def photographs_of(
    sources: Sequence[Path], folder: CaptureFolder, frames: int | None, progress: Progress
) -> PhotographSource:
    """Write frames of the videos to the capture's folder. Returns the photographs together with these frames.

    Photographs of a folder are used where they are.

    frames: number of frames of each video; None for a number by the video's length and motion.
    Raises InputError like `take_frames`.
    """
    if not sources[0].is_dir():
        # several videos are named by their paths below their common folder
        root = Path(os.path.commonpath([path.absolute().parent for path in sources])) if len(sources) > 1 else None
        videos = [path.absolute() for path in sources] if root else sources
        taken = take_frames(videos, folder.frames, root=root, count=frames, progress=progress)
        return PhotographSource(folder.frames, len(taken.names))
    (source,) = sources
    with frames_of_videos(source, folder.scene, frames, progress, folder=folder.frames) as found:
        pass
    count = len(find_images(source)) + len(found.paths)
    if not found.paths:
        progress("using the photographs where they are", 1.0)
        return PhotographSource(source, count)
    return PhotographSource(source, count, frames, folder.frames)
