# SPDX-License-Identifier: Apache-2.0
"""Existing files where a render job writes: finished frames (--skip-existing), files of other programs, folders,
temporary files."""

from __future__ import annotations

import os
from collections.abc import Callable, Mapping, Sequence
from concurrent.futures import ThreadPoolExecutor
from pathlib import Path
from typing import Any, Literal, TypeVar

from clsplat.config.pictures import VideoConfig
from clsplat.errors import InputError, examples, reason_of, warn
from clsplat.files.documents import is_file
from clsplat.files.locks import remove_abandoned
from clsplat.images.frame_files import (
    MODEL_DIGEST_ATTRIBUTE,
    SETTINGS_DIGEST_ATTRIBUTE,
    attribute,
    is_foreign,
    is_whole,
)
from clsplat.images.video import video_record
from clsplat.sequence.task import RenderOptions, Task, digest_of, picture_camera, settings_digest

T = TypeVar("T")

MAX_FILE_THREADS = 8
"""Largest number of threads that read or write files at once."""
IDENTITY_ATTRIBUTES = (MODEL_DIGEST_ATTRIBUTE, "clsplat:colorspace")
"""Attributes of a frame's file that identify the model and the colour space."""


def check_folders(tasks: Sequence[Task]) -> None:
    """Raise InputError if frames cannot be written to their folders, or if a frame's file is a folder.

    Missing folders are not created.
    """
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
    """Create the folders of the frames' files. Raises InputError."""
    for folder in sorted({task.path.parent for task in tasks}):
        try:
            folder.mkdir(parents=True, exist_ok=True)
        except OSError as error:
            raise InputError(f"{folder}: cannot be created: {reason_of(error)}") from None


def remove_temporaries(tasks: Sequence[Task]) -> None:
    """Remove temporary files of these frames that killed jobs have left, but not files that are still being written."""
    remove_abandoned(task.path for task in tasks)


def _identity(task: Task, options: RenderOptions) -> dict[str, str | int | float]:
    """Return the attributes that distinguish a frame's file from files of other models and settings."""
    known = {name: value for name, value in options.attributes.items() if name in IDENTITY_ATTRIBUTES}
    return {**known, SETTINGS_DIGEST_ATTRIBUTE: settings_digest(task, options)}


def is_complete(task: Task, options: RenderOptions) -> bool:
    """True if the frame's file exists, is readable to its end, and has the right size, channels, model and settings."""
    return _is_whole(task, options, _identity(task, options))


def _is_whole(task: Task, options: RenderOptions, identity: Mapping[str, str | int | float]) -> bool:
    camera = picture_camera(task, options.pictures)
    return is_whole(
        task.path,
        camera.width,
        camera.height,
        options.channels,
        options.encoding,
        identity,
        deep=options.deep is not None,
        views=len(task.views),
    )


def made_of(tasks: Sequence[Task], options: RenderOptions, config: VideoConfig) -> dict[str, Any]:
    """Return the record that a video of these frames contains: digests of the model, the settings and the encoding."""
    frames = [(task.number, settings_digest(task, options)) for task in tasks]
    return {
        MODEL_DIGEST_ATTRIBUTE: options.attributes.get(MODEL_DIGEST_ATTRIBUTE),
        SETTINGS_DIGEST_ATTRIBUTE: digest_of(frames, config),
    }


def frames_there(tasks: Sequence[Task], options: RenderOptions, video: VideoConfig) -> set[str]:
    """Return the keys of the frames that `--skip-existing` leaves out.

    Warns if files do not record their settings, and if existing frames have to be rendered again.
    """
    if tasks[0].is_video:
        return _video_there(tasks, options, video)
    states = dict(zip(tasks, _at_once(tasks, lambda task: _state(task, options)), strict=True))
    if unknown := [task.path for task, state in states.items() if state == "unrecorded"]:
        warn(
            f"--skip-existing: {len(unknown)} existing frames have no record of their settings, such as {unknown[0]}; "
            "they are kept unchecked"
        )
    if changed := [task.path for task, state in states.items() if state == "changed"]:
        warn(
            f"--skip-existing: {len(changed)} of the existing frames were rendered from another model, or with other "
            f"cameras or settings, such as {changed[0]}: they are rendered again"
        )
    return {task.key for task, state in states.items() if state in ("recorded", "unrecorded")}


def _state(task: Task, options: RenderOptions) -> Literal["recorded", "unrecorded", "changed", "missing"]:
    """Compare a frame's file with its task. Returns one of four words:

    recorded, unrecorded: the file is complete, with or without a record of its settings.
    changed: the file was rendered from another model, or with other cameras or settings.
    missing: the file does not exist, is damaged, or has another size or other channels.
    """
    wanted = _identity(task, options)
    if _is_whole(task, options, wanted):
        return "unrecorded" if attribute(task.path, SETTINGS_DIGEST_ATTRIBUTE) is None else "recorded"
    found = {name: attribute(task.path, name) for name in (*IDENTITY_ATTRIBUTES, SETTINGS_DIGEST_ATTRIBUTE)}
    return "changed" if any(value not in (None, wanted.get(name)) for name, value in found.items()) else "missing"


def _video_there(tasks: Sequence[Task], options: RenderOptions, video: VideoConfig) -> set[str]:
    """Return the keys of all frames if their video is complete, otherwise an empty set."""
    path = tasks[0].path
    if video_record(path, len(tasks)) == made_of(tasks, options, video):
        return {task.key for task in tasks}
    if path.exists():
        warn(
            f"--skip-existing: {path} is incomplete, or was rendered from another model or of other frames, or with "
            "other cameras or settings: it is rendered again"
        )
    return set()


def check_foreign(tasks: Sequence[Task]) -> None:
    """Raise InputError if a frame would replace a picture made by another program."""
    theirs = _at_once(tasks, lambda task: is_file(task.path) and is_foreign(task.path))
    if others := [task.path for task, is_theirs in zip(tasks, theirs, strict=True) if is_theirs]:
        raise InputError(
            f"{examples(others)}: exist, and clsplat did not make them; name other files, or give --overwrite to "
            "replace them"
        )


def _at_once(tasks: Sequence[Task], look: Callable[[Task], T]) -> list[T]:
    """Call `look` with each task, in several threads, and return the results in the order of the tasks."""
    with ThreadPoolExecutor(MAX_FILE_THREADS) as pool:
        return list(pool.map(look, tasks))


def stamp(path: Path) -> tuple[int, ...] | None:
    """Return inode, modification time and size of a file, by which a replaced file is noticed; None without a file."""
    try:
        status = path.stat()
    except OSError:
        return None
    return status.st_ino, status.st_mtime_ns, status.st_size
