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
from pathlib import Path
from typing import Any

import numpy as np

from clsplat.camera import Camera
from clsplat.config.channels import WRITTEN
from clsplat.config.holdout import HoldoutConfig
from clsplat.config.pictures import DeepConfig, Encoding, PictureConfig, SamplingConfig
from clsplat.errors import InputError, reason_of
from clsplat.files import digest, is_file
from clsplat.frame.moments import sample_moments
from clsplat.frame.window import framed
from clsplat.gaussians import Gaussians
from clsplat.images.colour import CHROMATICITIES, INTEROP, SRGB
from clsplat.images.cryptomatte import header_of
from clsplat.images.frame_files import VIDEO, Header, camera_matrices
from clsplat.models.placed import State
from clsplat.shots import Shot
from clsplat.shots.frame_numbers import output_paths
from clsplat.shots.motion import camera_after as following
from clsplat.shots.motion import stretches

SETTINGS = "clsplat:settings"
"""The attribute of EXR and PNG files that holds it."""
_ENCODED = {".exr": ("depth", "parts", "compression"), ".png": ("bits",)}
"""Settings of the encoding that a file of that extension depends on."""


@dataclass(frozen=True)
class Record:
    """Record of a frame that is done. seconds: of rendering and writing it, without waiting; skipped: it was there;
    blank: nothing of the model is in it, None where that was not looked at; kernel_ms, transfer_ms: the device's, where
    that was asked for."""

    name: str
    frame: int
    path: str
    width: int
    height: int
    seconds: float
    skipped: bool = False
    blank: bool | None = None
    kernel_ms: float | None = None
    transfer_ms: float | None = None

    def document(self) -> dict[str, Any]:
        """The record for JSON, without what was not measured."""
        return {name: value for name, value in asdict(self).items() if value is not None}


@dataclass(frozen=True, eq=False)
class Task:
    """A frame to be rendered. number, name: as `shots.Frame`; camera: of the whole frame, in its final size; after: the
    camera that motion goes to, of the same size, where motion is asked for; stretch: where the camera is while the
    shutter is open, None where it stands still; path: of the file; before: see `existing.stamp`; holdout: an absolute
    path, None where nothing is held out; placed: of the models, by the time in frames from the frame, at all `moments`
    of it; None for one that stands as it is.
    """

    number: int
    name: str
    camera: Camera
    path: Path
    after: Camera | None = None
    stretch: Shot | None = None
    before: tuple[int, ...] | None = None
    holdout: Path | None = None
    placed: Mapping[float, State] | None = None

    def at(self, time: float) -> Camera:
        """The camera of the whole frame at a time in frames from the frame."""
        return self.camera if time == 0 or self.stretch is None else self.stretch.at(time)

    def seen_by(self, gaussians: Gaussians) -> Task:
        """The frame of a model, with its near plane, and drawn as it wants it."""

        def seen(camera: Camera) -> Camera:
            return camera.before(gaussians.near).along_rays(gaussians.by_rays)

        return replace(self, camera=seen(self.camera), after=None if self.after is None else seen(self.after))

    @property
    def is_video(self) -> bool:
        """True if the file holds other frames too."""
        return self.path.suffix.lower() == VIDEO


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
    motion = "motion" in channels
    whole.check(channels)
    indices = {frame.number: index for index, frame in enumerate(whole.frames)}
    if Path(pattern).suffix.lower() == VIDEO:
        paths = [Path(pattern)] * len(chosen.frames)
    else:
        paths = output_paths(pattern, [(frame.number, frame.name) for frame in chosen.frames])
    stretch = stretches(whole, resize, *sampling.shutter, motion=motion) if sampling.moves else lambda number: None
    tasks = []
    for frame, path in zip(chosen.frames, paths, strict=True):
        camera = resize(frame.camera)
        if sampling.has_lens and camera.projection != "perspective":
            raise InputError(f"depth of field: frame {frame.number} is {camera.projection}, expected perspective")
        after = None
        if motion:
            after = resize(following(whole, indices[frame.number])).resized(camera.width, camera.height)
        tasks.append(Task(frame.number, frame.name, camera, path, after, stretch(frame.number)))
    return tasks


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
    deep picture, or None; drawn: digest of the rasterizer's settings; gains: of the
    model's colours, none where they are taken as they are; holdout: how hold-outs are read, None where there are none;
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
    """The camera of the picture that is written: its size, its window, the middle of the shutter.

    Raises InputError for a region that is not in the frame.
    """
    return framed(task.at(options.pictures.sampling.middle), options.pictures.framing)


def camera_after(task: Task, options: RenderOptions) -> Camera | None:
    """The camera of the whole frame that motion goes to: a frame later than the middle of the shutter."""
    middle = options.pictures.sampling.middle
    return task.after if middle == 0 or task.after is None else task.at(middle + 1)


def moments(options: RenderOptions) -> list[float]:
    """The times at which the models of a frame are looked at, in frames from it: the middle of its shutter, its
    samples, and where motion goes to."""
    sampling = options.pictures.sampling
    times = [sampling.middle, *(sample_moments(sampling) if sampling.moves else ())]
    if "motion" in options.channels:
        times.append(sampling.middle + 1)
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
    pictures = options.pictures
    encoding = {name: getattr(options.encoding, name) for name in _ENCODED.get(task.path.suffix.lower(), ())}
    cameras = [picture_camera(task, options)]
    if "motion" in options.channels and (after := camera_after(task, options)) is not None:
        cameras.append(after)
    if pictures.sampling.moves:
        opens, closes = pictures.sampling.shutter
        cameras += [task.at(opens + (closes - opens) * part / 4) for part in range(5)]
    sampling = pictures.sampling if pictures.sampling.on else None
    made: tuple[Any, ...] = (options.channels, options.background, options.recorded, options.deep, options.drawn)
    made += (options.gains,) if options.gains else ()
    if task.holdout is not None:
        made += ("holdout", _digest_at(str(task.holdout), _changed(task.holdout)), options.holdout)
    made += (options.mattes,) if options.mattes else ()
    colour = replace(pictures.colour, ocio_config=_content(pictures.colour.ocio_config))
    placed = [] if task.placed is None else [[task.placed[time] for time in moments(options)]]
    return digest_of(cameras, made, encoding, colour, pictures.framing, sampling, *placed)


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


def header(task: Task, options: RenderOptions) -> Header:
    """Frame, model, version, settings and colour space; the matrices of a camera that has them; in EXR the window."""
    camera = picture_camera(task, options)
    matrices = camera_matrices(camera)
    attributes = {**options.attributes, "clsplat:frame": task.number, SETTINGS: settings_digest(task, options)}
    space = str(attributes.get("clsplat:colorspace", SRGB))
    if task.path.suffix.lower() != ".exr":
        return Header(attributes, matrices, is_srgb=space == SRGB)
    for matte in options.mattes:
        attributes |= header_of(WRITTEN[matte.channel].part, matte.names)
    if "clsplat:colorspace" in attributes and (name := INTEROP.get(space)):
        attributes["colorInteropID"] = name
    return Header(attributes, matrices, camera.window, chromaticities=CHROMATICITIES.get(space, ()))
