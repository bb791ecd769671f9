# SPDX-License-Identifier: Apache-2.0
"""Frames of a shot as render tasks, and the options that all tasks of a job share."""

from __future__ import annotations

import hashlib
import json
from collections.abc import Collection, Mapping
from dataclasses import MISSING, asdict, dataclass, field, fields, is_dataclass, replace
from math import inf
from pathlib import Path
from typing import Any

import numpy as np

from clsplat.camera import DEFAULT_NEAR_PLANE, JACOBIAN_CLAMP_HALF_FRAMES, Camera
from clsplat.config.channels import WRITABLE_CHANNELS
from clsplat.config.pictures import (
    VIDEO_SUFFIXES,
    DeepConfig,
    Encoding,
    FramingConfig,
    HoldoutConfig,
    PictureConfig,
    SamplingConfig,
    parse_overscan,
    parse_region,
)
from clsplat.errors import InputError
from clsplat.files.documents import known_digest
from clsplat.frame.lens import ByLens, ByMap, Places, Warp
from clsplat.gaussians import Gaussians
from clsplat.images.colour import CHROMATICITIES, COLOR_INTEROP_IDS, SRGB, configuration_digest
from clsplat.images.cryptomatte import header_of
from clsplat.images.frame_files import (
    SETTINGS_DIGEST_ATTRIBUTE,
    FrameFileHeader,
    camera_matrices,
    is_whole_panorama,
)
from clsplat.images.stmap import read_stmap
from clsplat.models.instances import State
from clsplat.scenes.dataset import Lens
from clsplat.shots import Shot
from clsplat.shots.motion import Moments
from clsplat.shots.optics import Optics, headers

LATLONG_ATTRIBUTES: dict[str, str | int] = {"textureformat": "LatLong Environment", "openexr:levelmode": 0}
"""Attributes with which OpenImageIO marks an EXR file as a panorama (envmap). Level mode 0 is a file without mipmap
levels: otherwise OpenImageIO would keep the file open for more levels."""
_ENCODING_FIELDS_BY_SUFFIX = {
    ".exr": ("depth", "parts", "compression"),
    **dict.fromkeys((".png", ".tif", ".tiff", ".dpx"), ("bits",)),
    **dict.fromkeys((".jpg", ".jpeg"), ("quality",)),
    ".mov": ("prores",),
}
"""For each extension, the encoding settings that change such a file."""


def key_of(number: int, eye: str) -> str:
    """Return the key of a frame in its job: its number, and its eye if the eyes have separate files."""
    return f"{number} {eye}" if eye else str(number)


@dataclass(frozen=True)
class Measured:
    """Values that are measured while a frame is rendered.

    blank: True if nothing of the model is visible; None if this was not checked.
    kernel_ms, transfer_ms: times of kernels and transfers on the device; None without profiling.
    """

    blank: bool | None = None
    kernel_ms: float | None = None
    transfer_ms: float | None = None


NOT_MEASURED = Measured()


@dataclass(frozen=True)
class Record:
    """Record of a finished frame.

    seconds: time for rendering and writing, without waiting.
    skipped: True if the file existed already.
    eye: left or right if the eyes of a stereo pair have separate files, otherwise None.
    blank, kernel_ms, transfer_ms: as in `Measured`.
    """

    name: str
    frame: int
    path: str
    width: int
    height: int
    seconds: float
    eye: str | None = None
    skipped: bool = False
    blank: bool | None = None
    kernel_ms: float | None = None
    transfer_ms: float | None = None

    @property
    def key(self) -> str:
        """Key of the frame in its job."""
        return key_of(self.frame, self.eye or "")

    def document(self) -> dict[str, Any]:
        """Return the record as a JSON object, without values that were not measured."""
        return {name: value for name, value in asdict(self).items() if value is not None}


@dataclass(frozen=True, eq=False)
class Task:
    """A frame to be rendered.

    number, name: as in `shots.Frame`.
    camera: camera of the whole frame, in its final size.
    path: path of the file to write.
    after, earlier: cameras of the next and the previous frame, for motion channels, of the same size; None if
        these channels are not requested.
    stretch: cameras by time while the shutter is open; None for a static camera.
    before: state of the file when the job began, by `finished_frames.stamp`.
    sampling: shutter and lens of this frame; None uses the job's settings.
    optics: shutter and lens in the USD stage; None without a stage.
    eye: left or right of a stereo pair; empty without stereo.
    right: task of the right eye, if one file holds both.
    lens: the photograph's lens, by which the picture is distorted; None for no distortion by a lens.
    holdout: absolute path of the holdout's file; None without a holdout.
    placed: placements of the models by time (`model_times`), in frames relative to this frame; None for a single
        model used as it is.
    nears: the models' near plane by time; empty if the camera has a near plane of its own.
    ends: numbers of the first and the last frame of the shot; None for a shot of one frame.
    files: absolute paths of the files of models that have one file per frame.
    """

    number: int
    name: str
    camera: Camera
    path: Path
    after: Camera | None = None
    earlier: Camera | None = None
    stretch: Shot | Moments | None = None
    before: tuple[int, ...] | None = None
    sampling: SamplingConfig | None = None
    optics: Optics | None = None
    eye: str = ""
    right: Task | None = None
    lens: Lens | None = None
    holdout: Path | None = None
    placed: Mapping[float, State] | None = None
    nears: Mapping[float, float] = field(default_factory=dict)
    ends: tuple[int, int] | None = None
    files: tuple[Path, ...] = ()

    @property
    def key(self) -> str:
        """Key of the frame in its job."""
        return key_of(self.number, "" if self.right else self.eye)

    @property
    def views(self) -> tuple[Task, ...]:
        """The frames that the file holds: this one, and the right eye's if one file has both eyes."""
        return (self,) if self.right is None else (self, self.right)

    def at(self, time: float) -> Camera:
        """Return the camera of the whole frame at a time, with the models' near plane.

        time: in frames relative to this frame.
        """
        near = self.nears.get(time)
        if time == 0 or self.stretch is None:
            return self.camera if near in (None, self.camera.near) else replace(self.camera, near=near)
        camera = self.stretch.at(time).along_rays(self.camera.by_rays)
        return camera if near is None else camera.before(near)

    def seen_by(self, gaussians: Gaussians, nears: Mapping[float, float]) -> Task:
        """Return the task with cameras that have the model's near plane, and project along rays if the model needs it.

        nears: the models' near plane at each time of the shutter (`model_times`); keys are times in frames, 0 for this
            frame's own. Not used if the camera has a near plane of its own.
        """

        def seen(camera: Camera) -> Camera:
            return camera.before(gaussians.near).along_rays(gaussians.by_rays)

        after, earlier = (other and seen(other) for other in (self.after, self.earlier))
        nears = nears if self.camera.near == DEFAULT_NEAR_PLANE else {}
        return replace(self, camera=seen(self.camera), after=after, earlier=earlier, nears=nears)

    @property
    def is_video(self) -> bool:
        """True if the task's file is a video, which holds other frames too."""
        return self.path.suffix.lower() in VIDEO_SUFFIXES


def sampling_of(task: Task, pictures: PictureConfig) -> SamplingConfig:
    """Return the settings of shutter and lens of a frame: the task's if it has them, otherwise the job's."""
    return task.sampling or pictures.sampling


@dataclass(frozen=True)
class MatteNames:
    """A Cryptomatte channel with the names of its objects.

    digest: digest of the array with the index of each Gaussian's object.
    """

    channel: str
    names: tuple[str, ...]
    digest: str


@dataclass(frozen=True)
class RenderOptions:
    """Options that all frames of a job share.

    channels: names from the table in `config.channels`.
    attributes: attributes for the file's header.
    pictures: framing, motion blur, depth of field, distortion and colour space.
    recorded: the model's colour space.
    deep: settings of deep pictures; None for flat pictures.
    drawn: digest of the rasterizer's settings.
    gains: three factors of the model's colours, or nine entries of a matrix; empty for unchanged colours.
    holdout: settings for reading holdouts; None without holdouts.
    mattes: the Cryptomattes among the channels.
    ids_from: property of the model files that holds semantic ids.
    """

    channels: tuple[str, ...] = ("rgb",)
    background: tuple[float, float, float] = (0.0, 0.0, 0.0)
    encoding: Encoding = field(default_factory=Encoding)
    attributes: Mapping[str, str | int | float] = field(default_factory=dict)
    pictures: PictureConfig = field(default_factory=PictureConfig)
    recorded: str = "sRGB"
    deep: DeepConfig | None = None
    drawn: str = ""
    gains: tuple[float, ...] = ()
    holdout: HoldoutConfig | None = None
    mattes: tuple[MatteNames, ...] = ()
    ids_from: str = ""


def picture_camera(task: Task, pictures: PictureConfig) -> Camera:
    """Return the camera of the written picture, with its size and window, at the middle of the shutter.

    For a distorted picture, only size and window of the result have a meaning. Raises InputError for a region outside
    the frame.
    """
    warp = warp_of(task, pictures)
    shown = task.at(sampling_of(task, pictures).middle) if warp is None else warp.shown
    return framed(shown, pictures.framing)


def framed(camera: Camera, config: FramingConfig) -> Camera:
    """Apply overscan or region to a camera of the frame's size. Returns the camera of the written picture.

    The camera's window is None if the picture is the whole frame. Raises InputError for a region outside the frame.
    """
    pixels, share = parse_overscan(config.overscan)
    if config.region:
        x, y, width, height = parse_region(config.region)
        if x + width > camera.width or y + height > camera.height:
            raise InputError(
                f"--region {config.region}: ends at {x + width},{y + height}, beyond the frame's size "
                f"{camera.width},{camera.height}"
            )
        return camera.cropped(x, y, width, height)
    across = pixels or round(share * camera.width)
    down = pixels or round(share * camera.height)
    if across == down == 0:
        return camera
    larger = camera.cropped(-across, -down, camera.width + 2 * across, camera.height + 2 * down)
    assert larger.window is not None
    clamp = max(JACOBIAN_CLAMP_HALF_FRAMES, 2 * across / camera.width, 2 * down / camera.height)
    return replace(larger, window=replace(larger.window, clamp=clamp))


def lens_of(task: Task, pictures: PictureConfig) -> Places | None:
    """Return the lens or STMap that distorts the picture; None without distortion. Raises InputError for a bad map."""
    if stmap := pictures.warp.stmap:
        return ByMap(read_stmap(Path(stmap)))
    return ByLens(task.lens) if task.lens is not None else None


def warp_of(task: Task, pictures: PictureConfig) -> Warp | None:
    """Return the warp that distorts the rendered picture; None without distortion."""
    lens = lens_of(task, pictures)
    return None if lens is None else Warp(lens, task.at(sampling_of(task, pictures).middle))


def straight_camera(task: Task, pictures: PictureConfig) -> Camera:
    """Return the camera that is rendered: `picture_camera`, or the undistorted window that a distorted picture is
    sampled from."""
    camera, warp = picture_camera(task, pictures), warp_of(task, pictures)
    return camera if warp is None else warp.of_window(camera)[1] or camera


def camera_after(task: Task, pictures: PictureConfig) -> Camera | None:
    """Return the whole frame's camera one frame after the shutter's middle, for the channel `motion`; None if
    no channel needs it."""
    middle = sampling_of(task, pictures).middle
    still = middle == 0 or task.after is None or isinstance(task.stretch, Moments)
    return task.after if still else task.at(middle + 1)


def camera_before(task: Task, pictures: PictureConfig) -> Camera | None:
    """Return the whole frame's camera one frame before the shutter's middle, for the channel `backward`; None
    if no channel needs it."""
    middle = sampling_of(task, pictures).middle
    still = middle == 0 or task.earlier is None or isinstance(task.stretch, Moments)
    return task.earlier if still else task.at(middle - 1)


def end_before(task: Task, time: float, pictures: PictureConfig) -> float | None:
    """Return the time from which motion is extrapolated to `time`; None if `time` needs no extrapolation.

    Both times are in frames relative to the task's frame. Only times outside a shot of several frames need
    extrapolation. It starts from the shot's first or last frame; in a USD stage from the shutter's middle, because the
    stage defines the camera while the shutter is open.
    """
    if task.ends is None or task.ends[0] <= task.number + time <= task.ends[1]:
        return None
    if isinstance(task.stretch, Moments):
        middle = sampling_of(task, pictures).middle
        return middle if time in (middle - 1, middle + 1) else None
    return task.ends[0] - task.number if time < 0 else task.ends[1] - task.number


def model_times(task: Task, pictures: PictureConfig, channels: Collection[str]) -> list[float]:
    """Return the times at which the models of a frame are needed, in frames relative to the frame.

    These are the shutter's middle, the samples of motion blur, and one frame after or before the middle for motion
    channels.
    """
    sampling = sampling_of(task, pictures)
    times = [sampling.middle, *(sampling.sample_times if sampling.moves else ())]
    times += [sampling.middle + by for name, by in (("motion", 1), ("backward", -1)) if name in channels]
    return list(dict.fromkeys(times))


def plain(value: Any) -> Any:
    """Convert a value to JSON types, for a digest.

    A dataclass becomes the fields that differ from their defaults, so that a new setting does not change digests.
    Floats are rounded to 12 digits, because processors differ in the last digits.
    """
    if is_dataclass(value) and not isinstance(value, type):
        changes = {}
        for setting in fields(value):
            given = getattr(value, setting.name)
            usual = setting.default_factory() if setting.default_factory is not MISSING else setting.default
            if isinstance(given, np.ndarray) or usual is MISSING or given != usual:
                changes[setting.name] = plain(given)
        return changes
    if isinstance(value, float | np.floating):
        return f"{value + 0.0:.12g}"  # + 0.0 turns -0 into 0
    if isinstance(value, np.ndarray):
        return [plain(float(item)) for item in value.ravel()]
    if isinstance(value, tuple | list):
        return [plain(item) for item in value]
    return value


def digest_of(*parts: Any) -> str:
    """Return 128 bits of SHA-256, in hexadecimal, of values that `plain` accepts."""
    return hashlib.sha256(json.dumps(plain(parts), sort_keys=True).encode()).hexdigest()[:32]


def settings_digest(task: Task, options: RenderOptions) -> str:
    """Return a digest of everything that a frame depends on, except the model file.

    It includes cameras, channels, encoding, picture settings, rasterizer settings, the content of the holdout's file,
    and the models' placements. For models with one file per frame it includes the content of these files.
    """
    pictures, sampling = options.pictures, sampling_of(task, options.pictures)
    encoding = {
        name: getattr(options.encoding, name) for name in _ENCODING_FIELDS_BY_SUFFIX.get(task.path.suffix.lower(), ())
    }
    cameras: list[Camera | Moments] = [picture_camera(task, pictures)]
    if "motion" in options.channels and (after := camera_after(task, pictures)) is not None:
        cameras.append(after)
    if "backward" in options.channels and (before := camera_before(task, pictures)) is not None:
        cameras.append(before)
    if sampling.moves and isinstance(task.stretch, Moments):
        cameras.append(task.stretch)
    elif sampling.moves:
        opens, closes = sampling.shutter
        cameras += [task.at(opens + (closes - opens) * part / 4) for part in range(5)]
    used = sampling if sampling.on else None
    made: tuple[Any, ...] = (options.channels, options.background, options.recorded, options.deep, options.drawn)
    made += (options.gains,) if options.gains else ()
    # changes the digest, so that frames of versions without clipping at the far plane are rendered again
    made += ("far",) if task.camera.far < inf else ()
    colour = replace(pictures.colour, ocio_config=configuration_digest(pictures.colour.ocio_config))
    if task.holdout is not None:
        made += ("holdout", known_digest(task.holdout), options.holdout)
    made += (options.mattes,) if options.mattes else ()
    more: list[Any] = [settings_digest(task.right, options)] if task.right is not None else []
    if (lens := lens_of(task, pictures)) is not None:
        bends = lens.stmap.digest if isinstance(lens, ByMap) else task.lens
        more += [bends, task.at(sampling.middle)]
    if task.files:
        made += ("files", [known_digest(path) for path in task.files])
    if task.placed is not None:
        more.append([task.placed[time] for time in model_times(task, pictures, options.channels)])
    return digest_of(cameras, made, encoding, colour, pictures.framing, used, *more)


def header(task: Task, options: RenderOptions, whole: Task | None = None) -> FrameFileHeader:
    """Make the header of a frame's file: frame, model, version, settings, colour space, and matrices of the camera.

    The header of an EXR file also has the picture's window, and an attribute that marks a whole panorama.

    task: the frame of one eye. whole: task of the file, if the file has both eyes.
    """
    camera = picture_camera(task, options.pictures)
    matrices = camera_matrices(camera)
    if warp_of(task, options.pictures) is not None:
        matrices.pop("worldToNDC", None)  # a matrix cannot describe a distorted picture
    attributes = {
        **options.attributes,
        "clsplat:frame": task.number,
        SETTINGS_DIGEST_ATTRIBUTE: settings_digest(whole or task, options),
    }
    space = str(attributes.get("clsplat:colorspace", SRGB))
    if task.path.suffix.lower() != ".exr":
        return FrameFileHeader(attributes, matrices, is_srgb=space == SRGB)
    for matte in options.mattes:
        attributes |= header_of(WRITABLE_CHANNELS[matte.channel].part, matte.names)
    if "clsplat:colorspace" in attributes and (name := COLOR_INTEROP_IDS.get(space)):
        attributes["colorInteropID"] = name
    if is_whole_panorama(camera):
        attributes |= LATLONG_ATTRIBUTES
    sampling = sampling_of(task, options.pictures)
    typed = headers(task.at(sampling.middle), task.number, task.optics, sampling)
    return FrameFileHeader(
        attributes, matrices, camera.window, CHROMATICITIES.get(space, ()), view=task.eye, typed=typed
    )
