# SPDX-License-Identifier: Apache-2.0
"""Files that are there already: frames of an earlier job, folders, temporary files."""

from __future__ import annotations

import os
from collections.abc import Callable, Sequence
from concurrent.futures import ThreadPoolExecutor
from contextlib import suppress
from pathlib import Path
from typing import Any

from clsplat.config.pictures import VideoConfig
from clsplat.errors import InputError, reason_of
from clsplat.files import abandoned, is_file
from clsplat.images.frame_files import attribute, is_foreign, is_whole
from clsplat.images.records import MODEL, SETTINGS
from clsplat.sequence.task import RenderOptions, Task, digest_of, picture_camera, settings_digest

MOST_WRITERS = 8
WHAT_IT_IS = (MODEL, "clsplat:colorspace")
"""Attributes of a file that say whether it is the one that is wanted."""


def check_folders(tasks: Sequence[Task]) -> None:
    """Raise InputError where a file's folder is none, cannot be made or cannot be written to; makes nothing."""
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
    """Make the files' folders. Raises InputError."""
    for folder in sorted({task.path.parent for task in tasks}):
        try:
            folder.mkdir(parents=True, exist_ok=True)
        except OSError as error:
            raise InputError(f"{folder}: cannot be made: {reason_of(error)}") from None


def remove_temporaries(tasks: Sequence[Task]) -> None:
    """Remove what a killed job has left of these files, and nothing that is still written."""
    for path in abandoned(task.path for task in tasks):
        with suppress(OSError):
            path.unlink()


def is_complete(task: Task, options: RenderOptions) -> bool:
    """True if the frame's file is there: of its size, channels, model and settings, and readable to its end."""
    attributes = {name: value for name, value in options.attributes.items() if name in WHAT_IT_IS}
    attributes[SETTINGS] = settings_digest(task, options)
    camera, deep = picture_camera(task, options), options.deep is not None
    kind: dict[str, Any] = {"deep": deep, "views": len(task.views)}
    return is_whole(task.path, camera.width, camera.height, options.channels, options.encoding, attributes, **kind)


def made_of(tasks: Sequence[Task], options: RenderOptions, config: VideoConfig) -> dict[str, Any]:
    """The record of a video of these frames."""
    frames = [(task.number, settings_digest(task, options)) for task in tasks]
    return {MODEL: options.attributes.get(MODEL), SETTINGS: digest_of(frames, config)}


def complete(tasks: Sequence[Task], options: RenderOptions) -> set[str]:
    """The keys of the frames that `--skip-existing` leaves out."""
    return {task.key for task in _those(tasks, lambda task: is_complete(task, options))}


def untold(tasks: Sequence[Task]) -> list[Path]:
    """The tasks' files that do not say with which settings they were made."""
    return [task.path for task in _those(tasks, lambda task: attribute(task.path, SETTINGS) is None)]


def changed(tasks: Sequence[Task], options: RenderOptions) -> list[Path]:
    """The tasks' files that were made of another model, or with other cameras or settings."""

    def differs(task: Task) -> bool:
        wanted = {**options.attributes, SETTINGS: settings_digest(task, options)}
        found = {name: attribute(task.path, name) for name in (*WHAT_IT_IS, SETTINGS)}
        return any(value not in (None, wanted.get(name)) for name, value in found.items())

    return [task.path for task in _those(tasks, differs)]


def foreign(tasks: Sequence[Task]) -> list[Path]:
    """The tasks' files that are pictures of other programs than clsplat."""
    return [task.path for task in _those(tasks, lambda task: is_file(task.path) and is_foreign(task.path))]


def _those(tasks: Sequence[Task], condition: Callable[[Task], bool]) -> list[Task]:
    """The tasks that meet a condition on their files; several files are read at once."""
    with ThreadPoolExecutor(MOST_WRITERS) as pool:
        return [task for task, met in zip(tasks, pool.map(condition, tasks), strict=True) if met]


def stamp(path: Path) -> tuple[int, ...] | None:
    """Mark that tells a file from one that takes its place; None for no file."""
    try:
        status = path.stat()
    except OSError:
        return None
    return status.st_ino, status.st_mtime_ns, status.st_size
