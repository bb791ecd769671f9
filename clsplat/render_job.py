# SPDX-License-Identifier: Apache-2.0
"""A sequence of frames as a job: which are rendered, to which files, and the loop. No OpenCL here.

Each device has a thread that renders; a few threads encode and write meanwhile. A frame is written to a temporary name
and renamed, so a file that is there is complete, whenever the job was killed.
"""

from __future__ import annotations

import os
import queue
import threading
import time
from collections.abc import Callable, Sequence
from concurrent.futures import ThreadPoolExecutor
from contextlib import suppress
from dataclasses import asdict, dataclass, replace
from pathlib import Path
from typing import Any

from clsplat import layers
from clsplat.camera import Camera
from clsplat.errors import InputError
from clsplat.files import temporaries
from clsplat.frames import output_paths
from clsplat.paths import Shot
from clsplat.shading import RenderOptions, Shaded, Shader, Task, header

HOST_BYTES = 1 << 30
"""Main memory for frames that wait to be written, as a guide: three are held in any case."""
MOST_WRITERS = 8
COPIES = 3
"""Of a frame, while it is encoded: as it was rendered, put together, converted."""


@dataclass(frozen=True)
class Record:
    """What became of a frame. seconds: of rendering and writing it, without waiting; skipped: it was there; kernel_ms,
    transfer_ms: the device's, where that was asked for."""

    name: str
    frame: int
    path: str
    width: int
    height: int
    seconds: float
    skipped: bool = False
    kernel_ms: float | None = None
    transfer_ms: float | None = None

    def document(self) -> dict[str, Any]:
        """For JSON; without what was not measured."""
        return {name: value for name, value in asdict(self).items() if value is not None}


def make_tasks(
    chosen: Shot, whole: Shot, pattern: str, resize: Callable[[Camera], Camera], channels: Sequence[str]
) -> list[Task]:
    """The frames of `chosen`, which are of the shot `whole`. Raises InputError for files that would be one, and for
    cameras that these channels are not defined for."""
    chosen.check(channels)
    if "motion" in channels:
        whole.check(channels)
    at = {frame.number: index for index, frame in enumerate(whole.frames)}
    paths = output_paths(pattern, [(frame.number, frame.name) for frame in chosen.frames])
    tasks = []
    for frame, path in zip(chosen.frames, paths, strict=True):
        camera = resize(frame.camera)
        after = None
        if "motion" in channels:
            after = camera_after(whole, at[frame.number]).resized(camera.width, camera.height)
        tasks.append(Task(frame.number, frame.name, camera, path, after))
    return tasks


def camera_after(shot: Shot, index: int) -> Camera:
    """Where the shot is one frame number after its frame of this index.

    After the last it goes on as it did from the one before: the same rigid motion once more, so that a turntable turns
    on. A single frame stays where it is.
    """
    frame = shot.frames[index]
    if index + 1 < len(shot.frames):
        following = shot.frames[index + 1]
        return following.camera if following.number == frame.number + 1 else shot.at(frame.number + 1)
    if index == 0:
        return frame.camera
    before = shot.frames[index - 1]
    earlier = before.camera if before.number == frame.number - 1 else shot.at(frame.number - 1)
    now = frame.camera
    turn = now.rotation @ earlier.rotation.T
    shift = now.translation - turn @ earlier.translation
    return replace(now, rotation=turn @ now.rotation, translation=turn @ now.translation + shift)


def check_folders(tasks: Sequence[Task]) -> None:
    """Raise InputError where a file's folder is none, cannot be made or cannot be written to; makes nothing."""
    for folder in sorted({task.path.parent for task in tasks}):
        there = next(each for each in (folder, *folder.parents) if each.exists())
        if not there.is_dir():
            raise InputError(f"{there}: is a file, expected a folder to write {folder} to")
        if not os.access(there, os.W_OK | os.X_OK):
            raise InputError(f"{there}: is not writable, expected a folder to write frames to")
    for task in tasks:
        if task.path.is_dir():
            raise InputError(f"{task.path}: is a folder, expected the name of a file")


def make_folders(tasks: Sequence[Task]) -> None:
    """Make the files' folders. Raises InputError."""
    for folder in sorted({task.path.parent for task in tasks}):
        try:
            folder.mkdir(parents=True, exist_ok=True)
        except OSError as error:
            raise InputError(f"{folder}: cannot be made: {error.strerror}") from None


def remove_temporaries(tasks: Sequence[Task]) -> None:
    """Remove what a killed job has left of these files, and nothing else's."""
    for path in temporaries(task.path for task in tasks):
        with suppress(OSError):
            path.unlink()


def is_complete(task: Task, options: RenderOptions) -> bool:
    """Whether the frame's file is there: of its size, channels and model, and readable to its end."""
    model = {name: value for name, value in options.attributes.items() if name == "clsplat:model"}
    size = task.camera.width, task.camera.height
    return layers.is_whole(task.path, *size, options.channels, options.encoding, model)


def complete(tasks: Sequence[Task], options: RenderOptions) -> set[int]:
    """The numbers of the frames that `--skip-existing` leaves out."""
    with ThreadPoolExecutor(MOST_WRITERS) as pool:
        return {
            task.number
            for task, whole in zip(tasks, pool.map(lambda task: is_complete(task, options), tasks), strict=True)
            if whole
        }


def stamp(path: Path) -> tuple[int, ...] | None:
    """What tells a file from one that takes its place; None for no file."""
    try:
        found = path.stat()
    except OSError:
        return None
    return found.st_ino, found.st_mtime_ns, found.st_size


def write_frame(task: Task, shaded: Shaded, options: RenderOptions) -> Record:
    """Encode the frame and write it, atomically. Raises ClsplatError."""
    start = time.monotonic()
    layers.write_layers(task.path, shaded.layers, options.encoding, header(task, options))
    return record_of(
        task,
        seconds=shaded.seconds + time.monotonic() - start,
        kernel_ms=shaded.kernel_ms,
        transfer_ms=shaded.transfer_ms,
    )


def record_of(task: Task, **values: Any) -> Record:
    """The frame's record with these values beside those of the task."""
    camera = task.camera
    return Record(task.name, task.number, str(task.path), camera.width, camera.height, **{"seconds": 0.0, **values})


def frame_bytes(task: Task, options: RenderOptions) -> int:
    """Main memory that a frame takes until it is written."""
    floats = sum(len(layers.LAYERS[name].names) for name in options.channels)
    return COPIES * 4 * floats * task.camera.width * task.camera.height


def frames_ahead(tasks: Sequence[Task], options: RenderOptions, devices: int) -> tuple[int, int]:
    """(threads that write, frames that are held at once) so that main memory is bounded."""
    largest = max((frame_bytes(task, options) for task in tasks), default=1)
    writers = max(1, min(MOST_WRITERS, os.cpu_count() or 1))
    held = max(devices + 2, min(HOST_BYTES // max(largest, 1), devices + writers + 1))
    return max(1, min(writers, held - devices)), held


def run_tasks(
    tasks: Sequence[Task],
    shaders: Sequence[Shader],
    options: RenderOptions,
    on_done: Callable[[Record], None],
) -> None:
    """Render the frames, each shader in a thread that takes the next frame nobody has, and write them meanwhile.

    on_done: called in this thread for each frame when its file is complete, not always in the frames' order. The first
    error of any thread is raised here, after all of them have ended.
    """
    if not tasks:
        return
    writers, held = frames_ahead(tasks, options, len(shaders))
    finished: queue.SimpleQueue[Record | BaseException] = queue.SimpleQueue()
    todo, turn = iter(tasks), threading.Lock()
    room, stop = threading.Semaphore(held), threading.Event()

    def write(task: Task, shaded: Shaded) -> None:
        try:
            if not stop.is_set():
                finished.put(write_frame(task, shaded, options))
        except BaseException as error:  # noqa: BLE001  # raised again by who waits for the frames
            finished.put(error)
        finally:
            room.release()

    def draw(shader: Shader) -> None:
        try:
            while True:
                room.acquire()
                with turn:
                    task = None if stop.is_set() else next(todo, None)
                if task is None:
                    return
                pool.submit(write, task, shader(task))
        except BaseException as error:  # noqa: BLE001  # as above
            finished.put(error)

    pool = ThreadPoolExecutor(writers, "clsplat-write")
    threads = [threading.Thread(target=draw, args=(shader,), name="clsplat-render") for shader in shaders]
    try:
        for thread in threads:
            thread.start()
        for _ in tasks:
            item = finished.get()
            if isinstance(item, BaseException):
                raise item
            on_done(item)
    finally:
        stop.set()
        for _ in threads:
            room.release()
        for thread in threads:
            thread.join()
        pool.shutdown()
