# SPDX-License-Identifier: Apache-2.0
"""`clsplat render --dry-run`: the plan as text and as JSON."""

from __future__ import annotations

import json
from collections.abc import Iterator, Sequence
from typing import Any

from clsplat.cli.render.job import Job
from clsplat.config.pictures import DEFAULT_VIDEO_FPS
from clsplat.errors import amount, examples
from clsplat.images.video import rate_of
from clsplat.sequence import workers
from clsplat.sequence.finished_frames import frames_there
from clsplat.sequence.frame_renderer import DevicePlan
from clsplat.sequence.task import picture_camera, sampling_of
from clsplat.shots.frame_numbers import ranges


def dry_run(job: Job, plans: Sequence[DevicePlan]) -> int:
    """Print the job, and the memory plan of each device that renders it."""
    document = _document(job, plans)
    print(json.dumps(document, indent=2) if job.request.flags.json else "\n".join(_lines(job, document, plans)))
    return 0


def _document(job: Job, plans: Sequence[DevicePlan]) -> dict[str, Any]:
    """The plan as data, for --json."""
    tasks, options = job.tasks, job.options
    flags = job.request.flags
    skipped = frames_there(tasks, options, job.video) if flags.skip_existing else set()
    writers, waiting = workers.frames_ahead(tasks, options, len(job.request.devices))
    model, output = job.spaces
    frames = []
    for task in tasks:
        camera = picture_camera(task, options.pictures)
        frame = {"name": task.name, "frame": task.number, "path": str(task.path)}
        frame |= {"width": camera.width, "height": camera.height, "skipped": task.key in skipped}
        if task.holdout is not None:
            frame["holdout"] = str(task.holdout)
        if window := camera.window:
            frame["window"] = [window.x, window.y, window.width, window.height]
        if task.eye and task.right is None:
            frame["eye"] = task.eye
        frames.append(frame)
    return {
        "model": str(job.models.path),
        "digest": job.models.digest,
        "gaussians": job.models.count,
        "channels": list(options.channels),
        "deep_bins": options.deep.bins if options.deep else 0,
        "model_colorspace": model,
        "colorspace": output,
        "samples": max(sampling_of(task, options.pictures).pictures for task in tasks),
        "supersample": options.pictures.framing.supersample,
        **({"fps": job.video.fps or DEFAULT_VIDEO_FPS} if flags.is_video else {}),
        "frames": frames,
        "devices": [
            {
                "device": device.device,
                "needed": device.plan.need.total,
                "allowed": device.plan.allowed,
                "pieces": any(device.plan.pieces),
                "strips": device.strips,
            }
            for device in plans
        ],
        "host_bytes": waiting * max(workers.frame_bytes(task, options) for task in tasks),
        "writers": writers,
    }


def _lines(job: Job, document: dict[str, Any], plans: Sequence[DevicePlan]) -> Iterator[str]:
    """The plan as lines of text."""
    frames = document["frames"]
    paths = dict.fromkeys((frames[0]["path"], frames[-1]["path"]))
    spaces = dict.fromkeys((document["model_colorspace"], document["colorspace"]))
    deep = f" in {document['deep_bins']} slices by depth" if document["deep_bins"] else ""
    yield f"model     {document['model']}: {document['gaussians']:,} Gaussians, SHA-256 {document['digest'][:12]}"
    yield f"frames    {len(frames)}: {ranges(sorted({frame['frame'] for frame in frames}))}; {examples(_sizes(frames))}"
    yield f"files     {' to '.join(paths)}"
    if job.request.flags.is_video:
        yield f"video     {rate_of(document['fps'])} frames a second"
    yield f"channels  {', '.join(document['channels'])}{deep}"
    yield f"colour    {' to '.join(spaces)}"
    if (held := job.tasks[0].holdout) is not None:
        yield f"holdout   {' to '.join(dict.fromkeys((str(held), str(job.tasks[-1].holdout))))}"
    if samples := _samples(job):
        yield f"samples   {samples}"
    for device in plans:
        strips = f"; {device.strips} strips a frame" if device.strips > 1 else ""
        yield f"device    {device.device}: {device.plan}{strips}"
    yield f"host      about {amount(document['host_bytes'])} for frames that wait to be written"
    if job.request.flags.skip_existing:
        skipped = [frame["frame"] for frame in frames if frame["skipped"]]
        yield f"skipped   {len(skipped)}" + (f": {ranges(sorted(set(skipped)))}" if skipped else "")


def _sizes(frames: Sequence[dict[str, Any]]) -> list[str]:
    """Distinct sizes of the pictures, and the frames that contain them."""
    sizes = {(frame["width"], frame["height"], tuple(frame.get("window", ()))) for frame in frames}
    texts = []
    for width, height, window in sorted(sizes):
        place = " at {},{} of {}x{}".format(*window) if window else ""
        texts.append(f"{width}x{height}{place}")
    return texts


def _samples(job: Job) -> str:
    sampling, framing = sampling_of(job.tasks[0], job.options.pictures), job.options.pictures.framing
    words = [f"{sampling.samples} frames for one" if sampling.on else ""]
    if sampling.moves:
        opens, closes = sampling.shutter
        words.append(f"shutter from {opens:g} to {closes:g} frames")
    words.append(f"lens in focus at {sampling.focus:g}" if sampling.has_lens else "")
    words.append(
        f"{framing.supersample}x{framing.supersample} a pixel, {framing.filter}" if framing.supersample > 1 else ""
    )
    return ", ".join(word for word in words if word)
