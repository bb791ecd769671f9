# SPDX-License-Identifier: Apache-2.0
"""A sequence of frames as a job: the frames to render, their files, and the loop. No OpenCL here.

Each device has a thread that renders; a few threads encode and write meanwhile. A frame is written to a temporary name
and renamed, so a file that is there is complete, whenever the job was killed. The frames of a video are prepared by
these threads and encoded in their order by the thread that waits for them.
"""

from __future__ import annotations

import os
import queue
import threading
import time
from collections.abc import Callable, Iterator, Sequence
from concurrent.futures import ThreadPoolExecutor
from contextlib import contextmanager
from dataclasses import replace
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import NDArray

from clsplat.config.channels import CHANNELS, DEEP
from clsplat.config.pictures import DEEP_STRIP_FLOATS, STRIP_PIXELS, VideoConfig
from clsplat.device.child import abandon
from clsplat.files import is_file
from clsplat.images import channels as layers
from clsplat.images.video import VideoWriter, frame_planes
from clsplat.sequence.existing import MOST_WRITERS
from clsplat.sequence.frame_renderer import Shaded, Shader
from clsplat.sequence.task import Record, RenderOptions, Task, header, picture_camera

Planes = NDArray[np.uint8]

HOST_BYTES = 1 << 30
"""Main memory for frames that wait to be written, as a guide: three are held in any case."""
COPIES = 3
"""Copies of a frame, while it is encoded: as it was rendered, put together, converted."""


def foreign(tasks: Sequence[Task]) -> list[Path]:
    """The tasks' files that are pictures of other programs than clsplat."""
    there = [task.path for task in tasks if is_file(task.path)]
    with ThreadPoolExecutor(MOST_WRITERS) as pool:
        return [path for path, others in zip(there, pool.map(layers.is_foreign, there), strict=True) if others]


def write_frame(task: Task, shaded: Shaded, options: RenderOptions) -> Record:
    """Encode the frame and write it, atomically, unless that is done. Raises ClsplatError."""
    start = time.monotonic()
    if shaded.layers is not None:
        layers.write_channels(task.path, shaded.finish(shaded.layers), options.encoding, header(task, options))
    return _record(task, shaded, options, start)


def video_frame(task: Task, shaded: Shaded, options: RenderOptions) -> tuple[Record, Planes]:
    """The frame as a video takes it."""
    start = time.monotonic()
    assert shaded.layers is not None, "frames of a video are not written one by one"
    planes = frame_planes(shaded.finish(shaded.layers)["rgb"])
    return _record(task, shaded, options, start), planes


def _record(task: Task, shaded: Shaded, options: RenderOptions, start: float) -> Record:
    seconds = shaded.seconds + time.monotonic() - start
    measured = {"kernel_ms": shaded.kernel_ms, "transfer_ms": shaded.transfer_ms}
    return record_of(task, options, seconds=seconds, blank=shaded.blank, **measured)


def record_of(task: Task, options: RenderOptions, **values: Any) -> Record:
    """The frame's record with these values beside those of the task."""
    camera = picture_camera(task, options)
    return Record(task.name, task.number, str(task.path), camera.width, camera.height, **{"seconds": 0.0, **values})


def frame_bytes(task: Task, options: RenderOptions) -> int:
    """Main memory that a frame takes until it is written; of one in strips what a strip takes."""
    camera, framing = picture_camera(task, options), options.pictures.framing
    pixels, finer = camera.width * camera.height, framing.supersample**2
    if not task.is_video:
        pixels = min(pixels, STRIP_PIXELS // finer)
    if options.deep is not None:
        return COPIES * 4 * min(len(DEEP) * options.deep.bins * pixels, DEEP_STRIP_FLOATS)
    floats = sum(len(CHANNELS[name].names) for name in options.channels)
    light = 4 if options.pictures.sampling.on or finer > 1 else 0
    return 4 * pixels * (COPIES * floats + light * (finer if finer > 1 else 2))


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
    video: VideoWriter | None = None,
) -> None:
    """Render the frames, each shader in a thread that takes the next frame that is free, and write them meanwhile, or
    add them to the video.

    on_done: called in this thread for each frame when its file is complete, not always in the frames' order; for a
    video in order, when the frame has been encoded. The first error of any thread is raised here, after all of them
    have ended.
    """
    if not tasks:
        return
    writers, held = frames_ahead(tasks, options, len(shaders))
    line = _Line(tasks, options, held, video)
    pool = ThreadPoolExecutor(writers, "clsplat-write")
    threads = [threading.Thread(target=line.draw, args=(shader, pool), name="clsplat-render") for shader in shaders]
    try:
        for thread in threads:
            thread.start()
        for record in encoded(tasks, line.results(), video):
            if video is not None:
                line.room.release()  # frames are handed out in order, so that the next one always has room
            on_done(record)
    except KeyboardInterrupt:
        abandon()  # a thread may wait for a driver that hangs
        raise
    finally:
        line.stop.set()
        for _ in threads:
            line.room.release()
        for thread in threads:
            thread.join()
        pool.shutdown()


Result = tuple[Record, Planes | None]
"""Record of a frame; with the planes that a video takes of it, if it is one's."""


class _Line:
    """State that the threads of a job share. room: for `held` frames at once; stop: nothing more is to be done."""

    def __init__(self, tasks: Sequence[Task], options: RenderOptions, held: int, video: VideoWriter | None) -> None:
        self.room, self.stop = threading.Semaphore(held), threading.Event()
        self._tasks, self._options, self._video = tasks, options, video
        self._todo, self._turn = iter(tasks), threading.Lock()
        self._finished: queue.SimpleQueue[Result | BaseException] = queue.SimpleQueue()

    def draw(self, shader: Shader, pool: ThreadPoolExecutor) -> None:
        """Render frames until there are no more."""
        try:
            while True:
                self.room.acquire()
                with self._turn:
                    task = None if self.stop.is_set() else next(self._todo, None)
                if task is None:
                    return
                pool.submit(self._write, task, shader(task))
        except BaseException as error:  # noqa: BLE001  # raised again in the thread that waits for the frames
            self._finished.put(error)

    def _write(self, task: Task, shaded: Shaded) -> None:
        try:
            if self.stop.is_set():
                return
            if self._video is None:
                self._finished.put((write_frame(task, shaded, self._options), None))
            else:
                self._finished.put(video_frame(task, shaded, self._options))
        except BaseException as error:  # noqa: BLE001  # as above
            self._finished.put(error)
        finally:
            if self._video is None:
                self.room.release()

    def results(self) -> Iterator[Result]:
        """Result of every frame when it is done. Raises what ended a thread."""
        for _ in self._tasks:
            item = self._finished.get()
            if isinstance(item, BaseException):
                raise item
            yield item


def encoded(tasks: Sequence[Task], results: Iterator[Result], video: VideoWriter | None) -> Iterator[Record]:
    """Records when their files are complete; of a video in the order of the tasks, when the frame is in."""
    if video is None:
        for record, _ in results:
            yield record
        return
    waiting: dict[int, tuple[Record, Planes]] = {}
    for task in tasks:
        while task.number not in waiting:
            record, planes = next(results)
            assert planes is not None
            waiting[record.frame] = record, planes
        record, planes = waiting.pop(task.number)
        start = time.monotonic()
        video.add_planes(planes)
        yield replace(record, seconds=record.seconds + time.monotonic() - start)


@contextmanager
def open_video(tasks: Sequence[Task], config: VideoConfig) -> Iterator[VideoWriter | None]:
    """The video that the tasks are frames of, None where they have files of their own. It takes its name at the end of
    the block, if that ends well."""
    if not (tasks and tasks[0].is_video):
        yield None
        return

    with VideoWriter(tasks[0].path, config) as video:
        yield video
