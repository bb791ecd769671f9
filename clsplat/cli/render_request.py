# SPDX-License-Identifier: Apache-2.0
"""Checked meaning of a call of `clsplat render`. Mistakes in the call are found here, before a frame is rendered."""

from __future__ import annotations

import os
from collections.abc import Callable, Collection
from dataclasses import dataclass, fields, replace
from pathlib import Path

import clsplat
from clsplat.camera import Camera
from clsplat.cli.render import Render
from clsplat.cli.session import warn
from clsplat.config.memory import parse_bytes
from clsplat.config.pictures import ColourConfig, DeepConfig, Encoding, PictureConfig, VideoConfig
from clsplat.errors import InputError, examples
from clsplat.files import check_new, digest
from clsplat.frame.samples import finer
from clsplat.gaussians import Gaussians
from clsplat.images.alpha import background_colour
from clsplat.images.colour import CHROMATICITIES, Colours, recorded_space
from clsplat.images.frame_files import VIDEO, check_format, parse_channels
from clsplat.runs.run import model_file
from clsplat.sequence import existing
from clsplat.sequence.task import RenderOptions, Task, digest_of, make_tasks, picture_camera
from clsplat.shots import Shot, choose_shot

_PICTURES = (".png", ".tif", ".tiff")
_USED_BY = {
    **dict.fromkeys(("exr", "parts", "compression"), (".exr",)),
    "bits": _PICTURES,
    "quality": (".jpg", ".jpeg"),
}
"""The files that each of the encoding's flags is for."""


@dataclass(frozen=True)
class Job:
    """A call, read and checked. devices: selectors, None for the usual one; spaces: the model's colour space and that
    of the pictures; video: its encoding, with the rate."""

    verb: Render
    options: RenderOptions
    model: Path
    gaussians: Gaussians
    tasks: list[Task]
    devices: tuple[str | None, ...]
    memory_limit: int | None
    spaces: tuple[str, str]
    video: VideoConfig

    @property
    def digest(self) -> str:
        """SHA-256 of the model file."""
        return str(self.options.attributes["clsplat:model"])

    @property
    def is_video(self) -> bool:
        """True if all frames go into one file."""
        return self.tasks[0].is_video

    @property
    def on_farm(self) -> bool:
        """True if other processes render: workers, or those of a Dask scheduler."""
        return self.verb.workers is not None or self.verb.scheduler is not None


def read_job(verb: Render) -> Job:
    """All that can be checked without rendering. Raises InputError and DeviceError; writes nothing."""
    options = _options(verb)
    verb.rasterizer.check()
    limit = parse_bytes(verb.max_device_mem)
    resize = resizer(verb.width, verb.height, verb.scale)
    devices = _devices(verb)
    size = (verb.width, verb.height)
    whole = choose_shot(verb.cameras, path=verb.path, count=verb.count, size=size, usd_camera=verb.usd_camera)
    chosen = whole if verb.frames is None else whole.only(verb.frames)
    sampling = options.pictures.sampling
    tasks = make_tasks(chosen, whole, verb.output, resize, options.channels, sampling)
    _check_pictures(tasks, options)
    existing.check_folders(tasks)
    if tasks[0].is_video and (tasks[0].path.exists() or tasks[0].path.is_symlink()):
        check_new(tasks[0].path, overwrite=verb.overwrite or verb.dry_run)
    _warn_of_unused(verb, options.channels)
    for text in chosen.warnings:
        warn(text)
    model = model_file(verb.model)
    gaussians = Gaussians.load(model)
    tasks = [task.seen_from(gaussians.near) for task in tasks]
    recorded = recorded_space(model)
    colours = Colours(options.pictures.colour, recorded)
    extension = Path(verb.output).suffix.lower()
    colours.check_file(verb.output, extension, VIDEO)
    if extension == ".exr" and colours.is_linear(colours.output) and colours.output not in CHROMATICITIES:
        warn(f"{verb.output}: the chromaticities of {colours.output} are not known here, and are not in the files")
    attributes = {"Software": f"clsplat {clsplat.__version__}", "clsplat:model": digest(model)}
    attributes["clsplat:colorspace"] = colours.output
    options = replace(options, attributes=attributes, recorded=recorded, drawn=digest_of(verb.rasterizer))
    spaces = (colours.model, colours.output)
    video = _video(verb, whole)
    return Job(verb, options, model, gaussians, tasks, devices, limit, spaces, video)


def frames_there(job: Job) -> set[int]:
    """The numbers of the frames that `--skip-existing` leaves out. Warns of files that do not record the settings they
    were made with."""
    if not job.verb.skip_existing:
        return set()
    there = existing.complete(job.tasks, job.options)
    if unknown := existing.untold([task for task in job.tasks if task.number in there]):
        warn(
            f"--skip-existing: {len(unknown)} of the frames that are there do not say how they were made, such as "
            f"{unknown[0]}: they are kept, whatever their cameras, precision and other settings are"
        )
    return there


def check_foreign(job: Job, there: Collection[int]) -> None:
    """Raise InputError where a frame that is not `there` would replace another program's picture."""
    if job.verb.overwrite or job.is_video:
        return
    if others := existing.foreign([task for task in job.tasks if task.number not in there]):
        raise InputError(
            f"{examples(others)}: there already, and no frames of clsplat; name other files, or give --overwrite to "
            "replace pictures that it did not make"
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
    video = verb.video if verb.video.fps is not None or shot.fps is None else replace(verb.video, fps=shot.fps)
    if Path(verb.output).suffix.lower() == VIDEO and video is not verb.video:
        try:
            video.check()
        except InputError:
            raise InputError(
                f"{verb.cameras}: has {shot.fps:g} frames a second, expected 0.01 to 1000; give --video.fps"
            ) from None
    return video


def _options(verb: Render) -> RenderOptions:
    pictures = PictureConfig(_for_workers(verb.colour), verb.framing, verb.sampling)
    pictures.check()
    video = Path(verb.output).suffix.lower() == VIDEO
    channels = parse_channels(f"{verb.channels},alpha" if verb.alpha or verb.deep else verb.channels)
    check_format(verb.output, channels, video=True)
    if not 1 <= verb.quality <= 100:
        raise InputError(f"--quality {verb.quality}: expected 1 to 100")
    if "alpha" in channels and verb.background is not None:
        flag = "--deep" if verb.deep else "--alpha" if verb.alpha else "--channels alpha"
        raise InputError(f"{flag} and --background exclude each other: with alpha there is no background")
    verb.slices.check()
    verb.video.check()
    if verb.deep:
        pictures.check_deep()
        _check_deep(verb, channels)
    elif verb.slices != DeepConfig():
        raise InputError("--deep.bins, --deep.near and --deep.far are of deep EXR, expected --deep with them")
    if video:
        _check_video(verb)
    elif verb.video != VideoConfig():
        raise InputError(f"-o {verb.output}: --video flags are of videos, expected the name of an {VIDEO} file")
    encoding = Encoding(verb.exr, verb.parts, verb.compression, verb.bits, verb.quality)
    colour = parse_colour(verb.background or "black")
    return RenderOptions(channels, colour, encoding, pictures=pictures, deep=verb.slices if verb.deep else None)


def _for_workers(colour: ColourConfig) -> ColourConfig:
    """The colour settings with the absolute path of the OCIO configuration, for processes in other folders."""
    source = colour.ocio_config or os.environ.get("OCIO", "")
    if source and "://" not in source:
        source = str(Path(source).absolute())
    return replace(colour, ocio_config=source)


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
    if verb.skip_existing:
        raise InputError(
            "--skip-existing: a video is written as a whole; leave the flag out, or write a picture for each frame"
        )


def _check_pictures(tasks: list[Task], options: RenderOptions) -> None:
    """Raise InputError for a frame that the framing does not suit, and for a video of several sizes."""
    sizes = set()
    for task in tasks:
        camera = picture_camera(task, options)
        if options.pictures.framing.supersample > 1:
            finer(camera, options.pictures.framing)
        sizes.add(f"{camera.width}x{camera.height}")
    if tasks[0].is_video and len(sizes) > 1:
        raise InputError(
            f"{tasks[0].path}: frames are of the sizes {examples(sorted(sizes))}, expected one; give --width and "
            "--height"
        )
    if tasks[0].is_video:
        from clsplat.images.video import check_size

        check_size(tasks[0].path, camera.width, camera.height)


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


def parse_colour(text: str) -> tuple[float, float, float]:
    """black, white or three numbers from 0 to 1. Raises InputError."""
    if text in ("black", "white"):
        return background_colour(text)
    try:
        red, green, blue = (float(word) for word in text.split(","))
    except ValueError:
        red = green = blue = -1.0
    if not (0 <= red <= 1 and 0 <= green <= 1 and 0 <= blue <= 1):
        raise InputError(f"--background {text}: expected black, white or three numbers from 0 to 1 such as 0.2,0.2,0.3")
    return red, green, blue


def resizer(width: int | None, height: int | None, scale: float) -> Callable[[Camera], Camera]:
    """A camera's size after --width, --height and --scale. Raises InputError for sizes that make no sense."""
    for flag, value in (("--width", width), ("--height", height), ("--scale", scale)):
        if value is not None and not 0 < value < float("inf"):
            raise InputError(f"{flag} {value}: expected a number above 0")
    if scale != 1 and (width or height):
        raise InputError("--scale and --width or --height exclude each other")

    def resize(camera: Camera) -> Camera:
        across, down = width, height
        if across is None:
            across = round(camera.width * (down / camera.height if down else scale))
        if down is None:
            down = round(camera.height * (across / camera.width if width else scale))
        return reshaped(camera, max(1, across), max(1, down))

    return resize


def reshaped(camera: Camera, width: int, height: int) -> Camera:
    """The camera in another size. In another shape, even if only by rounding, it keeps the vertical angle of view and
    the pixels' proportions: the picture shows more or less to the left and right. So all sizes of one shape show the
    same. A panorama shows all around in any shape."""
    if (width, height) == (camera.width, camera.height):
        return camera
    if width * camera.height == height * camera.width or camera.projection == "equirectangular":
        return camera.resized(width, height)
    scale = height / camera.height
    middle = 0.5 * width + (camera.cx - 0.5 * camera.width) * scale
    fx, fy, cy = camera.fx * scale, camera.fy * scale, camera.cy * scale
    return replace(camera, width=width, height=height, fx=fx, fy=fy, cx=middle, cy=cy)
