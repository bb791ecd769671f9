# SPDX-License-Identifier: Apache-2.0
"""Rendering of frames on a Dask cluster, which exists already or is started on this machine. Needs `distributed`.

A frame is a Dask task. Every worker loads the model once and keeps it. Files must have the same paths on all workers.
"""

from __future__ import annotations

import threading
import uuid
from collections.abc import Callable, Iterator, Sequence
from dataclasses import dataclass, replace
from itertools import islice
from pathlib import Path
from typing import Any

from clsplat.config.rasterizer import RasterizerConfig
from clsplat.errors import ClsplatError, InputError
from clsplat.images.video import VideoWriter
from clsplat.jobs.dask_cluster import dask_client, warning_of_no_workers
from clsplat.sequence.finished_frames import is_complete, remove_temporaries, stamp
from clsplat.sequence.frame_renderer import FrameRenderer, open_frame_renderer
from clsplat.sequence.job_models import load_job_models, names_of
from clsplat.sequence.task import Record, RenderOptions, Task
from clsplat.sequence.workers import WRITE_QUEUE_BYTES, Result, encode_frame, encoded, frame_bytes, record_of
from clsplat.version import package_version

MAX_FRAMES_PER_WORKER = 3
"""Largest number of frames that a worker has in memory at once, even if it has more threads."""


@dataclass(frozen=True)
class WorkerJob:
    """Settings of a job, with which a worker opens its renderer.

    model: absolute path of the model, or of the shot file.
    digest: SHA-256 of the model's content (`JobModels.digest`).
    device: name of the device, as for --device.
    memory_limit: limit of device memory in bytes; None for no limit.
    placed: True if the tasks contain placements of the models, False for a single model used as it is.
    version: version of clsplat.
    """

    model: str
    digest: str
    options: RenderOptions
    rasterizer: RasterizerConfig
    device: str | None = None
    memory_limit: int | None = None
    placed: bool = False
    version: str = package_version()


@dataclass(frozen=True)
class Failure:
    """An error in a worker, as its result, because not all of clsplat's exceptions can be sent between processes.

    message: the error's text. wrong_input: True for an InputError.
    """

    message: str
    wrong_input: bool


class _Held:
    """The renderer that a worker holds open for one job.

    rendering: lock that a thread holds while it renders.
    room: semaphore that limits the number of frames in memory.
    """

    def __init__(self) -> None:
        self.rendering, self.room = threading.Lock(), threading.Semaphore(MAX_FRAMES_PER_WORKER)
        self.key: str | None = None
        self.renderer: FrameRenderer | None = None

    def renderer_for(self, job: WorkerJob) -> FrameRenderer:
        if self.renderer is None or repr(job) != self.key:
            self.key = self.renderer = None  # free the old renderer's memory first
            job_models = load_job_models(Path(job.model))
            if job_models.digest != job.digest:
                raise InputError(
                    f"{job.model}: has SHA-256 {job_models.digest[:12]} on a worker, expected {job.digest[:12]}"
                )
            model = job_models.models if job.placed else job_models.one
            mattes = job_models.mattes(job.options.channels, job.options.ids_from)
            if names_of(mattes) != job.options.mattes:
                raise InputError(f"{job.model}: its Cryptomatte objects on a worker differ from those of the job")
            self.renderer = open_frame_renderer(
                model,
                job.options,
                job.rasterizer,
                device=job.device,
                memory_limit=job.memory_limit,
                mattes=mattes,
            )
            self.key = repr(job)
        return self.renderer


_WORKER_RENDERER = _Held()


def render_frame(task: Task, job: WorkerJob) -> Result | Failure:
    """Render a frame in a worker and write its file, unless another worker wrote the file before that worker was lost.

    A frame of a video is not written but returned, to the process that encodes the video.
    """
    try:
        if job.version != package_version():
            raise InputError(f"a worker has clsplat {package_version()}, expected {job.version} like the job")
        with _WORKER_RENDERER.room:
            with _WORKER_RENDERER.rendering:
                if not task.is_video and stamp(task.path) != task.before and is_complete(task, job.options):
                    return record_of(task, job.options), None
                frame = _WORKER_RENDERER.renderer_for(job)(task)
            return encode_frame(task, frame, job.options)
    except (ClsplatError, OSError, MemoryError) as error:
        message = " ".join(str(error).split()) or type(error).__name__
        return Failure(message, isinstance(error, InputError))


def render_on_farm(
    tasks: Sequence[Task],
    job: WorkerJob,
    on_done: Callable[[Record], None],
    *,
    scheduler: str | None = None,
    workers: int | None = None,
    video: VideoWriter | None = None,
) -> None:
    """Render the frames on a Dask cluster. Frames of a video are encoded in this process.

    on_done: function that is called with the record of each finished frame, as in `workers.run_tasks`.
    scheduler: address of the scheduler of an existing cluster; None starts a cluster on this machine.
    workers: number of processes of a cluster on this machine; None lets Dask choose it.
    video: the video that the frames belong to; None if each frame has a file.
    Frames of a lost worker are rendered again by others. Raises InputError if no scheduler answers. Raises
    ClsplatError for a frame that cannot be rendered, or whose workers were lost more often than Dask allows.
    """
    if not tasks:
        return
    if not job.options.channels:
        raise ValueError("job.options.channels is empty, expected at least one channel")
    placed = [replace(task, path=task.path.absolute(), before=stamp(task.path)) for task in tasks]
    names = {task.key: str(task.path) for task in tasks}
    with dask_client(scheduler, workers) as client, warning_of_no_workers(client, scheduler, "frames"):
        results = _results(client, placed, job, video)
        for record in encoded(placed, results, video):
            on_done(replace(record, path=names[record.key]))
    # no worker writes now, but killed workers may have left temporary files
    remove_temporaries(tasks)


def _results(client: Any, tasks: Sequence[Task], job: WorkerJob, video: VideoWriter | None = None) -> Iterator[Result]:
    """Yield the results of `render_frame` in the order in which frames finish.

    Only some tasks are submitted at a time, because a job may have a million. For a video, the submitted tasks begin
    with the frame to encode next. This limits the number of finished frames that wait for that frame in memory.
    """
    from distributed import CancelledError, KilledWorker, as_completed

    prefix, left = f"clsplat-{uuid.uuid4().hex[:12]}", iter(tasks)

    def submit(count: int) -> list[Any]:
        return [
            client.submit(render_frame, task, job, key=f"{prefix}-{task.key}", pure=False)
            for task in islice(left, count)
        ]

    threads = sum(client.nthreads().values())
    window = max(64, 4 * threads)
    if video is not None:
        window = max(threads + 1, min(window, WRITE_QUEUE_BYTES // frame_bytes(tasks[0], job.options)))
    with client.as_current():
        pending = as_completed(submit(window))
    sent = window
    for done, future in enumerate(pending, 1):
        try:
            result = future.result()
        except KilledWorker:
            raise ClsplatError(
                f"frame {future.key.rpartition('-')[2]}: every worker that rendered it was lost; render this frame "
                "without --scheduler and --workers, to see why"
            ) from None
        except (CancelledError, OSError):
            advice = "go on with --skip-existing" if video is None else "begin again"
            raise ClsplatError(f"the scheduler was lost; {advice}") from None
        if isinstance(result, Failure):
            raise (InputError if result.wrong_input else ClsplatError)(result.message)
        yield result
        for another in submit((done if video is None else video.frames) + window - sent):
            pending.add(another)
            sent += 1
