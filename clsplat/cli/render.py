# SPDX-License-Identifier: Apache-2.0
"""`clsplat render`: its flags, and a job from the call to the exit status.

The job is a `clsplat.cli.render_job.Job`, --dry-run is in `clsplat.cli.render_plan`, the job's loop in
`clsplat.sequence.workers`, one frame in `clsplat.sequence.frame_renderer`, clusters in `clsplat.sequence.farm`.
"""

from __future__ import annotations

import json
import sys
import time
from collections.abc import Callable, Collection, Iterable, Sequence
from dataclasses import dataclass, field, fields, replace
from pathlib import Path
from typing import TYPE_CHECKING, Annotated, Any, Literal

from tyro.conf import arg

from clsplat.cli.options import Flag, Memory, OptionalInt, RunOrModel, Verb, with_given
from clsplat.cli.render_help import RENDER_GROUPS
from clsplat.cli.session import Services
from clsplat.config.checks import parse_bytes
from clsplat.config.holdout import HoldoutConfig
from clsplat.config.pictures import (
    EXR_DEPTH,
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
from clsplat.config.presets import PRESETS, Preset
from clsplat.config.rasterizer import RasterizerConfig
from clsplat.config.stereo import StereoConfig
from clsplat.config.training import Lenses
from clsplat.errors import InputError, examples, warn
from clsplat.files import check_new
from clsplat.process import terminable
from clsplat.progress import FrameProgress

if TYPE_CHECKING:
    from clsplat.cli.render_job import Job
    from clsplat.images.video import VideoWriter
    from clsplat.sequence.cast import Cast
    from clsplat.sequence.task import Record, RenderOptions, Task
    from clsplat.shots import Shot


_PICTURES = (".png", ".tif", ".tiff", ".dpx")
_USED_BY = {
    **dict.fromkeys(("exr", "parts", "compression"), (".exr",)),
    "bits": _PICTURES,
    "quality": (".jpg", ".jpeg"),
}
"""The files that each of the encoding's flags is for."""


@dataclass(frozen=True)
class Render(Verb):
    """Render a model from the cameras of a file or along a path made from them, an image for each frame."""

    groups = RENDER_GROUPS
    model: RunOrModel
    """A run's folder or a model file; a file a frame of a model that changes ('capture.####.ply'); or a shot of several
    models (.json), or a USD stage that places some. docs/shot.md describes them."""
    output: Annotated[str, arg(aliases=("-o",), metavar="PATTERN")]
    """File names of the images, such as 'out/{name}.png' or 'shot/beauty.####.exr': EXR, PNG, TIFF, JPEG or DPX; or the
    name of a video of all frames, turn.mp4 or, in ProRes, turn.mov. {name} is the image's name without its extension,
    sub-folders included, or else the frame's number; ####, %04d and {frame} are the frame's number; {eye} and %V left
    or right."""
    cameras: Annotated[Path | None, arg(metavar="PATH")] = None
    """Folder of a COLMAP model (cameras and images, bin or txt), or of a scene that holds one; a transforms.json, a
    nerfstudio camera_path.json, a cameras.json of 3DGS, a clsplat camera file (.json) or a USD stage. docs/cameras.md
    describes each. Not needed with --path turntable or spiral."""
    transform: Annotated[str | None, arg(metavar="FILE|STEPS|M00,M01,...")] = None
    """Place the model by a 4 x 4 matrix of rotation, one scale and translation: 16 numbers row by row, a file of them,
    steps in their order such as 'rotate=0,90,0 scale=2 translate=1,0,0', or a JSON file with key frames or a matrix a
    frame (docs/shot.md)."""
    path: Annotated[Literal["turntable", "spiral", "through"] | None, arg(metavar="turntable|spiral|through")] = None
    """A path made from the cameras, in place of the cameras themselves: around what they look at, the same twice while
    rising and sinking, or through them in their order, smoothed. Its frames count from 1. Without --cameras it is made
    from those of a run's photographs; it goes around a model alone, or what a scene has most detail of."""
    up: Annotated[str | None, arg(metavar="AXIS|X,Y,Z")] = None
    """Direction that is up on a path around a model, without --cameras: x, y, z, -x, -y, -z or three numbers; -y if not
    given, as in a COLMAP scene. With it the path goes around a run's model too. Write --up=-z if it begins with a
    minus."""
    count: OptionalInt = None
    """Frames of the path; 120 if not given."""
    frames: Annotated[str | None, arg(metavar="1-100,200-300:2,...")] = None
    """Render these frames only; all if not given. Ranges may have a step. Write --frames=-5-10 if it begins with a
    negative number."""
    usd_camera: Annotated[str | None, arg(metavar="PRIM")] = None
    """Path or name of the camera, for a USD stage that has several."""
    lenses: Annotated[Lenses | None, arg(metavar="undistort|native")] = None
    """Photographs' cameras that are fisheyes: undistort, as the pinhole cameras that they hold; native, through their
    own lens. If not given: as the run was trained, but for --path, which is of pinhole cameras, else undistort."""
    channels: Annotated[str, arg(metavar="NAME,...")] = "rgb"
    """Channels of the files: rgb, alpha, and in EXR depth, median and first (depths), normals, position, motion (to
    the next frame), backward (to the one before), count and id (of Gaussians), objects and semantic (Cryptomattes).
    docs/render.md has each."""
    ids_from: Annotated[str | None, arg(metavar="PROPERTY")] = None
    """Property of the models' PLY files that holds a whole number for each Gaussian, for --channels semantic."""
    background: Annotated[str | None, arg(metavar="black|white|R,G,B")] = None
    """Colour behind the Gaussians, the numbers from 0 to 1; black if not given."""
    appearance: Annotated[str | None, arg(metavar="PHOTO")] = None
    """Give the model exposure and colours of this photograph of its scene, by the run's appearance.json, not its lens's
    vignette; if not given, those that all have on average. The background is taken as it is."""
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
    bits: Annotated[Literal[8, 10, 16] | None, arg(metavar="8|10|16")] = None
    """Bits of each channel: 8 or 16 in PNG and TIFF files, 8 if not given; 10 or 16 in DPX files, 10 if not given."""
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
    warp: Annotated[WarpConfig, arg(name="")] = field(default_factory=WarpConfig)
    pairs: Annotated[StereoConfig, arg(name="")] = field(default_factory=StereoConfig)
    deep: Flag = False
    """Write deep EXR: of each pixel colour, alpha and depth in slices of the scene. docs/pictures.md has how."""
    slices: Annotated[DeepConfig, arg(name="deep")] = field(default_factory=DeepConfig)
    holdout: Annotated[str | None, arg(metavar="PATTERN")] = None
    """Depth EXR or deep EXR of other elements, such as 'cg/depth.####.exr': what is behind their surfaces is left out
    of every channel. docs/pictures.md has how."""
    holding: Annotated[HoldoutConfig, arg(name="holdout")] = field(default_factory=HoldoutConfig)
    video: VideoConfig = field(default_factory=VideoConfig)
    preset: Annotated[Preset | None, arg(metavar="exact|default|fast")] = None
    """Bundle of rasterizer settings: exact and default approximate nothing, fast does a little. A --rasterizer flag
    overrides it. If not given: the run's own settings, else default."""
    overwrite: Flag = False
    """Replace a video that is there, and pictures that clsplat did not make. Frames of its own are replaced without it,
    but for --skip-existing."""
    skip_existing: Flag = False
    """Leave out frames whose file is there and can be read to its end, of this size, these channels, this model and,
    as far as it says so, made with these cameras and settings."""
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
        """The rasterizer's settings are those of the preset, or else of the run, as are the lenses."""
        from clsplat.models.formats import model_path
        from clsplat.runs.run import Run, is_run

        if "lenses" in given and self.cameras is None:
            raise InputError(f"--lenses {self.lenses}: is of the cameras of photographs, expected --cameras with it")
        if self.lenses is not None and self.warp.distort:
            raise InputError(f"--lenses {self.lenses} and --distort exclude each other: that bends as photographs are")
        bundle, lenses = PRESETS["default"], self.lenses or "undistort"
        if self.model.is_dir() and (is_run(self.model) or model_path(self.model) == self.model):
            config = Run.open(self.model).config  # refuses a folder that is neither run nor model
            bundle, lenses = config.rasterizer, self.lenses or ("undistort" if self.path else config.lenses)
        if self.preset is not None:
            bundle = PRESETS[self.preset]
        return replace(self, rasterizer=with_given(bundle, self.rasterizer, given, "rasterizer."), lenses=lenses)


def run(verb: Render, services: Services) -> int:
    """Model and cameras to images."""
    job = _read_job(verb)
    if verb.dry_run:
        from clsplat.cli.render_plan import dry_run

        return dry_run(job, as_json=verb.json)
    renderers = []
    if not job.on_farm:
        how: dict[str, Any] = {"memory_limit": job.memory_limit, "profile": verb.profile}
        how |= {"mattes": job.mattes} if job.mattes else {}
        model = (job.cast.drawn, job.options, job.rasterizer)
        renderers = [services.open_frame_renderer(*model, device=selector, **how) for selector in job.devices]
        for renderer in renderers:
            renderer.check(job.tasks)
    with terminable():  # again, as pycolmap and compilers of kernels install handlers of their own
        return _write_frames(verb, job, renderers)


def _read_job(verb: Render) -> Job:
    """All that can be checked without rendering. Raises InputError and DeviceError; writes nothing."""
    import clsplat
    from clsplat.cli.render_eyes import Asked, shots_asked
    from clsplat.cli.render_job import Job, check_pictures, is_ours, resizer
    from clsplat.cli.render_models import read_cast
    from clsplat.cli.render_stage import with_stage
    from clsplat.images.colour import CHROMATICITIES, Colours
    from clsplat.images.frame_files import VIDEOS
    from clsplat.runs.appearance import gains_of
    from clsplat.runs.run import run_of
    from clsplat.runs.scene_record import own_cameras
    from clsplat.sequence import existing
    from clsplat.sequence.holdouts import held_out
    from clsplat.sequence.mattes import mattes_of, names_of
    from clsplat.sequence.pairs import make_views
    from clsplat.sequence.task import digest_of
    from clsplat.shots import check_around

    own = own_cameras(run_of(verb.model)) if verb.cameras is None and not verb.transform else []
    if verb.cameras is None:
        check_around(verb.path, among_own=bool(own) and verb.up is None)
    options = _options(verb)
    verb.rasterizer.check()
    limit = parse_bytes(verb.max_device_mem)
    resize = resizer(verb.width, verb.height, verb.scale)
    devices = _devices(verb)

    def cast_of() -> Cast:
        return read_cast(verb.model, verb.transform, verb.appearance)

    source = (verb.cameras, verb.path, verb.count, (verb.width, verb.height), verb.usd_camera)
    asked = Asked(*source, verb.lenses or "undistort", verb.warp.distort, verb.up, cast_of, own)
    shots, cast = shots_asked(asked, verb.pairs)
    if all(len(shot.frames) == 1 for shot in shots.values()):
        cast = cast_of() if cast is None else cast  # a camera stands still before a model that changes
        shots = {eye: shot.standing(cast.frames) for eye, shot in shots.items()}
    if verb.deep:
        shots = {eye: shot.without_optics() for eye, shot in shots.items()}
    sampling = options.pictures.sampling
    tasks, chosen = make_views(shots, verb.frames, verb.output, resize, options.channels, sampling=sampling)
    options, unapplied = with_stage(options, verb.cameras, chosen, tasks)
    check_pictures(tasks, options)
    if verb.holdout is not None:
        tasks = held_out(tasks, verb.holdout, verb.holding)
    existing.check_folders(tasks)
    if tasks[0].is_video and (tasks[0].path.exists() or tasks[0].path.is_symlink()):
        ours = verb.skip_existing and is_ours(tasks[0].path)
        check_new(tasks[0].path, overwrite=verb.overwrite or verb.dry_run or ours)
    _warn_of_unused(verb, options.channels)
    for text in chosen.told(verb.cameras, *unapplied):
        warn(text)
    cast = cast_of() if cast is None else cast
    gains = gains_of(verb.model, verb.appearance) if verb.appearance is not None else ()
    tasks, mattes = cast.seen(tasks, options), mattes_of(cast, options.channels, verb.ids_from or "")
    recorded = cast.space
    colours = Colours(options.pictures.colour, recorded)
    extension = Path(verb.output).suffix.lower()
    colours.check_file(verb.output, extension, VIDEOS)
    if extension == ".exr" and colours.is_linear(colours.output) and colours.output not in CHROMATICITIES:
        warn(f"{verb.output}: the chromaticities of {colours.output} are not known here, and are not in the files")
    attributes = {"Software": f"clsplat {clsplat.__version__}", "clsplat:model": cast.digest}
    attributes["clsplat:colorspace"] = colours.output
    options = replace(options, attributes=attributes, recorded=recorded, drawn=digest_of(verb.rasterizer), gains=gains)
    options = replace(options, mattes=names_of(mattes), ids_from=verb.ids_from or "")
    spaces = (colours.model, colours.output)
    video = _video(verb, chosen)
    on_farm = verb.workers is not None or verb.scheduler is not None
    return Job(
        options, verb.rasterizer, cast, tasks, devices, limit, spaces, video, on_farm, verb.skip_existing, mattes
    )


def _warn_of_unused(verb: Render, channels: Collection[str]) -> None:
    """Warn of flags that the files have no use for."""
    extension, defaults = Path(verb.output).suffix.lower(), {field.name: field.default for field in fields(Render)}
    unused = [
        name
        for name, extensions in _USED_BY.items()
        if extension not in extensions and getattr(verb, name) != defaults[name] and not (name == "exr" and verb.deep)
    ]
    if "rgb" not in channels and verb.background is not None:
        unused.append("background")
    if unused:
        what = extension if "background" not in unused else f"{extension} of these channels"
        warn(f"not used for {what}: {', '.join(f'--{name}' for name in unused)}")


def _video(verb: Render, shot: Shot) -> VideoConfig:
    """The video's settings, with the rate of the shot where no other is asked for. Raises InputError."""
    from clsplat.images.frame_files import VIDEOS

    video = verb.video if verb.video.fps is not None or shot.fps is None else replace(verb.video, fps=shot.fps)
    if Path(verb.output).suffix.lower() in VIDEOS and video is not verb.video:
        try:
            video.check()
        except InputError:
            raise InputError(
                f"{verb.cameras}: has {shot.fps:g} frames a second, expected 0.01 to 1000; give --video.fps"
            ) from None
    return video


def _options(verb: Render) -> RenderOptions:
    from clsplat.cli.render_holdout import holdout_settings
    from clsplat.cli.render_job import bits_of, for_workers, parse_colour, warp_for_workers
    from clsplat.cli.render_models import check_mattes
    from clsplat.images.frame_files import VIDEOS, check_format, parse_channels
    from clsplat.images.video import check_codec
    from clsplat.sequence.task import RenderOptions

    pictures = PictureConfig(for_workers(verb.colour), verb.framing, verb.sampling, warp_for_workers(verb.warp))
    pictures.check(whole=False)
    extension = Path(verb.output).suffix.lower()
    video = extension in VIDEOS
    channels = parse_channels(f"{verb.channels},alpha" if verb.alpha or verb.deep else verb.channels)
    check_format(verb.output, channels, video=True)
    if not 1 <= verb.quality <= 100:
        raise InputError(f"--quality {verb.quality}: expected 1 to 100")
    if "alpha" in channels and verb.background is not None:
        flag = "--deep" if verb.deep else "--alpha" if verb.alpha else "--channels alpha"
        raise InputError(f"{flag} and --background exclude each other: with alpha there is no background")
    verb.pairs.check(distort=verb.warp.distort)
    verb.warp.check(channels, deep=verb.deep)
    check_mattes(channels, verb.ids_from, verb.compression)
    verb.slices.check()
    verb.video.check()
    if verb.deep:
        pictures.check_deep()
        _check_deep(verb, channels)
    elif verb.slices != DeepConfig():
        raise InputError("--deep.bins is of deep EXR, expected --deep with it")
    if video:
        check_codec(verb.output, verb.video, channels)
        _check_video(verb)
    elif verb.video != VideoConfig():
        raise InputError(f"-o {verb.output}: --video flags are of videos, expected the name of an .mp4 or .mov file")
    bits = bits_of(verb.output, verb.bits, channels)
    encoding = Encoding(verb.exr, verb.parts, verb.compression, bits, verb.quality, verb.video.prores)
    colour = parse_colour(verb.background or "black")
    deep = verb.slices if verb.deep else None
    holdout = holdout_settings(verb.holdout, verb.holding, deep=verb.deep)
    return RenderOptions(channels, colour, encoding, pictures=pictures, deep=deep, holdout=holdout)


def _check_deep(verb: Render, channels: tuple[str, ...]) -> None:
    if Path(verb.output).suffix.lower() != ".exr":
        raise InputError(f"--deep: {verb.output} cannot hold deep samples, expected an .exr file")
    if over := [name for name in channels if name not in ("rgb", "alpha")]:
        raise InputError(f"--deep: has no {', '.join(over)} beside colour, alpha and depths, expected --channels rgb")
    if verb.parts != "one":
        raise InputError("--deep and --parts several exclude each other: a deep file has one part")


def _check_video(verb: Render) -> None:
    from clsplat.images.video import video_missing

    if reason := video_missing():
        raise InputError(f"{verb.output}: {reason}")


def _devices(verb: Render) -> tuple[str | None, ...]:
    """The selectors in --device."""
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


def _write_frames(verb: Render, job: Job, renderers: Sequence[Any]) -> int:
    from clsplat.cli.render_job import check_foreign, frames_there
    from clsplat.sequence import existing, workers
    from clsplat.sequence.sharing import Sharing

    tasks, options = job.tasks, job.options
    there = frames_there(job)
    if not (verb.overwrite or job.is_video):
        check_foreign(job, there)
    existing.make_folders(tasks)
    existing.remove_temporaries(tasks)
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
    verb: Render, job: Job, tasks: Sequence[Task], done: Callable[[Record], None], video: VideoWriter | None
) -> None:
    from clsplat.sequence.farm import WorkerJob, render_on_farm

    if verb.profile:
        warn("--profile is not used: it is for devices of this process")
    model, placed = str(job.model.absolute()), job.cast.tracks is not None
    worker_job = WorkerJob(model, job.digest, job.options, job.rasterizer, job.devices[0], job.memory_limit, placed)
    render_on_farm(tasks, worker_job, done, scheduler=verb.scheduler, workers=verb.workers, video=video)


def _print_profile(records: Iterable[Record], wall: float, devices: int) -> None:
    """Print the share of the wall time in which the devices were at work."""
    kernels, transfers = (
        sum(getattr(record, name) or 0.0 for record in records) / (10 * max(wall, 1e-9) * max(devices, 1))
        for name in ("kernel_ms", "transfer_ms")
    )
    print(f"in {wall:.2f} s the device ran kernels {kernels:.1f} % and transfers {transfers:.1f} %", file=sys.stderr)
