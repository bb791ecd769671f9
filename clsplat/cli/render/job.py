# SPDX-License-Identifier: Apache-2.0
"""Job of `clsplat render`: load models and cameras, make a task for each frame, print the plan of --dry-run, and write
the frames."""

from __future__ import annotations

import json
import sys
import time
from collections.abc import Collection, Iterable, Iterator, Mapping, Sequence
from dataclasses import dataclass, replace
from functools import cache, partial
from pathlib import Path
from typing import Any

import numpy as np

from clsplat.camera import Camera, Window
from clsplat.cli.render.flags import RenderVerb
from clsplat.cli.render.request import Request
from clsplat.cli.render.shots import shots_asked, with_stage
from clsplat.config.pictures import DEFAULT_VIDEO_FPS, PictureConfig, VideoConfig
from clsplat.errors import InputError, amount, examples, warn
from clsplat.files.atomic import check_new
from clsplat.frame.lens import ByMap
from clsplat.frame.mattes import Matte
from clsplat.images.colour import Colours
from clsplat.images.video import check_size, rate_of, video_record
from clsplat.progress import FrameProgress
from clsplat.runs.appearance import gains_of
from clsplat.sequence import finished_frames, workers
from clsplat.sequence.frame_renderer import DevicePlan
from clsplat.sequence.job_models import JobModels, load_job_models, names_of
from clsplat.sequence.numbered import is_sequence
from clsplat.sequence.shot_tasks import held_out, make_views
from clsplat.sequence.task import Record, RenderOptions, Task, digest_of, picture_camera, sampling_of, warp_of
from clsplat.shots.frame_numbers import ranges
from clsplat.shots.shot_file import is_layout, parse_transform
from clsplat.version import package_version


@dataclass(frozen=True)
class Job:
    """Models, frames and options of a call of `clsplat render`, ready to be rendered.

    tasks: a task for each frame.
    spaces: names of the model's colour space and of the colour space of the written pictures.
    video: encoding of the video, with its frame rate.
    mattes: the objects of each Cryptomatte, by the name of its channel.
    """

    request: Request
    models: JobModels
    tasks: list[Task]
    options: RenderOptions
    spaces: tuple[str, str]
    video: VideoConfig
    mattes: Mapping[str, Matte]


def job_of(request: Request) -> Job:
    """Read cameras and models, and return the job, after all checks that are possible without rendering.

    Raises InputError; writes nothing.
    """
    flags, channels = request.flags, request.channels
    models = cache(partial(_models, flags))
    shots = shots_asked(flags, models)
    sampling = request.pictures.sampling
    tasks, chosen = make_views(shots, flags.frames, flags.output, request.resize, channels, sampling=sampling)
    pictures, unapplied = with_stage(request.pictures, flags.cameras, chosen, tasks)
    sizes = _picture_sizes(tasks, pictures, deep=flags.deep)
    finished_frames.check_folders(tasks)
    if flags.holdout is not None:
        tasks = held_out(tasks, flags.holdout, flags.holding)
    video = _video(flags, chosen.fps, tasks[0].path, sizes)
    for text in chosen.told(flags.cameras, *unapplied):
        warn(text)
    job_models = models()
    gains = gains_of(flags.model, flags.appearance) if flags.appearance is not None else ()
    tasks = job_models.seen(tasks, pictures, channels)
    mattes = job_models.mattes(channels, flags.ids_from or "")
    colours = Colours(pictures.colour, job_models.space)
    colours.check_file(flags.output)
    options = RenderOptions(
        channels,
        request.background,
        request.encoding,
        attributes={
            "Software": f"clsplat {package_version()}",
            "clsplat:model": job_models.digest,
            "clsplat:colorspace": colours.output,
        },
        pictures=pictures,
        recorded=job_models.space,
        deep=flags.slices if flags.deep else None,
        drawn=digest_of(flags.rasterizer),
        gains=gains,
        holdout=request.holdout,
        mattes=names_of(mattes),
        ids_from=flags.ids_from or "",
    )
    return Job(request, job_models, tasks, options, (colours.model, colours.output), video, mattes)


def _models(flags: RenderVerb) -> JobModels:
    """Load the model or models that MODEL names, placed by --transform. Raises InputError."""
    for has_several, what in ((is_layout, "is a shot of several models"), (is_sequence, "has a file for each frame")):
        if flags.appearance is not None and has_several(flags.model):
            raise InputError(f"--appearance {flags.appearance}: is for one run's model, but {flags.model} {what}")
    return load_job_models(flags.model, None if flags.transform is None else parse_transform(flags.transform))


def _video(flags: RenderVerb, fps: float | None, path: Path, sizes: Collection[tuple[int, int]]) -> VideoConfig:
    """Return the video settings, with the shot's frame rate unless a flag sets another.

    fps: the shot's frame rate in frames a second; None if the shot has no frame rate.
    path: file of the video.
    sizes: (width, height) of the pictures. A video needs pictures of a single size.
    Raises InputError for a frame rate or sizes that a video cannot have, and for an existing file that may not be
    replaced. With --skip-existing a video that clsplat wrote may be replaced.
    """
    if not flags.is_video:
        return flags.video
    if len(sizes) > 1:
        texts = sorted(f"{width}x{height}" for width, height in sizes)
        raise InputError(f"{path}: frames have sizes {examples(texts)}, expected a single one; give --width, --height")
    check_size(path, *next(iter(sizes)))
    if path.exists() or path.is_symlink():
        ours = flags.skip_existing and bool(video_record(path))
        check_new(path, overwrite=flags.overwrite or flags.dry_run or ours)
    if flags.video.fps is not None or fps is None:
        return flags.video
    video = replace(flags.video, fps=fps)
    try:
        video.check()
    except InputError:
        raise InputError(
            f"{flags.cameras}: has {fps:g} frames a second, expected 0.01 to 1000; give --video.fps"
        ) from None
    return video


def _picture_sizes(tasks: Sequence[Task], pictures: PictureConfig, *, deep: bool) -> set[tuple[int, int]]:
    """Return the sizes (width, height) of the pictures, and check the pictures' cameras.

    Raises InputError if a camera does not allow the framing, if deep stereo pairs are in one file, or if two eyes
    cannot share a file.
    """
    if deep and tasks[0].right is not None:
        raise InputError(f"--deep: {tasks[0].path} would hold both eyes, expected a file for each: {{eye}} in -o")
    sizes = set()
    for task in tasks:
        cameras = [picture_camera(view, pictures) for view in task.views]
        for camera in cameras:
            pictures.framing.check_model(camera.model)
            sizes.add((camera.width, camera.height))
        if len(cameras) > 1:
            _check_pair(task, *cameras)
    check_warps(tasks, pictures)
    return sizes


def _check_pair(task: Task, left: Camera, right: Camera) -> None:
    """Raise InputError if eyes in one EXR file differ in window size or pixel aspect ratio, which its parts share."""
    values = {"size": [f"{frame.width}x{frame.height}" for frame in (left.window or left, right.window or right)]}
    if task.optics is not None:
        # compare as float32, the precision in which EXR headers store the pixel aspect ratio
        values["pixel aspect ratio"] = [str(np.float32(eye.fy / eye.fx)) for eye in (left, right)]
    for what, (of_left, of_right) in values.items():
        if of_left != of_right:
            raise InputError(
                f"--stereo: frame {task.number} has the {what} {of_left} for the left, {of_right} for the right eye; "
                f"expected the same in {task.path}, which holds both; or write a file for each eye: {{eye}} in -o"
            )


def check_warps(tasks: Sequence[Task], pictures: PictureConfig) -> None:
    """Raise InputError for panoramas, which cannot be distorted, and for an STMap that does not cover the picture.

    Warns if a part of a picture stays empty. pictures: settings with the distortion of --stmap or --distort.
    """
    flag = f"--stmap {pictures.warp.stmap}" if pictures.warp.stmap else "--distort"
    empty: dict[int, float] = {}
    for task in (view for whole in tasks for view in whole.views):
        if (warp := warp_of(task, pictures)) is None:
            continue
        if task.camera.model.wraps:
            raise InputError(f"{flag}: frame {task.number} is a panorama, expected a picture with edges")
        if isinstance(warp.source, ByMap):
            camera, stmap = picture_camera(task, pictures), warp.source.stmap
            window = camera.window or Window(0, 0, camera.width, camera.height)
            if not stmap.covers(window.x, window.y, camera.width, camera.height):
                raise InputError(
                    f"{flag}: covers {stmap.values.shape[1]}x{stmap.values.shape[0]} pixels from {stmap.x},{stmap.y} "
                    "on, expected all of the picture; omit --overscan, or write the STMap with a larger data window"
                )
        if (part := warp.empty) > 0:
            empty[task.number] = max(part, empty.get(task.number, 0.0))
    if empty:
        number, part = max(empty.items(), key=lambda item: item[1])
        advice = "" if pictures.warp.stmap else "; --lenses native renders fisheyes without undistorted pictures"
        warn(
            f"{flag}: {100 * part:.0f} % of frame {number} stays black and transparent: even extended by its own size "
            f"on each side, the undistorted picture does not contain what these pixels show{advice}"
        )


def dry_run(job: Job, plans: Sequence[DevicePlan]) -> int:
    """Print the plan of --dry-run: frames, files and options, and the memory plan of each device."""
    document = _plan_document(job, plans)
    print(json.dumps(document, indent=2) if job.request.flags.json else "\n".join(_plan_lines(job, document, plans)))
    return 0


def _plan_document(job: Job, plans: Sequence[DevicePlan]) -> dict[str, Any]:
    """Return the plan of --dry-run as the object that --json prints."""
    tasks, options = job.tasks, job.options
    flags = job.request.flags
    skipped = finished_frames.frames_there(tasks, options, job.video) if flags.skip_existing else set()
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


def _plan_lines(job: Job, document: dict[str, Any], plans: Sequence[DevicePlan]) -> Iterator[str]:
    """Yield the plan of --dry-run as lines of text. document: the plan as from `_plan_document`."""
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
    """Return the distinct picture sizes as texts. If a picture is a part of the frame, the text gives its position.

    frames: the entries "frames" of `_plan_document`.
    """
    sizes = {(frame["width"], frame["height"], tuple(frame.get("window", ()))) for frame in frames}
    texts = []
    for width, height, window in sorted(sizes):
        place = " at {},{} of {}x{}".format(*window) if window else ""
        texts.append(f"{width}x{height}{place}")
    return texts


def _samples(job: Job) -> str:
    sampling, framing = sampling_of(job.tasks[0], job.options.pictures), job.options.pictures.framing
    words = [f"{sampling.samples} pictures per frame" if sampling.on else ""]
    if sampling.moves:
        opens, closes = sampling.shutter
        words.append(f"shutter from {opens:g} to {closes:g} frames")
    words.append(f"lens in focus at {sampling.focus:g}" if sampling.has_lens else "")
    if framing.supersample > 1:
        words.append(f"{framing.supersample}x{framing.supersample} samples per pixel, {framing.filter} filter")
    return ", ".join(word for word in words if word)


def write_frames(job: Job, renderers: Sequence[Any]) -> int:
    """Render and write all frames, with a renderer for each device or on a Dask cluster.

    renderers: a renderer for each device; unused on a Dask cluster.
    --skip-existing leaves out frames whose files exist.
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
                from clsplat.sequence.farm import WorkerJob, render_on_farm

                job_models, settings = job.models, (flags.rasterizer, job.request.devices[0], job.request.memory_limit)
                model, placed = str(job_models.path.absolute()), job_models.tracks is not None
                worker_job = WorkerJob(model, job_models.digest, options, *settings, placed)
                render_on_farm(left, worker_job, done, scheduler=flags.scheduler, workers=flags.workers, video=video)
            else:
                shared = flags.skip_existing and not flags.is_video
                workers.run_tasks(left, renderers, options, done, video, shared=shared)
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


def _print_profile(records: Iterable[Record], wall: float, devices: int) -> None:
    """Print the percentages of the wall time in which a device ran kernels and transfers, on average over all devices.

    records: the records of all frames, with their device times.
    wall: wall time of all frames in seconds.
    devices: number of devices.
    """
    kernels, transfers = (
        sum(getattr(record, name) or 0.0 for record in records) / (10 * max(wall, 1e-9) * max(devices, 1))
        for name in ("kernel_ms", "transfer_ms")
    )
    spent = "the device spent" if devices < 2 else f"each of {devices} devices spent on average"
    line = f"in {wall:.2f} s, {spent} {kernels:.1f} % of the time on kernels and {transfers:.1f} % on transfers"
    print(line, file=sys.stderr)
