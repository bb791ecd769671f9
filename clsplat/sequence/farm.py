# SPDX-License-Identifier: Apache-2.0
"""Frames on a Dask cluster: one that is there, or one of processes of this machine. Needs `distributed`.

A frame is a task. Every worker loads the model once and keeps it; the files have to be under the same paths for all.
"""

from __future__ import annotations

import logging
import signal
import threading
import time
import uuid
from collections.abc import Callable, Iterator, Sequence
from contextlib import contextmanager
from dataclasses import dataclass, replace
from itertools import islice
from pathlib import Path
from typing import Any

import clsplat
from clsplat.config.rasterizer import RasterizerConfig
from clsplat.errors import ClsplatError, InputError, warn
from clsplat.images.video import VideoWriter
from clsplat.sequence.cast import load_cast
from clsplat.sequence.existing import is_complete, remove_temporaries, stamp
from clsplat.sequence.frame_renderer import FrameRenderer, open_frame_renderer
from clsplat.sequence.mattes import mattes_of, names_of
from clsplat.sequence.task import Record, RenderOptions, Task
from clsplat.sequence.workers import HOST_BYTES, Result, encode_frame, encoded, frame_bytes, record_of

THREADS = 2
"""Threads of a local worker: one frame is encoded while the next is rendered."""
HELD = 3
"""Frames that a worker holds at once, whatever threads it has."""
PATIENCE = 20
"""Seconds in which a scheduler has to answer."""
REMINDER = 10.0
"""Seconds from one line to the next while a scheduler has no workers."""


@dataclass(frozen=True)
class WorkerJob:
    """Everything that a worker has to load. model: an absolute path, with the SHA-256 of its content (`Cast.digest`),
    of a shot's too, whose placements come with the tasks; version: of clsplat."""

    model: str
    digest: str
    options: RenderOptions
    rasterizer: RasterizerConfig
    device: str | None = None
    memory_limit: int | None = None
    placed: bool = False
    version: str = clsplat.__version__


@dataclass(frozen=True)
class Failure:
    """A worker's trouble; exceptions of ours do not all survive being sent."""

    message: str
    wrong_input: bool


class _Held:
    """The renderer that this process has open, of one job, and the right to render with it."""

    def __init__(self) -> None:
        self.turn, self.room = threading.Lock(), threading.Semaphore(HELD)
        self.key: str | None = None
        self.renderer: FrameRenderer | None = None

    def renderer_for(self, job: WorkerJob) -> FrameRenderer:
        if self.renderer is None or repr(job) != self.key:
            self.key = self.renderer = None  # its memory is free before the next takes some
            cast = load_cast(Path(job.model))
            if cast.digest != job.digest:
                raise InputError(f"{job.model}: has SHA-256 {cast.digest[:12]} on a worker, expected {job.digest[:12]}")
            model = cast.models if job.placed else cast.one
            mattes = mattes_of(cast, job.options.channels, job.options.ids_from)
            if names_of(mattes) != job.options.mattes:
                raise InputError(f"{job.model}: has other mattes on a worker than it had when the job began")
            how: dict[str, Any] = {"mattes": mattes, "device": job.device, "memory_limit": job.memory_limit}
            self.renderer = open_frame_renderer(model, job.options, job.rasterizer, **how)
            self.key = repr(job)
        return self.renderer


_HELD = _Held()


def render_frame(task: Task, job: WorkerJob) -> Result | Failure:
    """Render a frame in a worker and write its file, unless a worker that was lost since has finished it; a frame of a
    video is returned, for the process that encodes it."""
    try:
        if job.version != clsplat.__version__:
            raise InputError(f"a worker has clsplat {clsplat.__version__}, expected {job.version}")
        with _HELD.room:
            with _HELD.turn:
                if not task.is_video and stamp(task.path) != task.before and is_complete(task, job.options):
                    return record_of(task, job.options), None
                frame = _HELD.renderer_for(job)(task)
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
    """Render the frames on the cluster of the scheduler at that address, or on a new one of `workers` processes here.
    Those of a video are encoded here.

    on_done: as for `workers.run_tasks`. The frames of a worker that is lost are rendered again by others. Raises
    InputError where there is no such cluster, and ClsplatError for a frame that cannot be rendered, or that has cost
    more workers than Dask allows.
    """
    if not tasks:
        return
    if not job.options.channels:
        raise ValueError("no channels")
    placed = [replace(task, path=task.path.absolute(), before=stamp(task.path)) for task in tasks]
    names = {task.key: str(task.path) for task in tasks}
    with _client(scheduler, workers) as client, _telling_of_no_workers(client, scheduler):
        results = _results(client, placed, job, video)
        for record in encoded(placed, results, video):
            on_done(replace(record, path=names[record.key]))
    # A worker that was killed while it wrote has left a file; none writes any more.
    remove_temporaries(tasks)


def _results(client: Any, tasks: Sequence[Task], job: WorkerJob, video: VideoWriter | None = None) -> Iterator[Result]:
    """Results of `render_frame` as the frames are done; a window of tasks is with the scheduler, and not a million. For
    a video the window begins with the frame that is to be encoded next, as those that come early wait here."""
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
        window = max(threads + 1, min(window, HOST_BYTES // frame_bytes(tasks[0], job.options)))
    with client.as_current():
        pending = as_completed(submit(window))
    sent = window
    for done, future in enumerate(pending, 1):
        try:
            result = future.result()
        except KilledWorker:
            raise ClsplatError(
                f"frame {future.key.rpartition('-')[2]}: every worker that took it was lost; render it alone, to "
                "see why"
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


@contextmanager
def _telling_of_no_workers(client: Any, scheduler: str | None) -> Iterator[None]:
    """Inside, a warning says so at once and every REMINDER seconds while the scheduler has no workers. Nothing for a
    cluster that is made here."""
    if scheduler is None:
        yield
        return
    stop = threading.Event()

    def watch() -> None:
        since: float | None = None
        while not stop.is_set():
            try:
                there = bool(client.nthreads())
            except (OSError, RuntimeError, TimeoutError):  # the loop over the frames tells of a scheduler that is lost
                return
            now = time.monotonic()
            since = None if there else since or now
            if since is not None and not stop.is_set():
                waited = f", for {now - since:.0f} s now" if now - since >= 1 else ""
                warn(
                    f"--scheduler {scheduler}: has no workers{waited}; frames wait until one is there, started with "
                    f"dask worker {scheduler}"
                )
            stop.wait(REMINDER)

    watcher = threading.Thread(target=watch, name="clsplat-farm", daemon=True)
    watcher.start()
    try:
        yield
    finally:
        stop.set()
        watcher.join(REMINDER)


def dask_setup(_: Any) -> None:
    """Leave Ctrl-C, which a terminal sends to a local worker as well, to the job. Dask calls this in the worker."""
    signal.signal(signal.SIGINT, signal.SIG_IGN)


@contextmanager
def _client(scheduler: str | None, workers: int | None) -> Iterator[Any]:
    try:
        import dask
        import distributed
    except ImportError:
        flag = "--scheduler" if scheduler else "--workers"
        raise InputError(
            f"{flag}: needs the package distributed, install it with: pip install 'clsplat[farm]'"
        ) from None
    # Dask logs every worker that it loses in many lines. What matters is raised.
    for name in ("distributed", "distributed.nanny", "distributed.worker", "distributed.scheduler", "distributed.core"):
        logging.getLogger(name).setLevel(logging.CRITICAL)
    if scheduler is not None:
        try:
            client = distributed.Client(scheduler, timeout=PATIENCE, set_as_default=False)
        except (OSError, ValueError, RuntimeError) as error:
            reason = str(error).partition("\n")[0] or type(error).__name__
            raise InputError(f"--scheduler {scheduler}: no scheduler answers there: {reason}") from None
        with client:
            yield client
        return
    with (
        dask.config.set({"distributed.worker.daemon": True, "distributed.worker.multiprocessing-method": "spawn"}),
        distributed.LocalCluster(
            n_workers=workers,
            threads_per_worker=THREADS,
            processes=True,
            memory_limit=None,  # Dask's own would end workers whose model is large
            dashboard_address=None,
            preload=[__name__],
            silence_logs=logging.CRITICAL,
        ) as cluster,
        distributed.Client(cluster, set_as_default=False) as client,
    ):
        yield client
