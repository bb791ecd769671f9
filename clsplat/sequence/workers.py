# SPDX-License-Identifier: Apache-2.0
"""The loop of a job: threads that render, encode and write its frames. No OpenCL here.

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
from concurrent.futures import Future, ThreadPoolExecutor
from contextlib import AbstractContextManager, nullcontext
from dataclasses import replace
from typing import Any

from clsplat.config.channels import DEEP, WRITTEN
from clsplat.config.pictures import DEEP_STRIP_FLOATS, STRIP_PIXELS, VideoConfig, WarpConfig
from clsplat.device.child import abandon
from clsplat.images import frame_files
from clsplat.images.records import record_text
from clsplat.images.video import VideoPlanes, VideoWriter, planes_of, video_writer
from clsplat.sequence.existing import MOST_WRITERS, made_of
from clsplat.sequence.frame_renderer import RenderedFrame, RenderFrame
from clsplat.sequence.sharing import FrameQueue, Sharing
from clsplat.sequence.task import Record, RenderOptions, Task, header, picture_camera, sampling_of

Result = tuple[Record, VideoPlanes | None]
"""Record of a frame; with the planes that a video takes of it, if it is one's."""
HOST_BYTES = 1 << 30
"""Main memory for frames that wait to be written, as a guide: three are held in any case."""
COPIES = 3
"""Copies of a frame, while it is encoded: as it was rendered, put together, converted."""


def encode_frame(task: Task, frame: RenderedFrame, options: RenderOptions) -> Result:
    """Encode the frame and write it, atomically, unless that is done; of a video the planes are returned instead.
    Raises ClsplatError."""
    start, yuv = time.monotonic(), None
    if task.is_video:
        assert frame.planes is not None, "frames of a video are not written one by one"
        finished = frame.finish(frame.planes)
        yuv = planes_of(task.path, finished["rgb"], finished.get("alpha"), options.encoding.prores)
    elif frame.planes is not None:
        views = zip(task.views, (frame.planes, frame.right), strict=False)
        made = [(frame.finish(planes or {}), header(view, options, task)) for view, planes in views]
        if len(made) == 1:
            (planes, above), *_ = made
            frame_files.write_channels(task.path, planes, options.encoding, above)
        else:
            frame_files.write_views(task.path, made, options.encoding)
    seconds = frame.seconds + time.monotonic() - start
    return record_of(task, options, seconds=seconds, **frame.measured), yuv


def record_of(task: Task, options: RenderOptions, **values: Any) -> Record:
    """The frame's record with these values beside those of the task."""
    camera = picture_camera(task, options)
    whose = {"eye": task.eye} if task.eye and task.right is None else {}
    what = {"seconds": 0.0, **whose, **values}
    return Record(task.name, task.number, str(task.path), camera.width, camera.height, **what)


def frame_bytes(task: Task, options: RenderOptions) -> int:
    """Main memory that a frame takes until it is written; of one in strips what a strip takes."""
    camera, framing = picture_camera(task, options), options.pictures.framing
    pixels, finer = camera.width * camera.height * len(task.views), framing.supersample**2
    if not task.is_video:
        pixels = min(pixels, STRIP_PIXELS // finer)
    if options.deep is not None:
        return COPIES * 4 * min(len(DEEP) * options.deep.bins * pixels, DEEP_STRIP_FLOATS)
    floats = sum(len(WRITTEN[name].names) for name in options.channels)
    light = 4 if sampling_of(task, options).on or finer > 1 else 0
    floats += floats if options.pictures.warp != WarpConfig() else 0
    return 4 * pixels * (COPIES * floats + light * (finer if finer > 1 else 2))


def frames_ahead(tasks: Sequence[Task], options: RenderOptions, devices: int) -> tuple[int, int]:
    """(threads that write, frames that are held at once) so that main memory is bounded."""
    largest = max((frame_bytes(task, options) for task in tasks), default=1)
    writers = max(1, min(MOST_WRITERS, os.cpu_count() or 1))
    held = max(devices + 2, min(HOST_BYTES // max(largest, 1), devices + writers + 1))
    return max(1, min(writers, held - devices)), held


def run_tasks(
    tasks: Sequence[Task],
    renderers: Sequence[RenderFrame],
    options: RenderOptions,
    on_done: Callable[[Record], None],
    video: VideoWriter | None = None,
    sharing: Sharing | None = None,
) -> None:
    """Render the frames and write them meanwhile, or add them to the video. Each renderer has a thread, which takes the
    next frame that is free.

    sharing: other jobs may make some of these frames meanwhile; theirs are waited for at the end.

    on_done: called in this thread for each frame when its file is complete, not always in the frames' order; for a
    video in order, when the frame has been encoded. The first error of any thread is raised here, after all of them
    have ended.
    """
    if not tasks:
        return
    writers, held = frames_ahead(tasks, options, len(renderers))
    room, frames = threading.Semaphore(held), FrameQueue(tasks, sharing)
    finished: queue.SimpleQueue[Future[Any]] = queue.SimpleQueue()
    encoders = ThreadPoolExecutor(writers, "clsplat-write")
    devices = ThreadPoolExecutor(len(renderers), "clsplat-render")

    def render(renderer: RenderFrame) -> None:
        while True:  # until there are no more frames
            room.acquire()
            if (task := frames.take(lambda task: finished.put(_skipped(task, options)))) is None:
                return
            encoders.submit(encode, task, renderer(task)).add_done_callback(finished.put)

    def encode(task: Task, frame: RenderedFrame) -> Result | None:
        try:
            return None if frames.stop.is_set() else encode_frame(task, frame, options)
        finally:
            frames.end(task)
            if video is None:
                room.release()

    def tell_failure(rendering: Future[None]) -> None:
        if rendering.exception() is not None:
            finished.put(rendering)

    try:
        for renderer in renderers:
            devices.submit(render, renderer).add_done_callback(tell_failure)
        for record in encoded(tasks, (finished.get().result() for _ in tasks), video):
            if video is not None:
                room.release()  # frames are handed out in order, so that the next one always has room
            on_done(record)
    except KeyboardInterrupt:
        abandon()  # a thread may wait for a driver that hangs
        raise
    finally:
        frames.stop.set()
        for _ in renderers:
            room.release()
        devices.shutdown()
        encoders.shutdown()
        frames.close()


def _skipped(task: Task, options: RenderOptions) -> Future[Result]:
    """The outcome of a frame that is there already."""
    outcome: Future[Result] = Future()
    outcome.set_result((record_of(task, options, skipped=True), None))
    return outcome


def encoded(tasks: Sequence[Task], results: Iterator[Result], video: VideoWriter | None) -> Iterator[Record]:
    """Records when their files are complete; of a video in the order of the tasks, when the frame is in."""
    if video is None:
        for record, _ in results:
            yield record
        return
    waiting: dict[str, tuple[Record, VideoPlanes]] = {}
    for task in tasks:
        while task.key not in waiting:
            record, planes = next(results)
            assert planes is not None
            waiting[record.key] = record, planes
        record, planes = waiting.pop(task.key)
        start = time.monotonic()
        video.add(planes)
        yield replace(record, seconds=record.seconds + time.monotonic() - start)


def open_video(
    tasks: Sequence[Task], config: VideoConfig, options: RenderOptions
) -> AbstractContextManager[VideoWriter | None]:
    """The video that the tasks are frames of, None where they have files of their own. It takes its name at the end of
    the block, if that ends well."""
    if not (tasks and tasks[0].is_video):
        return nullcontext()
    return video_writer(tasks[0].path, config, record_text(made_of(tasks, options, config)))
