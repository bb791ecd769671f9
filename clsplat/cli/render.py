# SPDX-License-Identifier: Apache-2.0
"""`clsplat render`: a job from its begin to its exit status.

What a call means is in `clsplat.cli.render_request`, the plan of --dry-run in `clsplat.cli.render_plan`, the job's loop
in `clsplat.sequence.workers`, one frame in `clsplat.sequence.frame_renderer`, clusters in `clsplat.sequence.farm`.
"""

from __future__ import annotations

import json
import signal
import sys
import threading
import time
from collections.abc import Callable, Sequence
from contextlib import suppress
from typing import TYPE_CHECKING, Any

from clsplat.cli.main import Render
from clsplat.cli.render_request import Job, check_foreign, frames_there, read_job, warn
from clsplat.errors import examples
from clsplat.process import endings, interrupt, status_of
from clsplat.progress import FrameProgress
from clsplat.sequence import existing, workers
from clsplat.sequence.frame_renderer import open_frame_renderer
from clsplat.sequence.task import Record, Task

if TYPE_CHECKING:
    from clsplat.images.video import VideoWriter


def render(verb: Render) -> int:
    """Model and cameras to images."""
    job = read_job(verb)
    if verb.dry_run:
        from clsplat.cli.render_plan import dry_run

        return dry_run(job)
    return _run(job)


def _run(job: Job) -> int:
    verb, tasks, options = job.verb, job.tasks, job.options
    renderers = []
    if not job.on_farm:
        how: dict[str, Any] = {"memory_limit": job.memory_limit, "profile": verb.profile}
        renderers = [
            open_frame_renderer(job.gaussians, options, job.rasterizer, device=device, **how) for device in job.devices
        ]
        for renderer in renderers:
            renderer.check(tasks)
    if threading.current_thread() is threading.main_thread():
        for each in endings():  # again, as pycolmap and compilers of kernels install handlers of their own
            signal.signal(each, interrupt)
    there = frames_there(job)
    check_foreign(job, there)
    existing.make_folders(tasks)
    existing.remove_temporaries(tasks)
    records: dict[int, Record] = {}
    lines = sys.stdout if not verb.json else sys.stderr if verb.progress in ("json", "openjd") else None
    start = time.monotonic()
    try:
        with (
            FrameProgress(len(tasks), verb.progress, lines=lines) as progress,
            workers.open_video(tasks, job.video) as video,
        ):

            def done(record: Record) -> None:
                records[record.frame] = record
                progress(record)

            for task in tasks:
                if task.number in there:
                    done(workers.record_of(task, options, skipped=True))
            left = [task for task in tasks if task.number not in there]
            if job.on_farm:
                _on_farm(job, left, done, video)
            else:
                workers.run_tasks(left, renderers, options, done, video)
    except KeyboardInterrupt as error:
        count = f"{len(records)} of {len(tasks)} frames"
        advice = "nothing is left of the video" if job.is_video else "go on with --skip-existing"
        with suppress(OSError):  # the terminal may be gone
            print(f"clsplat: interrupted after {count}; {advice}", file=sys.stderr)
        return status_of(error)
    if blank := [number for number, record in sorted(records.items()) if record.blank]:
        warn(
            f"{len(blank)} of {len(tasks)} frames show nothing of the model: {examples(blank)}; are the cameras in the "
            "model's world?"
        )
    if verb.profile:
        _print_profile(records.values(), time.monotonic() - start, len(renderers))
    if verb.json:
        print(json.dumps([records[task.number].document() for task in tasks], indent=2))
    return 0


def _on_farm(job: Job, tasks: Sequence[Task], done: Callable[[Record], None], video: VideoWriter | None = None) -> None:
    from clsplat.sequence.farm import WorkerJob, render_on_farm

    if job.verb.profile:
        warn("--profile is not used: it is for devices of this process")
    worker_job = WorkerJob(
        str(job.model.absolute()),
        job.digest,
        job.options,
        job.rasterizer,
        job.devices[0],
        job.memory_limit,
    )
    verb = job.verb
    render_on_farm(tasks, worker_job, done, scheduler=verb.scheduler, workers=verb.workers, video=video)


def _print_profile(records: Any, wall: float, devices: int) -> None:
    """Print the share of the wall time in which the devices were at work."""
    kernels, transfers = (
        sum(getattr(record, name) or 0.0 for record in records) / (10 * max(wall, 1e-9) * max(devices, 1))
        for name in ("kernel_ms", "transfer_ms")
    )
    print(f"in {wall:.2f} s the device ran kernels {kernels:.1f} % and transfers {transfers:.1f} %", file=sys.stderr)
