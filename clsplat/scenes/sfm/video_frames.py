# SPDX-License-Identifier: Apache-2.0
"""Videos among the photographs of structure from motion: their frames become photographs. Each video is one camera."""

from __future__ import annotations

from collections.abc import Callable, Collection, Iterator
from contextlib import contextmanager
from dataclasses import dataclass, field, replace
from pathlib import Path

from clsplat.errors import InputError
from clsplat.files.documents import digest
from clsplat.images.video import video_missing
from clsplat.progress import Progress
from clsplat.scenes.sfm.captured_files import captured_files
from clsplat.scenes.sfm.photos import (
    CONVERTED_PHOTO_EXTENSIONS,
    SFM_PHOTO_EXTENSIONS,
    UNREADABLE_PHOTO_EXTENSIONS,
    Photo,
    find_photos,
    photo_name,
    stage_photos,
)
from clsplat.scenes.video.frames import FRAME_TABLE_FILE, frame_sequences, taking_frames
from clsplat.scenes.video.reading import VIDEO_INPUT_SUFFIXES, is_video_name

RECONSTRUCTION_SUFFIX, FRAMES_SUFFIX = "_colmap", "_frames"
"""Suffixes of the names of two folders beside photographs or a video: for the cameras, and for the frames of videos."""


def reconstruction_folder(images: Path) -> Path:
    """Return the folder for the cameras of a folder of photographs, or of a video, if no other is given."""
    name = images.stem if is_video_name(images) and not images.is_dir() else images.name
    return images.with_name(f"{name}{RECONSTRUCTION_SUFFIX}")


def frames_folder(output: Path) -> Path:
    """Return the folder for the frames of videos, beside the folder for their cameras."""
    if output.name in ("", ".."):  # the working folder or the one above it, whose names are not in the path
        output = output.resolve()
    return output.with_name(f"{output.name.removesuffix(RECONSTRUCTION_SUFFIX)}{FRAMES_SUFFIX}")


@dataclass(frozen=True)
class VideoFrames:
    """Frames of the videos in a folder of photographs; none if there are no videos.

    folder: folder of the frames.
    made: hidden folder of new frames, which are to replace those in `folder`; None if they are in `folder`.
    paths: the frames' files, sorted by name.
    sequences: names of the frames of each video, in display order. If a folder of frames was given in place of
        photographs, they are the names of its frames.
    left_out: videos that are not used, keyed by the reason.
    """

    folder: Path
    made: Path | None = None
    paths: list[Path] = field(default_factory=list)
    sequences: list[list[str]] = field(default_factory=list)
    left_out: dict[str, list[Path]] = field(default_factory=dict)

    @property
    def fingerprint(self) -> str:
        """A digest of the frames' table, for the fingerprint of the result; empty without videos.

        The table has digests of the videos. It stays the same if the frames are taken anew, at another time.
        """
        return digest((self.made or self.folder) / FRAME_TABLE_FILE) if self.paths else ""

    @property
    def names(self) -> list[str]:
        """Names of the videos' frames: their paths below the folder of the frames."""
        return [photo_name(self.made or self.folder, path) for path in self.paths]

    @property
    def moves(self) -> list[tuple[Path, Path]]:
        """The move of new frames in place of earlier ones, for `move_into_place`; empty if there is none."""
        return [] if self.made is None else [(self.made, self.folder)]

    def photos_beside(self, images: Path, output: Path) -> tuple[list[Path], dict[str, list[Path]]]:
        """Return the photographs beside the videos, and the files that are left out, as `find_photos` does."""
        if not images.is_dir():
            return [], {}
        photos, left_out = find_photos(images, (output, self.folder), needed=not self.paths)
        return photos, {**left_out, **self.left_out}

    def staged(self, target: Path, report: Callable[[float], None], threads: int) -> list[Photo]:
        """Put the frames under `target`, as `stage_photos` does. Frames of one video share its camera."""
        if not self.paths:
            return []
        return self.by_video(stage_photos(self.made or self.folder, self.paths, target, report, threads))

    def by_video(self, photos: list[Photo]) -> list[Photo]:
        """Add the number of its video to the `lens` of each frame, so that only frames of one video share a camera.

        Returns all photographs. Those that are not frames in `sequences` stay as they are.
        """
        video_of = {name: str(number) for number, names in enumerate(self.sequences) for name in names}
        return [
            replace(photo, lens=(*photo.lens, "video", video_of[photo.name])) if photo.name in video_of else photo
            for photo in photos
        ]


@contextmanager
def frames_of_videos(
    images: Path,
    output: Path,
    count: int | None,
    progress: Progress,
    *,
    overwrite: bool = False,
    folder: Path | None = None,
) -> Iterator[VideoFrames]:
    """Context manager that takes the frames of a video, or of all videos below a folder of photographs.

    Earlier frames are replaced at the end of the block, as by `taking_frames`.

    output: folder for the cameras. count, overwrite: as for `taking_frames`.
    folder: folder for the frames; by default `frames_folder(output)`.
    Without PyAV, videos beside photographs are left out, unless frames are asked for by `count`.
    Raises InputError for a file that is not a video, for a `count` without videos, and if `taking_frames` does.
    """
    folder = folder or frames_folder(output)
    videos = [images]
    parts: dict[str, list[Path]] = {}
    if images.is_dir():
        videos, parts = find_videos(images, (output, folder))
    elif not is_video_name(images):
        if not images.exists():
            raise InputError(f"{images}: no such file or folder, expected a folder with photos, or a video")
        raise InputError(
            f"{images}: is a file, expected a folder with photos, or a video ({' '.join(VIDEO_INPUT_SUFFIXES)})"
        )
    if not videos:
        if count is not None:
            raise InputError(f"--frames {count}: {images} has no videos, expected one")
        yield VideoFrames(folder, sequences=frame_sequences(images), left_out=parts)
        return
    why = video_missing() if count is None and images.is_dir() else ""
    if why and find_photos(images, (output, folder), needed=False)[0]:
        yield VideoFrames(folder, left_out={**parts, why: videos})
        return
    root = images if images.is_dir() else images.parent
    with taking_frames(videos, folder, root=root, count=count, overwrite=overwrite, progress=progress) as taken:
        paths = [taken.folder / name for name in taken.names]
        sequences = [list(video.names) for video in taken.videos]
        yield VideoFrames(folder, taken.folder if taken.pending else None, paths, sequences, parts)


def find_videos(folder: Path, excluded: Collection[Path] = ()) -> tuple[list[Path], dict[str, list[Path]]]:
    """Return the videos below a folder, sorted by name, and the videos that are left out, keyed by the reason.

    A video with the name of a photograph in the same folder is left out, as phones write such videos with their moving
    photographs. The search is that of `captured_files`, which skips the folders `excluded`.
    """
    videos: list[Path] = []
    moving: list[Path] = []
    for here, files in captured_files(folder, excluded).folders:
        kinds = SFM_PHOTO_EXTENSIONS | CONVERTED_PHOTO_EXTENSIONS | UNREADABLE_PHOTO_EXTENSIONS
        stills = {Path(name).stem.casefold() for name in files if Path(name).suffix.lower() in kinds}
        for name in files:
            if is_video_name(Path(name)):
                if not name.isprintable():
                    raise InputError(f"{here / name}: its name has unprintable characters; rename it")
                (moving if Path(name).stem.casefold() in stills else videos).append(here / name)
    key = lambda path: photo_name(folder, path)  # noqa: E731  # shorter than a function for two uses
    why = "a photograph has the same name, as with moving photographs; rename the video to use it"
    return sorted(videos, key=key), {why: sorted(moving, key=key)} if moving else {}
