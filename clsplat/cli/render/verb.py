# SPDX-License-Identifier: Apache-2.0
"""`clsplat render`: its flags, and its run from the call to the exit status.

A command line becomes a `clsplat.cli.render.job.Job`, which `clsplat.cli.render.dry_run` prints for --dry-run.
`clsplat.sequence.workers` renders the job, on clusters with `clsplat.sequence.farm`. `clsplat.sequence.frame_renderer`
renders one frame.
"""

from __future__ import annotations

import json
import sys
import time
from collections.abc import Callable, Collection, Iterable, Sequence
from dataclasses import dataclass, field, fields, replace
from functools import partial
from pathlib import Path
from typing import TYPE_CHECKING, Annotated, Any, Literal

from tyro.conf import arg

from clsplat.cli.options import Flag, Memory, OptionalInt, RunOrModel, Verb, with_given
from clsplat.cli.render.help_page import RENDER_GROUPS
from clsplat.cli.session import Services
from clsplat.config.checks import parse_bytes
from clsplat.config.holdout import HoldoutConfig
from clsplat.config.pictures import (
    DEFAULT_EXR_DEPTH,
    ColourConfig,
    Compression,
    DeepConfig,
    Encoding,
    ExrDepth,
    FramingConfig,
    Parts,
    PictureConfig,
    SamplingConfig,
    VideoConfig,
    WarpConfig,
)
from clsplat.config.presets import RASTERIZER_PRESETS, Preset
from clsplat.config.rasterizer import RasterizerConfig
from clsplat.config.stereo import StereoConfig
from clsplat.config.training import Lenses
from clsplat.errors import InputError, examples, warn
from clsplat.files.atomic import check_new
from clsplat.process import terminable
from clsplat.progress import FrameProgress

if TYPE_CHECKING:
    from clsplat.cli.render.job import Job
    from clsplat.cli.render.stereo import Asked
    from clsplat.images.video import VideoWriter
    from clsplat.sequence.task import Record, RenderOptions, Task
    from clsplat.shots import Shot


_BITS_EXTENSIONS = (".png", ".tif", ".tiff", ".dpx")
_EXTENSIONS_BY_FLAG = {
    **dict.fromkeys(("exr", "parts", "compression"), (".exr",)),
    "bits": _BITS_EXTENSIONS,
    "quality": (".jpg", ".jpeg"),
}
"""File endings for which each encoding flag has an effect."""


@dataclass(frozen=True)
class RenderVerb(Verb):
    """Render a model from the cameras of a file or along a path made from them, an image for each frame."""

    groups = RENDER_GROUPS
    model: RunOrModel
    """A run's folder or a model file. A model that changes has a file for each frame ('capture.####.ply'). A shot with
    several models is a .json file or a USD stage that places them (docs/shot.md)."""
    output: Annotated[str, arg(aliases=("-o",), metavar="PATTERN")]
    """File names of the images, such as 'out/{name}.png' or 'shot/beauty.####.exr': EXR, PNG, TIFF, JPEG or DPX. A
    name such as turn.mp4, or turn.mov for ProRes, makes a video of all frames. {name} is the image's name without its
    extension but with its sub-folders, or else the frame's number. ####, %04d and {frame} are the frame's number;
    {eye} and %V are left or right."""
    cameras: Annotated[Path | None, arg(metavar="PATH")] = None
    """Folder of a COLMAP model (cameras and images, bin or txt), or of a scene that contains one. Or a file:
    transforms.json, nerfstudio's camera_path.json, cameras.json of 3DGS, a clsplat camera file (.json) or a USD stage.
    docs/cameras.md describes each. Not needed with --path turntable or spiral."""
    transform: Annotated[str | None, arg(metavar="FILE|STEPS|M00,M01,...")] = None
    """Place the model by a 4 x 4 matrix: rotation, uniform scale, translation. Give 16 numbers row by row, a file of
    them, or steps in their order such as 'rotate=0,90,0 scale=2 translate=1,0,0'. A JSON file can hold key frames or a
    matrix a frame (docs/shot.md)."""
    path: Annotated[Literal["turntable", "spiral", "through"] | None, arg(metavar="turntable|spiral|through")] = None
    """Path made from the cameras, instead of the cameras themselves. turntable: around their common focus; spiral: the
    same twice, while rising and sinking; through: along the cameras in their order, smoothed. Frames count from 1.
    Without --cameras it uses the cameras of a run's photographs. For a model alone the path goes around it, or around
    a scene's most detailed part."""
    up: Annotated[str | None, arg(metavar="AXIS|X,Y,Z")] = None
    """Up direction of a path around a model, without --cameras: x, y, z, -x, -y, -z or three numbers. If not given: -y,
    as in a COLMAP scene. With it the path goes around a run's model too. Write --up=-z if it begins with a minus."""
    count: OptionalInt = None
    """Number of frames of the path; 120 if not given."""
    frames: Annotated[str | None, arg(metavar="1-100,200-300:2,...")] = None
    """Render only these frames; all if not given. Ranges may have a step. Write --frames=-5-10 if it begins with a
    negative number."""
    usd_camera: Annotated[str | None, arg(metavar="PRIM")] = None
    """Path or name of the camera, for a USD stage with several."""
    lenses: Annotated[Lenses | None, arg(metavar="undistort|native")] = None
    """Rendering of fisheye cameras of photographs. undistort: as the pinhole cameras that fit into them; native:
    through their own lens. If not given: as the run was trained; but undistort with --path, whose cameras are pinholes,
    and without a run."""
    channels: Annotated[str, arg(metavar="NAME,...")] = "rgb"
    """Channels of the files: rgb and alpha. EXR files can also hold depth, median and first (depths), normals,
    position, motion (to the next frame) and backward (to the previous frame). Further EXR channels are count and id (of
    Gaussians), objects and semantic (Cryptomattes). docs/render.md describes each."""
    ids_from: Annotated[str | None, arg(metavar="PROPERTY")] = None
    """Property of the models' PLY files with an integer for each Gaussian, for --channels semantic."""
    background: Annotated[str | None, arg(metavar="black|white|R,G,B")] = None
    """Colour behind the Gaussians: black, white or three numbers from 0 to 1; black if not given."""
    appearance: Annotated[str | None, arg(metavar="PHOTO")] = None
    """Give the model the exposure and colours of this photograph of its scene, from the run's appearance.json, but not
    its lens's vignette. If not given: the photographs' average. The background does not change."""
    alpha: Flag = False
    """Write alpha too, like --channels rgb,alpha, without a background. It is premultiplied in EXR and TIFF, straight
    in PNG."""
    exr: ExrDepth = DEFAULT_EXR_DEPTH
    """Bits of the floats in EXR, 16 or 32, for colour, alpha and normals. Depths, positions and motion always have
    32."""
    parts: Parts = "one"
    """one: all channels of an EXR file in one part; several: one part for colour with alpha, and one for each other
    channel."""
    compression: Compression = "zip"
    """Compression of EXR files. pxr24, dwaa and dwab change the values slightly. The others are lossless."""
    bits: Annotated[Literal[8, 10, 16] | None, arg(metavar="8|10|16")] = None
    """Bits of each channel: 8 or 16 in PNG and TIFF files, 8 if not given; 10 or 16 in DPX files, 10 if not given."""
    quality: int = 95
    """Quality of JPEG files, from 1 to 100 (best)."""
    width: OptionalInt = None
    """Width in pixels. If not given: from the height, or the camera's. If width and height change the camera's shape,
    its vertical field of view is kept."""
    height: OptionalInt = None
    """Height in pixels. If not given: from the width, or the camera's."""
    scale: float = 1.0
    """Factor on the camera's width and height, such as 0.5. It excludes --width and --height."""
    colour: Annotated[ColourConfig, arg(name="")] = field(default_factory=ColourConfig)
    framing: Annotated[FramingConfig, arg(name="")] = field(default_factory=FramingConfig)
    sampling: Annotated[SamplingConfig, arg(name="")] = field(default_factory=SamplingConfig)
    warp: Annotated[WarpConfig, arg(name="")] = field(default_factory=WarpConfig)
    pairs: Annotated[StereoConfig, arg(name="")] = field(default_factory=StereoConfig)
    deep: Flag = False
    """Write deep EXR: colour, alpha and depth of each pixel, in slices of the scene. docs/pictures.md explains them."""
    slices: Annotated[DeepConfig, arg(name="deep")] = field(default_factory=DeepConfig)
    holdout: Annotated[str | None, arg(metavar="PATTERN")] = None
    """Depth EXR or deep EXR of other elements, such as 'cg/depth.####.exr'. Everything behind their surfaces is left
    out of all channels. docs/pictures.md explains holdouts."""
    holding: Annotated[HoldoutConfig, arg(name="holdout")] = field(default_factory=HoldoutConfig)
    video: VideoConfig = field(default_factory=VideoConfig)
    preset: Annotated[Preset | None, arg(metavar="exact|default|fast")] = None
    """Bundle of rasterizer settings: exact and default approximate nothing, fast approximates a little. A --rasterizer
    flag overrides it. If not given: the run's own settings, else default."""
    overwrite: Flag = False
    """Replace an existing video, and pictures that clsplat did not make. Its own frames are replaced without this flag,
    unless --skip-existing is given."""
    skip_existing: Flag = False
    """Leave out frames with an intact file of the same size, channels and model. If the file records its cameras and
    settings, these must agree too."""
    dry_run: Flag = False
    """Print the plan and render nothing: frames, sizes, channels, memory, files."""
    progress: Literal["auto", "json", "openjd", "none"] = "auto"
    """auto: a bar on a terminal, and a line for each frame written. json: one object a line for each frame, on standard
    output, or on standard error with --json. openjd: progress messages for Open Job Description."""
    profile: Flag = False
    """Measure the fraction of time in which the device works. With --json also the time on each frame."""
    device: Annotated[str | None, arg(metavar="DEVICE,...|all")] = None
    """OpenCL device: an index, cpu, gpu, or part of a name, as listed by `clsplat devices`. Several, separated by
    commas, share the frames. If not given: CLSPLAT_DEVICE, else the first GPU, else the first device."""
    workers: OptionalInt = None
    """Render in this many processes on this machine, as a Dask cluster. Needs the extra: pip install
    'clsplat[farm]'."""
    scheduler: Annotated[str | None, arg(metavar="ADDRESS")] = None
    """Render on the Dask cluster of the scheduler at this address, such as tcp://host:8786. Its workers need the model
    and the output folder under the same paths."""
    max_device_mem: Memory = None
    """Limit of device memory, such as 256MiB or 2G. Work that needs more is done in pieces: slower, with the same
    result. If not given: all of the device's memory."""
    json: Flag = False
    """Print the frames as JSON when all are done: name, frame, path, width, height, seconds, skipped, and blank (no
    part of the model is visible). With --dry-run: the plan."""
    rasterizer: RasterizerConfig = field(default_factory=RasterizerConfig)

    def completed(self, given: Collection[str]) -> RenderVerb:
        """Take the rasterizer's settings from the preset, or without one from the run, and the lenses from the run."""
        from clsplat.models.formats import model_path
        from clsplat.runs.run import Run, is_run

        if "lenses" in given and self.cameras is None:
            raise InputError(f"--lenses {self.lenses}: is for cameras of photographs, expected --cameras with it")
        if self.lenses is not None and self.warp.distort:
            raise InputError(f"--lenses {self.lenses} and --distort exclude each other: --distort applies the lens")
        bundle, lenses = RASTERIZER_PRESETS["default"], self.lenses or "undistort"
        if self.model.is_dir() and (is_run(self.model) or model_path(self.model) == self.model):
            config = Run.open(self.model).config  # refuses a folder that is neither a run nor a model
            bundle, lenses = config.rasterizer, self.lenses or ("undistort" if self.path else config.lenses)
        if self.preset is not None:
            bundle = RASTERIZER_PRESETS[self.preset]
        return replace(self, rasterizer=with_given(bundle, self.rasterizer, given, "rasterizer."), lenses=lenses)


def run(verb: RenderVerb, services: Services) -> int:
    """Render a model from cameras to images."""
    job = _read_job(verb)
    if verb.dry_run:
        from clsplat.cli.render.dry_run import dry_run

        return dry_run(job, as_json=verb.json)
    renderers = []
    if not job.on_farm:
        renderers = [
            services.open_frame_renderer(
                job.cast.drawn,
                job.options,
                job.rasterizer,
                device=selector,
                memory_limit=job.memory_limit,
                profile=verb.profile,
                mattes=job.mattes,
            )
            for selector in job.devices
        ]
        for renderer in renderers:
            renderer.check(job.tasks)
    with terminable():  # installed again: pycolmap and kernel compilers have installed handlers of their own
        return _write_frames(verb, job, renderers)


def _read_job(verb: RenderVerb) -> Job:
    """Check everything that can be checked without rendering. Raises InputError and DeviceError; writes nothing."""
    from clsplat.cli.render.job import Job, check_colours, check_pictures, is_ours, resizer, with_models
    from clsplat.cli.render.stereo import shots_asked
    from clsplat.cli.render.usd_stage import with_stage
    from clsplat.images.colour import Colours
    from clsplat.runs.appearance import gains_of
    from clsplat.sequence import finished_frames
    from clsplat.sequence.holdout_files import held_out
    from clsplat.sequence.mattes import mattes_of
    from clsplat.sequence.stereo_tasks import make_views
    from clsplat.sequence.task import digest_of

    asked = _asked(verb)
    options = _options(verb)
    verb.rasterizer.check()
    limit = parse_bytes(verb.max_device_mem)
    resize = resizer(verb.width, verb.height, verb.scale)
    devices = _devices(verb)
    shots, cast = shots_asked(asked, verb.pairs)
    sampling = options.pictures.sampling
    tasks, chosen = make_views(shots, verb.frames, verb.output, resize, options.channels, sampling=sampling)
    options, unapplied = with_stage(options, verb.cameras, chosen, tasks)
    check_pictures(tasks, options)
    if verb.holdout is not None:
        tasks = held_out(tasks, verb.holdout, verb.holding)
    finished_frames.check_folders(tasks)
    if tasks[0].is_video and (tasks[0].path.exists() or tasks[0].path.is_symlink()):
        ours = verb.skip_existing and is_ours(tasks[0].path)
        check_new(tasks[0].path, overwrite=verb.overwrite or verb.dry_run or ours)
    _warn_of_unused(verb, options.channels)
    for text in chosen.told(verb.cameras, *unapplied):
        warn(text)
    cast = asked.model() if cast is None else cast
    gains = gains_of(verb.model, verb.appearance) if verb.appearance is not None else ()
    tasks = cast.seen(tasks, options.pictures, options.channels)
    mattes = mattes_of(cast, options.channels, verb.ids_from or "")
    colours = Colours(options.pictures.colour, cast.space)
    check_colours(verb.output, colours)
    options = with_models(options, cast, mattes, colours.output)
    options = replace(options, gains=gains, ids_from=verb.ids_from or "", drawn=digest_of(verb.rasterizer))
    return Job(
        options,
        verb.rasterizer,
        cast,
        tasks,
        devices,
        limit,
        spaces=(colours.model, colours.output),
        video=_video(verb, chosen),
        on_farm=verb.workers is not None or verb.scheduler is not None,
        skip_existing=verb.skip_existing,
        mattes=mattes,
    )


def _asked(verb: RenderVerb) -> Asked:
    """The shot that the flags ask for. Raises InputError if --cameras is missing."""
    from clsplat.cli.render.models import read_cast
    from clsplat.cli.render.stereo import Asked
    from clsplat.runs.run import run_of
    from clsplat.runs.scene_record import own_cameras
    from clsplat.shots import check_around

    own = own_cameras(run_of(verb.model)) if verb.cameras is None and not verb.transform else []
    if verb.cameras is None:
        check_around(verb.path, among_own=bool(own) and verb.up is None)
    return Asked(
        cameras=verb.cameras,
        path=verb.path,
        count=verb.count,
        size=(verb.width, verb.height),
        usd_camera=verb.usd_camera,
        lenses=verb.lenses or "undistort",
        distort=verb.warp.distort,
        up=verb.up,
        model=partial(read_cast, verb.model, verb.transform, verb.appearance),
        own=own,
    )


def _warn_of_unused(verb: RenderVerb, channels: Collection[str]) -> None:
    """Warn of flags that have no effect on these files."""
    extension, defaults = Path(verb.output).suffix.lower(), {field.name: field.default for field in fields(RenderVerb)}
    unused = [
        name
        for name, extensions in _EXTENSIONS_BY_FLAG.items()
        if extension not in extensions and getattr(verb, name) != defaults[name] and not (name == "exr" and verb.deep)
    ]
    if "rgb" not in channels and verb.background is not None:
        unused.append("background")
    if unused:
        what = extension if "background" not in unused else f"{extension} of these channels"
        warn(f"not used for {what}: {', '.join(f'--{name}' for name in unused)}")


def _video(verb: RenderVerb, shot: Shot) -> VideoConfig:
    """Video settings, with the shot's frame rate unless a flag sets another. Raises InputError."""
    from clsplat.images.frame_files import VIDEO_SUFFIXES

    video = verb.video if verb.video.fps is not None or shot.fps is None else replace(verb.video, fps=shot.fps)
    if Path(verb.output).suffix.lower() in VIDEO_SUFFIXES and video is not verb.video:
        try:
            video.check()
        except InputError:
            raise InputError(
                f"{verb.cameras}: has {shot.fps:g} frames a second, expected 0.01 to 1000; give --video.fps"
            ) from None
    return video


def _options(verb: RenderVerb) -> RenderOptions:
    from clsplat.cli.render.holdout import holdout_settings
    from clsplat.cli.render.job import bits_of, for_workers, parse_colour, warp_for_workers
    from clsplat.cli.render.models import check_mattes
    from clsplat.images.frame_files import VIDEO_SUFFIXES, check_format, parse_channels
    from clsplat.images.video import check_codec
    from clsplat.sequence.task import RenderOptions

    pictures = PictureConfig(for_workers(verb.colour), verb.framing, verb.sampling, warp_for_workers(verb.warp))
    pictures.check(whole=False)
    extension = Path(verb.output).suffix.lower()
    video = extension in VIDEO_SUFFIXES
    channels = parse_channels(f"{verb.channels},alpha" if verb.alpha or verb.deep else verb.channels)
    check_format(verb.output, channels, video=True)
    if not 1 <= verb.quality <= 100:
        raise InputError(f"--quality {verb.quality}: expected 1 to 100")
    if "alpha" in channels and verb.background is not None:
        flag = "--deep" if verb.deep else "--alpha" if verb.alpha else "--channels alpha"
        raise InputError(f"{flag} and --background exclude each other: with alpha there is no background")
    verb.pairs.check(distort=verb.warp.distort)
    verb.warp.check(channels)
    check_mattes(channels, verb.ids_from, verb.compression)
    verb.slices.check()
    verb.video.check()
    if verb.deep:
        pictures.check_deep()
        _check_deep(verb, channels)
    elif verb.slices != DeepConfig():
        raise InputError("--deep.bins is for deep EXR, expected --deep with it")
    if video:
        check_codec(verb.output, verb.video, channels)
        _check_video(verb)
    elif verb.video != VideoConfig():
        raise InputError(f"-o {verb.output}: --video flags are for videos, expected the name of an .mp4 or .mov file")
    bits = bits_of(verb.output, verb.bits, channels)
    encoding = Encoding(verb.exr, verb.parts, verb.compression, bits, verb.quality, verb.video.prores)
    colour = parse_colour(verb.background or "black")
    deep = verb.slices if verb.deep else None
    holdout = holdout_settings(verb.holdout, verb.holding, deep=verb.deep)
    return RenderOptions(channels, colour, encoding, pictures=pictures, deep=deep, holdout=holdout)


def _check_deep(verb: RenderVerb, channels: tuple[str, ...]) -> None:
    if Path(verb.output).suffix.lower() != ".exr":
        raise InputError(f"--deep: {verb.output} cannot hold deep samples, expected an .exr file")
    if over := [name for name in channels if name not in ("rgb", "alpha")]:
        raise InputError(f"--deep: cannot hold {', '.join(over)}, only colour, alpha, depths; expected --channels rgb")
    if verb.parts != "one":
        raise InputError("--deep and --parts several exclude each other: a deep file has one part")


def _check_video(verb: RenderVerb) -> None:
    from clsplat.images.video import video_missing

    if reason := video_missing():
        raise InputError(f"{verb.output}: {reason}")


def _devices(verb: RenderVerb) -> tuple[str | None, ...]:
    """Device selectors in --device. Raises InputError."""
    if verb.workers is not None and verb.workers < 1:
        raise InputError(f"--workers {verb.workers}: expected at least 1")
    if verb.workers is not None and verb.scheduler is not None:
        raise InputError("--workers and --scheduler exclude each other: a new cluster here, or one that is there")
    words = [word.strip() for word in verb.device.split(",")] if verb.device else []
    if not words:
        return (None,)
    farm = "--workers" if verb.workers is not None else "--scheduler" if verb.scheduler is not None else None
    if farm and (len(words) > 1 or words == ["all"]):
        raise InputError(f"--device {verb.device} and {farm} exclude each other: a worker has one device")
    if farm:
        return (words[0],)
    if words == ["all"]:
        from clsplat.device.context import list_devices

        words = [str(info.index) for info in list_devices()]
    elif len(words) > 1:
        from clsplat.device.context import find_device

        if len({find_device(word).index for word in words}) < len(words):
            raise InputError(f"--device {verb.device}: names a device twice, expected each once")
    return tuple(words)


def _write_frames(verb: RenderVerb, job: Job, renderers: Sequence[Any]) -> int:
    from clsplat.cli.render.job import check_foreign, frames_there
    from clsplat.sequence import finished_frames, workers
    from clsplat.sequence.frame_claims import Sharing

    tasks, options = job.tasks, job.options
    there = frames_there(job)
    if not (verb.overwrite or job.is_video):
        check_foreign(job, there)
    finished_frames.make_folders(tasks)
    finished_frames.remove_temporaries(tasks)
    left = [task for task in tasks if task.key not in there]
    records: dict[str, Record] = {}
    lines = sys.stdout if not verb.json else sys.stderr if verb.progress in ("json", "openjd") else None
    start = time.monotonic()
    try:
        with (
            FrameProgress(len(tasks), verb.progress, lines=lines) as progress,
            workers.open_video(left, job.video, options) as video,
        ):

            def done(record: Record) -> None:
                records[record.key] = record
                progress(record)

            for task in tasks:
                if task.key in there:
                    done(workers.record_of(task, options, skipped=True))
            if job.on_farm:
                _on_farm(verb, job, left, done, video)
            else:
                shared = job.skip_existing and not job.is_video
                workers.run_tasks(left, renderers, options, done, video, Sharing(options) if shared else None)
    except KeyboardInterrupt as error:
        count = f"{len(records)} of {len(tasks)} frames"
        advice = "nothing is left of the video" if job.is_video else "go on with --skip-existing"
        error.args = (f"after {count}; {advice}",)
        raise
    if blank := [task.key for task in tasks if records[task.key].blank]:
        warn(
            f"{len(blank)} of {len(tasks)} frames show nothing of the model: {examples(blank)}; are the cameras in the "
            "model's world?"
        )
    if verb.profile:
        _print_profile(records.values(), time.monotonic() - start, len(renderers))
    if verb.json:
        print(json.dumps([records[task.key].document() for task in tasks], indent=2))
    return 0


def _on_farm(
    verb: RenderVerb, job: Job, tasks: Sequence[Task], done: Callable[[Record], None], video: VideoWriter | None
) -> None:
    from clsplat.sequence.farm import WorkerJob, render_on_farm

    if verb.profile:
        warn("--profile is not used: it is for devices of this process")
    model, placed = str(job.model.absolute()), job.cast.tracks is not None
    worker_job = WorkerJob(model, job.digest, job.options, job.rasterizer, job.devices[0], job.memory_limit, placed)
    render_on_farm(tasks, worker_job, done, scheduler=verb.scheduler, workers=verb.workers, video=video)


def _print_profile(records: Iterable[Record], wall: float, devices: int) -> None:
    """Print the fraction of the wall time in which the devices worked."""
    kernels, transfers = (
        sum(getattr(record, name) or 0.0 for record in records) / (10 * max(wall, 1e-9) * max(devices, 1))
        for name in ("kernel_ms", "transfer_ms")
    )
    print(f"in {wall:.2f} s the device ran kernels {kernels:.1f} % and transfers {transfers:.1f} %", file=sys.stderr)
