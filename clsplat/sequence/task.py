# SPDX-License-Identifier: Apache-2.0
"""The frames of a shot as tasks: where they go, and the options that all of a job share."""

from __future__ import annotations

import hashlib
import json
import re
from collections.abc import Callable, Mapping, Sequence
from dataclasses import MISSING, asdict, dataclass, field, fields, is_dataclass, replace
from functools import lru_cache
from glob import escape, glob
from math import inf
from pathlib import Path
from typing import Any

import numpy as np

from clsplat.camera import NEAR, Camera
from clsplat.config.channels import WRITTEN
from clsplat.config.holdout import HoldoutConfig
from clsplat.config.pictures import DeepConfig, Encoding, PictureConfig, SamplingConfig
from clsplat.errors import InputError, reason_of
from clsplat.files import digest, is_file
from clsplat.frame.lens import ByLens, ByMap, Places, Warp
from clsplat.frame.times import sample_moments
from clsplat.frame.window import framed
from clsplat.gaussians import Gaussians
from clsplat.images.colour import CHROMATICITIES, INTEROP, SRGB
from clsplat.images.cryptomatte import header_of
from clsplat.images.frame_files import VIDEOS, Header, camera_matrices, is_whole_panorama
from clsplat.images.records import SETTINGS
from clsplat.images.stmap import read_stmap
from clsplat.models.placed import State
from clsplat.scenes.data_set import Lens
from clsplat.shots import Shot
from clsplat.shots import motion as moving
from clsplat.shots.frame_numbers import output_paths
from clsplat.shots.motion import Moments, moments
from clsplat.shots.optics import Optics, headers, settled

LATLONG: dict[str, str | int] = {"textureformat": "LatLong Environment", "openexr:levelmode": 0}
"""OpenImageIO's words for EXR's envmap; and that no smaller versions follow, for which it would keep the file open."""
_ENCODED = {
    ".exr": ("depth", "parts", "compression"),
    **dict.fromkeys((".png", ".tif", ".tiff", ".dpx"), ("bits",)),
    **dict.fromkeys((".jpg", ".jpeg"), ("quality",)),
    ".mov": ("prores",),
}
"""Settings of the encoding that a file of that extension depends on."""


def key_of(number: int, eye: str) -> str:
    """Name of a frame among those of a job."""
    return f"{number} {eye}" if eye else str(number)


@dataclass(frozen=True)
class Record:
    """Record of a frame that is done. seconds: of rendering and writing it, without waiting; skipped: it was there;
    eye: of a stereo pair in two files; blank: nothing of the model is in it, None where that was not looked at;
    kernel_ms, transfer_ms: the device's, where that was asked for."""

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
        """That of its task."""
        return key_of(self.frame, self.eye or "")

    def document(self) -> dict[str, Any]:
        """The record for JSON, without what was not measured."""
        return {name: value for name, value in asdict(self).items() if value is not None}


@dataclass(frozen=True, eq=False)
class Task:
    """A frame to be rendered. number, name: as `shots.Frame`; camera: of the whole frame, in its final size; after: the
    camera that motion goes to, of the same size, where motion is asked for; earlier: that of backward motion likewise;
    stretch: where the camera is while the shutter is open, None where it stands still; path: of the file; before: see
    `existing.stamp`; sampling: shutter and lens, None for those of all; optics: what a stage has of them; eye: left or
    right of a stereo pair; right: the frame of the right eye, where one file has both; lens: of the photograph that the
    picture is bent as; holdout: an absolute path, None where nothing is held out; placed: of the models, by the time in
    frames from the frame, at all `model_times` of it; None for one that stands as it is; nears: the models' near plane
    at these times, none where the camera has its own; ends: numbers of the first and the last frame of its shot, None
    for a shot of one; files: absolute paths, of models that have a file a frame.
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
        """Name of the frame among those of its job."""
        return key_of(self.number, "" if self.right else self.eye)

    @property
    def views(self) -> tuple[Task, ...]:
        """The frames that its file holds: itself, and that of the right eye where one file has both."""
        return (self,) if self.right is None else (self, self.right)

    def at(self, time: float) -> Camera:
        """The camera of the whole frame at a time in frames from the frame, as the models want it."""
        near = self.nears.get(time)
        if time == 0 or self.stretch is None:
            return self.camera if near in (None, self.camera.near) else replace(self.camera, near=near)
        camera = self.stretch.at(time).along_rays(self.camera.by_rays)
        return camera if near is None else camera.before(near)

    def seen_by(self, gaussians: Gaussians, nears: Mapping[float, float]) -> Task:
        """The frame of a model, with its near plane, and drawn as it wants it. nears: near planes by the time."""

        def seen(camera: Camera) -> Camera:
            return camera.before(gaussians.near).along_rays(gaussians.by_rays)

        after, earlier = (other and seen(other) for other in (self.after, self.earlier))
        nears = nears if self.camera.near == NEAR else {}
        return replace(self, camera=seen(self.camera), after=after, earlier=earlier, nears=nears)

    @property
    def is_video(self) -> bool:
        """True if the file holds other frames too."""
        return self.path.suffix.lower() in VIDEOS


def make_tasks(
    chosen: Shot,
    whole: Shot,
    pattern: str,
    resize: Callable[[Camera], Camera],
    channels: Sequence[str],
    sampling: SamplingConfig | None = None,
) -> list[Task]:
    """The frames of `chosen`, which are of the shot `whole`. Raises InputError for files that would be one, unless it
    is a video, and for cameras that these channels, or the lens, are not defined for."""
    sampling = sampling or SamplingConfig()
    motion, backward = "motion" in channels, "backward" in channels
    whole.check(channels)
    indices = {frame.number: index for index, frame in enumerate(whole.frames)}
    if Path(pattern).suffix.lower() in VIDEOS:
        paths = [Path(pattern)] * len(chosen.frames)
    else:
        paths = output_paths(pattern, [(frame.number, frame.name) for frame in chosen.frames])
    stretch: Callable[[int], Shot | None] = lambda number: None  # noqa: E731
    if sampling.shutter != (0.0, 0.0) and whole.moment is None:
        stretch = moving.stretches(whole, resize, *sampling.shutter, motion=motion, backward=backward)
    numbers = [frame.number for frame in whole.frames]
    ends = (numbers[0], numbers[-1]) if len(numbers) > 1 else None
    tasks = []
    for frame, path in zip(chosen.frames, paths, strict=True):
        camera = resize(frame.camera)
        own = settled(sampling, frame.optics, camera)
        own.check()
        if own.has_lens and camera.projection != "perspective":
            raise InputError(f"depth of field: frame {frame.number} is {camera.projection}, expected perspective")
        index, after, earlier = indices[frame.number], None, None
        looked_at: Shot | Moments | None = stretch(frame.number)
        if whole.moment is not None:
            if own.shutter != (0.0, 0.0):
                times = [own.middle, *own.shutter, *(sample_moments(own) if own.moves else ())]
                looked_at = moments(whole, resize, frame.number, times)
            after = _beside_middle(whole, resize, frame.number, own.middle, 1) if motion else None
            earlier = _beside_middle(whole, resize, frame.number, own.middle, -1) if backward else None
        else:
            after = moving.camera_after(whole, index) if motion else None
            earlier = moving.camera_before(whole, index) if backward else None
            after, earlier = (other and resize(other) for other in (after, earlier))
        after, earlier = (other and other.resized(camera.width, camera.height) for other in (after, earlier))
        looks = (after, earlier, looked_at, None, None if frame.optics is None else own, frame.optics)
        tasks.append(Task(frame.number, frame.name, camera, path, *looks, lens=frame.lens, ends=ends))
    return tasks


def _beside_middle(shot: Shot, resize: Callable[[Camera], Camera], number: int, middle: float, way: int) -> Camera:
    """The camera a frame after the middle of the shutter (way 1) or before it (-1); beyond the shot's ends, where its
    source says no more, it goes on as it did."""
    assert shot.moment is not None
    time, first, last = number + middle, float(shot.frames[0].number), float(shot.frames[-1].number)
    if shot.reach is not None:
        first, last = min(first, shot.reach[0]), max(last, shot.reach[1])
    if first <= time + way <= last or len(shot.frames) == 1:
        return resize(shot.moment(time + way))
    return moving.continued(resize(shot.moment(time - way)), resize(shot.moment(time)))


def sampling_of(task: Task, options: RenderOptions) -> SamplingConfig:
    """Shutter and lens of a frame."""
    return task.sampling or options.pictures.sampling


@dataclass(frozen=True)
class MatteNames:
    """A matte among the channels: its objects' names, and a digest of which Gaussians are of which."""

    channel: str
    names: tuple[str, ...]
    digest: str


@dataclass(frozen=True)
class RenderOptions:
    """Options that all frames of a job share. channels: of the table, `config.channels`; attributes: of the file's
    header; pictures: windows, samples and colours of a frame; recorded: the model's colour space; deep: slices of a
    deep picture, or None; drawn: digest of the rasterizer's settings; gains: of the model's colours, three, or nine of
    a matrix, none where they are taken as they are; holdout: how hold-outs are read, None where there are none;
    mattes: those among the channels; ids_from: the property of the models' files that semantic ids are of."""

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


def picture_camera(task: Task, options: RenderOptions) -> Camera:
    """The camera of the picture that is written: its size, its window, the middle of the shutter. Of a bent picture it
    says size and window alone.

    Raises InputError for a region that is not in the frame.
    """
    warp = warp_of(task, options)
    shown = task.at(sampling_of(task, options).middle) if warp is None else warp.shown
    return framed(shown, options.pictures.framing)


def lens_of(task: Task, options: RenderOptions) -> Places | None:
    """The lens or the map that bends the picture, None where nothing does. Raises InputError for a map that cannot be
    read."""
    if stmap := options.pictures.warp.stmap:
        return ByMap(read_stmap(Path(stmap)))
    return ByLens(task.lens) if task.lens is not None else None


def warp_of(task: Task, options: RenderOptions) -> Warp | None:
    """How the picture is bent."""
    lens = lens_of(task, options)
    return None if lens is None else Warp(lens, task.at(sampling_of(task, options).middle))


def straight_camera(task: Task, options: RenderOptions) -> Camera:
    """The camera of the picture that is drawn: `picture_camera`, or what a bent one looks at."""
    camera, warp = picture_camera(task, options), warp_of(task, options)
    return camera if warp is None else warp.of_window(camera)[1] or camera


def camera_after(task: Task, options: RenderOptions) -> Camera | None:
    """The camera of the whole frame that motion goes to: a frame later than the middle of the shutter."""
    middle = sampling_of(task, options).middle
    still = middle == 0 or task.after is None or isinstance(task.stretch, Moments)
    return task.after if still else task.at(middle + 1)


def camera_before(task: Task, options: RenderOptions) -> Camera | None:
    """The camera of the whole frame that backward motion goes to: a frame before the middle of the shutter."""
    middle = sampling_of(task, options).middle
    still = middle == 0 or task.earlier is None or isinstance(task.stretch, Moments)
    return task.earlier if still else task.at(middle - 1)


def end_before(task: Task, time: float, options: RenderOptions) -> float | None:
    """The time, in frames from the frame, from which on the camera goes on as it did at another time; None where it is
    as its source says, and for a shot of one frame.

    A stage says where its camera is as long as the shutter is open; motion goes on from the middle of that.
    """
    if task.ends is None or task.ends[0] <= task.number + time <= task.ends[1]:
        return None
    if isinstance(task.stretch, Moments):
        middle = sampling_of(task, options).middle
        return middle if time in (middle - 1, middle + 1) else None
    return task.ends[0] - task.number if time < 0 else task.ends[1] - task.number


def model_times(task: Task, options: RenderOptions) -> list[float]:
    """The times at which the models of a frame are looked at, in frames from it: the middle of its shutter, its
    samples, and where motion goes to."""
    sampling = sampling_of(task, options)
    times = [sampling.middle, *(sample_moments(sampling) if sampling.moves else ())]
    times += [sampling.middle + by for name, by in (("motion", 1), ("backward", -1)) if name in options.channels]
    return list(dict.fromkeys(times))


def plain(value: Any) -> Any:
    """A value in the form of JSON. A dataclass becomes its differences from the defaults, so that a setting that is
    added later changes nothing. Floats have 12 digits, as processors differ in the last ones."""
    if is_dataclass(value) and not isinstance(value, type):
        changes = {}
        for setting in fields(value):
            given = getattr(value, setting.name)
            usual = setting.default_factory() if setting.default_factory is not MISSING else setting.default
            if isinstance(given, np.ndarray) or usual is MISSING or given != usual:
                changes[setting.name] = plain(given)
        return changes
    if isinstance(value, float | np.floating):
        return f"{value + 0.0:.12g}"  # + 0.0: no -0
    if isinstance(value, np.ndarray):
        return [plain(float(item)) for item in value.ravel()]
    if isinstance(value, tuple | list):
        return [plain(item) for item in value]
    return value


def digest_of(*parts: Any) -> str:
    """128 bits of SHA-256, in hexadecimal, of values that `plain` takes."""
    return hashlib.sha256(json.dumps(plain(parts), sort_keys=True).encode()).hexdigest()[:32]


def settings_digest(task: Task, options: RenderOptions) -> str:
    """Digest of all that a frame of the models depends on: cameras, channels, encoding, pictures, rasterizer, the
    content of its hold-out, and where the models are."""
    pictures, sampling = options.pictures, sampling_of(task, options)
    encoding = {name: getattr(options.encoding, name) for name in _ENCODED.get(task.path.suffix.lower(), ())}
    cameras: list[Camera | Moments] = [picture_camera(task, options)]
    if "motion" in options.channels and (after := camera_after(task, options)) is not None:
        cameras.append(after)
    if "backward" in options.channels and (before := camera_before(task, options)) is not None:
        cameras.append(before)
    if sampling.moves and isinstance(task.stretch, Moments):
        cameras.append(task.stretch)
    elif sampling.moves:
        opens, closes = sampling.shutter
        cameras += [task.at(opens + (closes - opens) * part / 4) for part in range(5)]
    used = sampling if sampling.on else None
    made: tuple[Any, ...] = (options.channels, options.background, options.recorded, options.deep, options.drawn)
    made += (options.gains,) if options.gains else ()
    made += ("far",) if task.camera.far < inf else ()  # older frames of such a camera show what is beyond it
    if task.holdout is not None:
        made += ("holdout", _digest_at(str(task.holdout), _changed(task.holdout)), options.holdout)
    made += (options.mattes,) if options.mattes else ()
    colour = replace(pictures.colour, ocio_config=_content(pictures.colour.ocio_config))
    more: list[Any] = [settings_digest(task.right, options)] if task.right is not None else []
    if (lens := lens_of(task, options)) is not None:
        bends = lens.stmap.digest if isinstance(lens, ByMap) else task.lens
        more += [bends, task.at(sampling.middle)]
    if task.files:
        made += ("files", [_digest_at(str(path), _changed(path)) for path in task.files])
    if task.placed is not None:
        more.append([task.placed[time] for time in model_times(task, options)])
    return digest_of(cameras, made, encoding, colour, pictures.framing, used, *more)


def _content(source: str) -> str:
    """SHA-256 of a file of OpenColorIO's, and of the tables that it names; the name of another configuration."""
    if not source or not is_file(Path(source)):
        return source
    patterns = _table_patterns(source, Path(source).stat().st_mtime_ns)
    tables = sorted({path for pattern in patterns for path in glob(pattern) if is_file(Path(path))})  # noqa: PTH207
    return " ".join(_digest_at(path, Path(path).stat().st_mtime_ns) for path in (source, *tables))


def _changed(path: Path) -> int:
    """When a file was last written, in nanoseconds. Raises InputError."""
    try:
        return path.stat().st_mtime_ns
    except OSError as error:
        raise InputError(f"{path}: cannot be read: {reason_of(error)}") from None


@lru_cache(maxsize=4096)
def _digest_at(path: str, changed: int) -> str:  # noqa: ARG001  # asked anew where the file has changed
    return digest(path)


@lru_cache(maxsize=8)
def _table_patterns(source: str, changed: int) -> tuple[str, ...]:  # noqa: ARG001  # likewise
    """Patterns of the paths of the files that a configuration's FileTransforms name, in the folders of its search_path;
    its variables, which are set elsewhere, stand for anything."""
    text = Path(source).read_text("utf-8", "replace")
    listed = re.search(r"^search_path:([^\n]*(?:\n[ \t]*- [^\n]*)*)", text, re.MULTILINE)
    places = re.split(r"[\n\[\],:;]|\s-\s", listed[1]) if listed else []
    names = re.findall(r"\bsrc:[ \t]*(\"[^\"]*\"|'[^']*'|[^,}\n]+)", text)
    folders, files = (
        {re.sub(r"\$\{\w+\}|\$\w+|%\w+%", "*", escape(text.strip(" \t\"'"))) for text in texts}
        for texts in (places, names)
    )
    home = Path(escape(str(Path(source).parent)))
    return tuple(sorted({str(home / folder / file) for folder in folders | {""} for file in files}))


def header(task: Task, options: RenderOptions, whole: Task | None = None) -> Header:
    """Frame, model, version, settings and colour space; the matrices of a camera that has them; in EXR the window, and
    that a panorama is one. whole: the task of the file, where that has other views too."""
    camera = picture_camera(task, options)
    matrices = camera_matrices(camera)
    if warp_of(task, options) is not None:
        matrices.pop("worldToNDC", None)  # no matrix bends
    attributes = {**options.attributes, "clsplat:frame": task.number, SETTINGS: settings_digest(whole or task, options)}
    space = str(attributes.get("clsplat:colorspace", SRGB))
    if task.path.suffix.lower() != ".exr":
        return Header(attributes, matrices, is_srgb=space == SRGB)
    for matte in options.mattes:
        attributes |= header_of(WRITTEN[matte.channel].part, matte.names)
    if "clsplat:colorspace" in attributes and (name := INTEROP.get(space)):
        attributes["colorInteropID"] = name
    if is_whole_panorama(camera):
        attributes |= LATLONG
    sampling = sampling_of(task, options)
    typed = headers(task.at(sampling.middle), task.number, task.optics, sampling)
    return Header(attributes, matrices, camera.window, CHROMATICITIES.get(space, ()), view=task.eye, typed=typed)
