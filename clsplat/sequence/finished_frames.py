# SPDX-License-Identifier: Apache-2.0
"""Existing files: frames of an earlier job, folders, temporary files."""

from __future__ import annotations

import os
from collections.abc import Callable, Sequence
from concurrent.futures import ThreadPoolExecutor
from contextlib import suppress
from pathlib import Path
from typing import Any

from clsplat.config.pictures import VideoConfig
from clsplat.errors import InputError, reason_of
from clsplat.files.documents import is_file
from clsplat.files.locks import abandoned
from clsplat.images.frame_files import attribute, is_foreign, is_whole
from clsplat.images.provenance import MODEL_DIGEST_ATTRIBUTE, SETTINGS_DIGEST_ATTRIBUTE
from clsplat.sequence.task import RenderOptions, Task, digest_of, picture_camera, settings_digest

MAX_FILE_THREADS = 8
"""Largest number of threads that read or write files at once."""
IDENTITY_ATTRIBUTES = (MODEL_DIGEST_ATTRIBUTE, "clsplat:colorspace")
"""Attributes that identify a file's model and colour space."""


def check_folders(tasks: Sequence[Task]) -> None:
    """Raise InputError if a file's folder is a file, cannot be created or is not writable. Creates nothing."""
    for folder in sorted({task.path.parent for task in tasks}):
        nearest = next(path for path in (folder, *folder.parents) if path.exists())
        if not nearest.is_dir():
            raise InputError(f"{nearest}: is a file, expected a folder to write {folder} to")
        if not os.access(nearest, os.W_OK | os.X_OK):
            raise InputError(f"{nearest}: is not writable, expected a folder to write frames to")
    for task in tasks:
        if task.path.is_dir():
            raise InputError(f"{task.path}: is a folder, expected the name of a file")


def make_folders(tasks: Sequence[Task]) -> None:
    """Create the files' folders. Raises InputError."""
    for folder in sorted({task.path.parent for task in tasks}):
        try:
            folder.mkdir(parents=True, exist_ok=True)
        except OSError as error:
            raise InputError(f"{folder}: cannot be made: {reason_of(error)}") from None


def remove_temporaries(tasks: Sequence[Task]) -> None:
    """Remove temporary files that a killed job has left for these frames, but none that is still being written."""
    for path in abandoned(task.path for task in tasks):
        with suppress(OSError):
            path.unlink()


def is_complete(task: Task, options: RenderOptions) -> bool:
    """True if the frame's file is there, with the right size, channels, model and settings, and readable to its end."""
    attributes = {name: value for name, value in options.attributes.items() if name in IDENTITY_ATTRIBUTES}
    attributes[SETTINGS_DIGEST_ATTRIBUTE] = settings_digest(task, options)
    camera = picture_camera(task, options.pictures)
    return is_whole(
        task.path,
        camera.width,
        camera.height,
        options.channels,
        options.encoding,
        attributes,
        deep=options.deep is not None,
        views=len(task.views),
    )


def made_of(tasks: Sequence[Task], options: RenderOptions, config: VideoConfig) -> dict[str, Any]:
    """The provenance record of a video of these frames."""
    frames = [(task.number, settings_digest(task, options)) for task in tasks]
    return {
        MODEL_DIGEST_ATTRIBUTE: options.attributes.get(MODEL_DIGEST_ATTRIBUTE),
        SETTINGS_DIGEST_ATTRIBUTE: digest_of(frames, config),
    }


def complete(tasks: Sequence[Task], options: RenderOptions) -> set[str]:
    """Keys of the frames that `--skip-existing` leaves out."""
    return {task.key for task in _those(tasks, lambda task: is_complete(task, options))}


def untold(tasks: Sequence[Task]) -> list[Path]:
    """The tasks' files that do not record their settings."""
    return [task.path for task in _those(tasks, lambda task: attribute(task.path, SETTINGS_DIGEST_ATTRIBUTE) is None)]


def changed(tasks: Sequence[Task], options: RenderOptions) -> list[Path]:
    """The tasks' files that were made from another model, or with other cameras or settings."""

    def differs(task: Task) -> bool:
        wanted = {**options.attributes, SETTINGS_DIGEST_ATTRIBUTE: settings_digest(task, options)}
        found = {name: attribute(task.path, name) for name in (*IDENTITY_ATTRIBUTES, SETTINGS_DIGEST_ATTRIBUTE)}
        return any(value not in (None, wanted.get(name)) for name, value in found.items())

    return [task.path for task in _those(tasks, differs)]


def foreign(tasks: Sequence[Task]) -> list[Path]:
    """The tasks' files that are pictures from other programs."""
    return [task.path for task in _those(tasks, lambda task: is_file(task.path) and is_foreign(task.path))]


def _those(tasks: Sequence[Task], condition: Callable[[Task], bool]) -> list[Task]:
    """The tasks whose files meet a condition; several files are read at once."""
    with ThreadPoolExecutor(MAX_FILE_THREADS) as pool:
        return [task for task, met in zip(tasks, pool.map(condition, tasks), strict=True) if met]


def stamp(path: Path) -> tuple[int, ...] | None:
    """A mark that tells a file from another that replaces it; None if there is no file."""
    try:
        status = path.stat()
    except OSError:
        return None
    return status.st_ino, status.st_mtime_ns, status.st_size
