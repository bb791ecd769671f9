# SPDX-License-Identifier: Apache-2.0
"""`clsplat render`: its flags, and a job from the call to the exit status.

A call is checked in `clsplat.cli.render_request`, --dry-run is in `clsplat.cli.render_plan`, the job's loop in
`clsplat.sequence.workers`, one frame in `clsplat.sequence.frame_renderer`, clusters in `clsplat.sequence.farm`.
"""

from __future__ import annotations

import json
import sys
import time
from collections.abc import Callable, Collection, Iterable, Sequence
from dataclasses import dataclass, field, replace
from pathlib import Path
from typing import TYPE_CHECKING, Annotated, Any, Literal

from tyro.conf import arg

from clsplat.cli.options import Flag, Memory, OptionalInt, RunOrModel, Verb, with_given
from clsplat.cli.session import Services
from clsplat.config.pictures import (
    EXR_DEPTH,
    ColourConfig,
    Compression,
    DeepConfig,
    ExrDepth,
    FramingConfig,
    Parts,
    SamplingConfig,
    VideoConfig,
)
from clsplat.config.presets import PRESETS, Preset
from clsplat.config.rasterizer import RasterizerConfig
from clsplat.errors import examples, warn
from clsplat.process import terminable
from clsplat.progress import FrameProgress

if TYPE_CHECKING:
    from clsplat.cli.render_request import Job
    from clsplat.images.video import VideoWriter
    from clsplat.sequence.task import Record, Task


@dataclass(frozen=True)
class Render(Verb):
    """Render a model from the cameras of a file or along a path made from them, an image for each frame."""

    model: RunOrModel
    """A run's folder or a model file."""
    cameras: Annotated[Path, arg(metavar="PATH")]
    """Folder of a COLMAP model (cameras and images, bin or txt), or of a scene that holds one; a transforms.json, a
    nerfstudio camera_path.json, a clsplat camera file (.json) or a USD stage. docs/cameras.md describes each."""
    output: Annotated[str, arg(aliases=("-o",), metavar="PATTERN")]
    """File names of the images, such as 'out/{name}.png' or 'shot/beauty.####.exr': EXR, PNG, TIFF or JPEG; or the name
    of a video of all frames, such as turn.mp4. {name} is the image's name without its extension, sub-folders included,
    or else the frame's number; ####, %04d and {frame} are the frame's number."""
    path: Annotated[Literal["turntable", "spiral", "through"] | None, arg(metavar="turntable|spiral|through")] = None
    """A path made from the cameras, in place of the cameras themselves: around what they look at, the same twice while
    rising and sinking, or through them in their order, smoothed. Its frames count from 1."""
    count: OptionalInt = None
    """Frames of the path; 120 if not given."""
    frames: Annotated[str | None, arg(metavar="1-100,200-300:2,...")] = None
    """Render these frames only; all if not given. Ranges may have a step. Write --frames=-5-10 if it begins with a
    negative number."""
    usd_camera: Annotated[str | None, arg(metavar="PRIM")] = None
    """Path or name of the camera, for a USD stage that has several."""
    channels: Annotated[str, arg(metavar="NAME,...")] = "rgb"
    """Channels of the files: rgb, alpha, and in EXR depth, median and first (depths), normals, position, motion, count
    and id (of Gaussians). docs/render.md has each."""
    background: Annotated[str | None, arg(metavar="black|white|R,G,B")] = None
    """Colour behind the Gaussians, the numbers from 0 to 1; black if not given."""
    alpha: Flag = False
    """Write alpha too, as --channels rgb,alpha does, and no background: premultiplied in EXR and TIFF, straight in
    PNG."""
    exr: ExrDepth = EXR_DEPTH
    """Floats of 16 or 32 bits in EXR, for colour, alpha and normals; depths, positions and motion are always of 32."""
    parts: Parts = "one"
    """one: all channels of an EXR file in one part; several: a part for colour with alpha and one for each other
    channel."""
    compression: Compression = "zip"
    """Compression of EXR files. pxr24, dwaa and dwab change the values a little; the others keep every bit."""
    bits: Literal[8, 16] = 8
    """Bits of each channel in PNG and TIFF files."""
    quality: int = 95
    """Quality of JPEG files, from 1 to 100, the best."""
    width: OptionalInt = None
    """Width in pixels; follows from the height, or from the camera, if not given. With a height of another shape than
    the camera's the vertical angle of view is kept."""
    height: OptionalInt = None
    """Height in pixels; follows from the width, or from the camera, if not given."""
    scale: float = 1.0
    """Factor on the camera's width and height, such as 0.5, where neither --width nor --height is given."""
    colour: Annotated[ColourConfig, arg(name="")] = field(default_factory=ColourConfig)
    framing: Annotated[FramingConfig, arg(name="")] = field(default_factory=FramingConfig)
    sampling: Annotated[SamplingConfig, arg(name="")] = field(default_factory=SamplingConfig)
    deep: Flag = False
    """Write deep EXR: of each pixel colour, alpha and depth in slices of the scene. docs/pictures.md has how."""
    slices: Annotated[DeepConfig, arg(name="deep")] = field(default_factory=DeepConfig)
    video: VideoConfig = field(default_factory=VideoConfig)
    preset: Annotated[Preset | None, arg(metavar="exact|default|fast")] = None
    """Bundle of rasterizer settings: exact and default approximate nothing, fast does a little. A --rasterizer flag
    overrides it. If not given: the run's own settings, else default."""
    overwrite: Flag = False
    """Replace a video that is there, and pictures that clsplat did not make. Frames of its own are replaced without it,
    but for --skip-existing."""
    skip_existing: Flag = False
    """Leave out frames whose file is there and can be read to its end, of this size, these channels, this model and,
    as far as it says so (EXR, PNG), made with these cameras and settings."""
    dry_run: Flag = False
    """Print what would be done, and do nothing: frames, sizes, channels, memory, files."""
    progress: Literal["auto", "json", "openjd", "none"] = "auto"
    """auto: a bar on a terminal, and a line for each frame written; json: an object a line for each frame, on standard
    output, or with --json on standard error; openjd: what Open Job Description shows as progress."""
    profile: Flag = False
    """Measure what part of the time the device is at work, and with --json how long on each frame."""
    device: Annotated[str | None, arg(metavar="DEVICE,...|all")] = None
    """OpenCL device: an index, cpu, gpu, or a part of a name, as `clsplat devices` lists them; several, with commas,
    share the frames. If not given: CLSPLAT_DEVICE, else the first GPU, else the first device."""
    workers: OptionalInt = None
    """Render in this many processes on this machine, as a Dask cluster. Needs the extra: pip install
    'clsplat[farm]'."""
    scheduler: Annotated[str | None, arg(metavar="ADDRESS")] = None
    """Render on the Dask cluster of the scheduler at this address, such as tcp://host:8786. Its workers need the model
    and the output folder under the same paths."""
    max_device_mem: Memory = None
    """Most device memory to use, such as 256MiB or 2G. What needs more is done in pieces: slower, with the same result.
    If not given: all that the device has."""
    json: Flag = False
    """Print the frames as JSON when all are done: name, frame, path, width, height, seconds, skipped, blank (nothing of
    the model is seen). With --dry-run: the plan."""
    rasterizer: RasterizerConfig = field(default_factory=RasterizerConfig)

    def completed(self, given: Collection[str]) -> Render:
        """The rasterizer's settings are those of the preset, or else of the run."""
        from clsplat.models.formats import model_path
        from clsplat.runs.run import Run, is_run

        if self.preset is not None:
            bundle = PRESETS[self.preset]
        elif self.model.is_dir() and (is_run(self.model) or model_path(self.model) == self.model):
            bundle = Run.open(self.model).config.rasterizer  # refuses a folder that is neither run nor model
        else:
            return self
        return replace(self, rasterizer=with_given(bundle, self.rasterizer, given, "rasterizer."))


def run(verb: Render, services: Services) -> int:
    """Model and cameras to images."""
    from clsplat.cli.render_request import read_job

    job = read_job(verb)
    if verb.dry_run:
        from clsplat.cli.render_plan import dry_run

        return dry_run(job)
    renderers = []
    if not job.on_farm:
        how: dict[str, Any] = {"memory_limit": job.memory_limit, "profile": verb.profile}
        model = (job.gaussians, job.options, job.verb.rasterizer)
        renderers = [services.open_frame_renderer(*model, device=selector, **how) for selector in job.devices]
        for renderer in renderers:
            renderer.check(job.tasks)
    with terminable():  # again, as pycolmap and compilers of kernels install handlers of their own
        return _write_frames(job, renderers)


def _write_frames(job: Job, renderers: Sequence[Any]) -> int:
    from clsplat.cli.render_request import check_foreign, frames_there
    from clsplat.sequence import existing, workers

    verb, tasks, options = job.verb, job.tasks, job.options
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
        error.args = (f"after {count}; {advice}",)
        raise
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


def _on_farm(job: Job, tasks: Sequence[Task], done: Callable[[Record], None], video: VideoWriter | None) -> None:
    from clsplat.sequence.farm import WorkerJob, render_on_farm

    verb = job.verb
    if verb.profile:
        warn("--profile is not used: it is for devices of this process")
    model = str(job.model.absolute())
    worker_job = WorkerJob(model, job.digest, job.options, job.verb.rasterizer, job.devices[0], job.memory_limit)
    render_on_farm(tasks, worker_job, done, scheduler=verb.scheduler, workers=verb.workers, video=video)


def _print_profile(records: Iterable[Record], wall: float, devices: int) -> None:
    """Print the share of the wall time in which the devices were at work."""
    kernels, transfers = (
        sum(getattr(record, name) or 0.0 for record in records) / (10 * max(wall, 1e-9) * max(devices, 1))
        for name in ("kernel_ms", "transfer_ms")
    )
    print(f"in {wall:.2f} s the device ran kernels {kernels:.1f} % and transfers {transfers:.1f} %", file=sys.stderr)
