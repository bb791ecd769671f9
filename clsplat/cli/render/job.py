# SPDX-License-Identifier: Apache-2.0
"""Job of `clsplat render`, and the checks that need the job rather than the flags alone."""

from __future__ import annotations

import os
from collections.abc import Callable, Collection, Mapping
from dataclasses import dataclass, field, replace
from pathlib import Path

import numpy as np

from clsplat.camera import Camera, Window
from clsplat.config.pictures import ColourConfig, VideoConfig, WarpConfig
from clsplat.config.rasterizer import RasterizerConfig
from clsplat.errors import InputError, examples, warn
from clsplat.files.documents import is_file
from clsplat.frame.lens import ByMap
from clsplat.frame.mattes import Matte
from clsplat.frame.samples import finer
from clsplat.images.alpha import background_colour
from clsplat.images.colour import CHROMATICITIES, Colours
from clsplat.images.frame_files import VIDEO_SUFFIXES
from clsplat.images.video import video_record
from clsplat.sequence import finished_frames
from clsplat.sequence.job_models import JobModels
from clsplat.sequence.mattes import names_of
from clsplat.sequence.task import RenderOptions, Task, picture_camera, warp_of
from clsplat.version import package_version


@dataclass(frozen=True)
class Job:
    """Call of `clsplat render`, parsed and checked.

    devices: selector of each device; None for the default device.
    spaces: colour space of the model and of the pictures.
    video: encoding of the video, with its frame rate; None for pictures.
    on_farm: True if other processes render: workers on this machine, or a Dask cluster.
    """

    options: RenderOptions
    rasterizer: RasterizerConfig
    cast: JobModels
    tasks: list[Task]
    devices: tuple[str | None, ...]
    memory_limit: int | None
    spaces: tuple[str, str]
    video: VideoConfig
    on_farm: bool
    skip_existing: bool
    mattes: Mapping[str, Matte] = field(default_factory=dict)

    @property
    def model(self) -> Path:
        """The file that names the models, or the file of a single model."""
        return self.cast.path

    @property
    def digest(self) -> str:
        """SHA-256 of the models (`JobModels.digest`)."""
        return str(self.options.attributes["clsplat:model"])

    @property
    def is_video(self) -> bool:
        """True if all frames go into one file."""
        return self.tasks[0].is_video


def frames_there(job: Job) -> set[str]:
    """Keys of the frames that `--skip-existing` leaves out.

    Warns if files do not record their settings, and if existing frames have to be rendered again.
    """
    if not job.skip_existing:
        return set()
    if job.is_video:
        return _video_there(job)
    there = finished_frames.complete(job.tasks, job.options)
    if unknown := finished_frames.untold([task for task in job.tasks if task.key in there]):
        warn(
            f"--skip-existing: {len(unknown)} of the frames that are there do not say how they were made, such as "
            f"{unknown[0]}: they are kept, whatever their cameras, precision and other settings are"
        )
    if changed := finished_frames.changed([task for task in job.tasks if task.key not in there], job.options):
        warn(
            f"--skip-existing: {len(changed)} of the frames that are there were made of another model, or with other "
            f"cameras or settings, such as {changed[0]}: they are rendered again"
        )
    return there


def _video_there(job: Job) -> set[str]:
    """Keys of all frames, or of none: a video is complete only as a whole."""
    path, wanted = job.tasks[0].path, finished_frames.made_of(job.tasks, job.options, job.video)
    if is_file(path) and video_record(path, len(job.tasks)) == wanted:
        return {task.key for task in job.tasks}
    if is_file(path):
        warn(
            f"--skip-existing: {path} is not whole, or was made of another model or frames, or with other cameras or "
            "settings: it is rendered again"
        )
    return set()


def is_ours(path: Path) -> bool:
    """True if clsplat made the video, according to its header."""
    return is_file(path) and bool(video_record(path))


def check_foreign(job: Job, there: Collection[str]) -> None:
    """Raise InputError if a frame that is not in `there` would replace a picture made by another program."""
    if others := finished_frames.foreign([task for task in job.tasks if task.key not in there]):
        raise InputError(
            f"{examples(others)}: exist, and clsplat did not make them; name other files, or give --overwrite to "
            "replace them"
        )


def for_workers(colour: ColourConfig) -> ColourConfig:
    """Colour settings with the absolute path of the OCIO configuration, for processes in other folders."""
    source = colour.ocio_config or os.environ.get("OCIO", "")
    if source and "://" not in source:
        source = str(Path(source).absolute())
    return replace(colour, ocio_config=source)


def bits_of(path: str, bits: int | None, channels: Collection[str]) -> int:
    """Bits per channel for files of that name, from --bits. Raises InputError if the format does not support them."""
    extension = Path(path).suffix.lower()
    if extension == ".dpx" and bits == 8:
        raise InputError(f"--bits 8: {path} has 10 or 16 bits, expected one of them")
    if extension != ".dpx" and bits == 10:
        raise InputError(f"--bits 10: is for DPX, expected 8 or 16 for {path}")
    chosen = bits or (10 if extension == ".dpx" else 8)
    if extension == ".dpx" and chosen == 10 and "alpha" in channels:
        raise InputError(f"{path}: a DPX of 10 bits is written without alpha here, expected --bits 16 with it")
    return chosen


def warp_for_workers(warp: WarpConfig) -> WarpConfig:
    """Lens settings with the absolute path of the map, for processes in other folders."""
    return replace(warp, stmap=str(Path(warp.stmap).absolute())) if warp.stmap else warp


def check_pictures(tasks: list[Task], options: RenderOptions) -> None:
    """Check all pictures before rendering.

    Raises InputError in these cases: the framing does not suit a frame, a video has frames of several sizes, deep
    stereo pairs are in one file, or two eyes cannot share a file.
    """
    if options.deep is not None and tasks[0].right is not None:
        raise InputError(f"--deep: {tasks[0].path} would hold both eyes, expected a file for each: {{eye}} in -o")
    sizes = set()
    check_warps(tasks, options)
    for task in tasks:
        cameras = [picture_camera(view, options.pictures) for view in task.views]
        for camera in cameras:
            if options.pictures.framing.supersample > 1:
                finer(camera, options.pictures.framing)
            sizes.add(f"{camera.width}x{camera.height}")
        if len(cameras) > 1:
            _check_pair(task, *cameras)
    if tasks[0].is_video and len(sizes) > 1:
        raise InputError(
            f"{tasks[0].path}: frames are of the sizes {examples(sorted(sizes))}, expected one; give --width and "
            "--height"
        )
    if tasks[0].is_video:
        from clsplat.images.video import check_size

        check_size(tasks[0].path, camera.width, camera.height)


def _check_pair(task: Task, left: Camera, right: Camera) -> None:
    """Raise InputError for eyes that differ in window size or pixel shape: an EXR file has one for all parts."""
    advice = f"{task.path} holds both eyes, expected them alike, or a file for each: {{eye}} in -o"
    sizes = [f"{frame.width}x{frame.height}" for frame in (left.window or left, right.window or right)]
    if sizes[0] != sizes[1]:
        what = f"is {sizes[0]} for the left eye and {sizes[1]}"
        raise InputError(f"--stereo: frame {task.number} {what} for the right; {advice}")
    # compared with the precision of the headers of frames from a stage
    shapes = [str(np.float32(eye.fy / eye.fx)) for eye in (left, right)]
    if task.optics is not None and shapes[0] != shapes[1]:
        what = f"has pixels of the aspect ratio {shapes[0]} for the left eye and {shapes[1]}"
        raise InputError(f"--stereo: frame {task.number} {what} for the right; {advice}")


def check_warps(tasks: list[Task], options: RenderOptions) -> None:
    """Raise InputError for panoramas, which cannot be distorted, and for a map that does not cover the picture.

    Warns if a part of the picture stays empty.
    """
    flag = f"--stmap {options.pictures.warp.stmap}" if options.pictures.warp.stmap else "--distort"
    empty: dict[int, float] = {}
    for task in (view for whole in tasks for view in whole.views):
        if (warp := warp_of(task, options.pictures)) is None:
            continue
        if task.camera.model.wraps:
            raise InputError(f"{flag}: frame {task.number} is a panorama, expected a picture with edges")
        if isinstance(warp.source, ByMap):
            camera, stmap = picture_camera(task, options.pictures), warp.source.stmap
            window = camera.window or Window(0, 0, camera.width, camera.height)
            if not stmap.covers(window.x, window.y, camera.width, camera.height):
                raise InputError(
                    f"{flag}: has values for {stmap.values.shape[1]}x{stmap.values.shape[0]} pixels from {stmap.x},"
                    f"{stmap.y} on, expected all of the picture; leave --overscan out, or write a larger data window"
                )
        if (part := warp.empty) > 0:
            empty[task.number] = max(part, empty.get(task.number, 0.0))
    if empty:
        number, part = max(empty.items(), key=lambda item: item[1])
        advice = "" if options.pictures.warp.stmap else "; --lenses native renders fisheyes without a straight picture"
        warn(
            f"{flag}: {100 * part:.0f} % of frame {number} have no place in the straight picture, or one more than a "
            f"frame beyond its edges; they stay black and transparent{advice}"
        )


def check_colours(output: str, colours: Colours) -> None:
    """Raise InputError for files that cannot hold the colours. Warns if they do not record the chromaticities."""
    extension = Path(output).suffix.lower()
    colours.check_file(output, extension, VIDEO_SUFFIXES)
    if extension == ".exr" and colours.is_linear(colours.output) and colours.output not in CHROMATICITIES:
        warn(f"{output}: the chromaticities of {colours.output} are not known here, and are not in the files")


def with_models(options: RenderOptions, cast: JobModels, mattes: Mapping[str, Matte], space: str) -> RenderOptions:
    """The options with the models' colour space, digest and mattes.

    space: colour space of the pictures.
    """
    attributes = {
        "Software": f"clsplat {package_version()}",
        "clsplat:model": cast.digest,
        "clsplat:colorspace": space,
    }
    return replace(options, attributes=attributes, recorded=cast.space, mattes=names_of(mattes))


def parse_colour(text: str) -> tuple[float, float, float]:
    """Parse black, white or three numbers from 0 to 1. Raises InputError."""
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
    """Function that resizes a camera by --width, --height and --scale. Raises InputError for impossible sizes."""
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
        return camera.reshaped(max(1, across), max(1, down))

    return resize
