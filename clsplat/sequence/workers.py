# SPDX-License-Identifier: Apache-2.0
"""Threads of a render job, which render, encode and write its frames.

One thread for each device renders, and up to `finished_frames.MAX_FILE_THREADS` threads encode and write. A frame is
written under a temporary name and then renamed, so that a file is complete even if the job is killed. Frames of a video
are converted by these threads, and encoded in order by the thread that called `run_tasks`.
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

from clsplat.config.channels import DEEP_CHANNELS, WRITABLE_CHANNELS
from clsplat.config.pictures import DEEP_MERGE_FLOATS, DEEP_STRIP_FLOATS, STRIP_PIXELS, VideoConfig, WarpConfig
from clsplat.device.drivers.worker_process import abandon
from clsplat.images import frame_files
from clsplat.images.frame_files import record_text
from clsplat.images.video import VideoPlanes, VideoWriter, planes_of, video_writer
from clsplat.layouts.columns import DEEP_PICTURES
from clsplat.sequence.finished_frames import MAX_FILE_THREADS, made_of
from clsplat.sequence.frame_claims import FrameQueue, Sharing
from clsplat.sequence.frame_renderer import RenderedFrame, RenderFrame
from clsplat.sequence.task import (
    NOT_MEASURED,
    Measured,
    Record,
    RenderOptions,
    Task,
    header,
    picture_camera,
    sampling_of,
)

Result = tuple[Record, VideoPlanes | None]
"""Record of a frame, and the planes to encode if the frame belongs to a video."""
WRITE_QUEUE_BYTES = 1 << 30
"""Limit of main memory, in bytes, for frames in flight: rendered, but not yet written. At least (number of devices + 2)
frames are allowed, whatever their size."""
ENCODING_COPIES = 3
"""Number of copies of a frame in memory while it is encoded: the rendered, the assembled and the converted frame."""


def encode_frame(task: Task, frame: RenderedFrame, options: RenderOptions) -> Result:
    """Encode a frame and write it atomically, unless it was written in strips already. Raises ClsplatError.

    A frame of a video is not written: its planes are in the result.
    """
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
    return record_of(task, options, seconds, frame.measured), yuv


def record_of(
    task: Task,
    options: RenderOptions,
    seconds: float = 0.0,
    measured: Measured = NOT_MEASURED,
    *,
    skipped: bool = False,
) -> Record:
    """Make the record of a finished frame. seconds, skipped: as in `Record`."""
    camera = picture_camera(task, options.pictures)
    return Record(
        task.name,
        task.number,
        str(task.path),
        camera.width,
        camera.height,
        seconds,
        eye=task.eye if task.eye and task.right is None else None,
        skipped=skipped,
        blank=measured.blank,
        kernel_ms=measured.kernel_ms,
        transfer_ms=measured.transfer_ms,
    )


def frame_bytes(task: Task, options: RenderOptions) -> int:
    """Estimate the bytes of main memory that a frame, or one of its strips, takes until it is written."""
    camera, framing = picture_camera(task, options.pictures), options.pictures.framing
    pixels, finer = camera.width * camera.height * len(task.views), framing.supersample**2
    if not task.is_video:
        pixels = min(pixels, STRIP_PIXELS // finer)
    sampling = sampling_of(task, options.pictures)
    if options.deep is not None:
        floats = len(DEEP_CHANNELS) * options.deep.bins * pixels
        merged = min(floats * min(sampling.pictures, DEEP_PICTURES), DEEP_MERGE_FLOATS) if sampling.on else 0
        return 4 * (ENCODING_COPIES * min(floats, DEEP_STRIP_FLOATS) + merged)
    floats = sum(len(WRITABLE_CHANNELS[name].names) for name in options.channels)
    light = 4 if sampling.on or finer > 1 else 0
    floats += floats if options.pictures.warp != WarpConfig() else 0
    return 4 * pixels * (ENCODING_COPIES * floats + light * (finer if finer > 1 else 2))


def frames_ahead(tasks: Sequence[Task], options: RenderOptions, devices: int) -> tuple[int, int]:
    """Return the number of threads that are to write, and the maximum number of frames in main memory at once.

    devices: number of devices that render.
    """
    largest = max((frame_bytes(task, options) for task in tasks), default=1)
    writers = max(1, min(MAX_FILE_THREADS, os.cpu_count() or 1))
    held = max(devices + 2, min(WRITE_QUEUE_BYTES // max(largest, 1), devices + writers + 1))
    return max(1, min(writers, held - devices)), held


def run_tasks(
    tasks: Sequence[Task],
    renderers: Sequence[RenderFrame],
    options: RenderOptions,
    on_done: Callable[[Record], None],
    video: VideoWriter | None = None,
    *,
    shared: bool = False,
) -> None:
    """Render the frames, and at the same time write them or add them to the video.

    Each renderer has a thread, which takes frame after frame. The first error is raised when all threads have ended.

    on_done: called in this thread with the record of each frame whose file is complete; for a video, in their order.
    shared: True if other jobs may render some of these frames. Each frame is then claimed before it is rendered.
    """
    if not tasks:
        return
    writers, held = frames_ahead(tasks, options, len(renderers))
    room, frames = threading.Semaphore(held), FrameQueue(tasks, Sharing(options) if shared else None)
    finished: queue.SimpleQueue[Future[Any]] = queue.SimpleQueue()
    encoders = ThreadPoolExecutor(writers, "clsplat-write")
    devices = ThreadPoolExecutor(len(renderers), "clsplat-render")

    def render(renderer: RenderFrame) -> None:
        while True:
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
                room.release()  # no deadlock: frames start in order, so the frame to encode next is in memory
            on_done(record)
    except KeyboardInterrupt:
        abandon()  # ends trials of drivers: a driver that hangs would keep its thread waiting
        raise
    finally:
        frames.stop.set()
        for _ in renderers:
            room.release()
        devices.shutdown()
        encoders.shutdown()
        frames.close()


def _skipped(task: Task, options: RenderOptions) -> Future[Result]:
    """Return a completed future with the record of a frame that another job has finished."""
    outcome: Future[Result] = Future()
    outcome.set_result((record_of(task, options, skipped=True), None))
    return outcome


def encoded(tasks: Sequence[Task], results: Iterator[Result], video: VideoWriter | None) -> Iterator[Record]:
    """Yield the record of each frame when its file is complete; for a video, in the order of the tasks, when the frame
    has been encoded. results: records and planes, in any order."""
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
    """Open the video that the tasks' frames belong to, as a context. It yields None if frames have separate files.

    The video file gets its final name at the end of the context, unless an error is raised.
    """
    if not (tasks and tasks[0].is_video):
        return nullcontext()
    return video_writer(tasks[0].path, config, record_text(made_of(tasks, options, config)))
