# SPDX-License-Identifier: Apache-2.0
"""Writing of a job's frames: rendered by this process or on a farm, counted, and reported."""

from __future__ import annotations

import json
import sys
import time
from collections.abc import Callable, Iterable, Sequence
from typing import Any

from clsplat.cli.render.job import Job
from clsplat.errors import examples, warn
from clsplat.images.video import VideoWriter
from clsplat.progress import FrameProgress
from clsplat.sequence import finished_frames, workers
from clsplat.sequence.frame_claims import Sharing
from clsplat.sequence.task import Record, Task


def write_frames(job: Job, renderers: Sequence[Any]) -> int:
    """Render and write the frames that are not there, with a renderer for each device or on a farm.

    Raises ClsplatError, and KeyboardInterrupt with the number of frames done.
    """
    tasks, options = job.tasks, job.options
    flags = job.request.flags
    there = finished_frames.frames_there(tasks, options, job.video) if flags.skip_existing else set()
    if not (flags.overwrite or flags.is_video):
        finished_frames.check_foreign([task for task in tasks if task.key not in there])
    finished_frames.make_folders(tasks)
    finished_frames.remove_temporaries(tasks)
    left = [task for task in tasks if task.key not in there]
    records: dict[str, Record] = {}
    lines = sys.stdout if not flags.json else sys.stderr if flags.progress in ("json", "openjd") else None
    start = time.monotonic()
    try:
        with (
            FrameProgress(len(tasks), flags.progress, lines=lines) as progress,
            workers.open_video(left, job.video, options) as video,
        ):

            def done(record: Record) -> None:
                records[record.key] = record
                progress(record)

            for task in tasks:
                if task.key in there:
                    done(workers.record_of(task, options, skipped=True))
            if flags.on_farm:
                _on_farm(job, left, done, video)
            else:
                shared = flags.skip_existing and not flags.is_video
                workers.run_tasks(left, renderers, options, done, video, Sharing(options) if shared else None)
    except KeyboardInterrupt as error:
        count = f"{len(records)} of {len(tasks)} frames"
        advice = "nothing is left of the video" if flags.is_video else "go on with --skip-existing"
        error.args = (f"after {count}; {advice}",)
        raise
    if blank := [task.key for task in tasks if records[task.key].blank]:
        warn(
            f"{len(blank)} of {len(tasks)} frames show nothing of the model: {examples(blank)}; are the cameras in the "
            "model's world?"
        )
    if flags.profile:
        _print_profile(records.values(), time.monotonic() - start, len(renderers))
    if flags.json:
        print(json.dumps([records[task.key].document() for task in tasks], indent=2))
    return 0


def _on_farm(job: Job, tasks: Sequence[Task], done: Callable[[Record], None], video: VideoWriter | None) -> None:
    from clsplat.sequence.farm import WorkerJob, render_on_farm

    flags, limit = job.request.flags, job.request.memory_limit
    if flags.profile:
        warn("--profile is not used: it is for devices of this process")
    model, placed = str(job.cast.path.absolute()), job.cast.tracks is not None
    device = job.request.devices[0]
    worker_job = WorkerJob(model, job.cast.digest, job.options, flags.rasterizer, device, limit, placed)
    render_on_farm(tasks, worker_job, done, scheduler=flags.scheduler, workers=flags.workers, video=video)


def _print_profile(records: Iterable[Record], wall: float, devices: int) -> None:
    """Print the fraction of the wall time in which the devices worked."""
    kernels, transfers = (
        sum(getattr(record, name) or 0.0 for record in records) / (10 * max(wall, 1e-9) * max(devices, 1))
        for name in ("kernel_ms", "transfer_ms")
    )
    print(f"in {wall:.2f} s the device ran kernels {kernels:.1f} % and transfers {transfers:.1f} %", file=sys.stderr)
