# SPDX-License-Identifier: Apache-2.0
"""`Shot`: the frames to render, in order, each a `Frame` with its number, camera and name."""

from __future__ import annotations

from collections.abc import Callable, Iterable, Sequence
from dataclasses import dataclass, replace
from itertools import pairwise
from math import ceil, floor, isfinite

from clsplat.camera import Camera
from clsplat.errors import InputError
from clsplat.scenes.dataset import Lens, PosedImage
from clsplat.shots.frame_numbers import parse_frames, ranges
from clsplat.shots.keyframes import Key, interpolate
from clsplat.shots.optics import Optics

MAX_SHOT_FRAMES = 100_000
"""Limit of frames per shot: over an hour at 24 fps. A larger number is probably a typo, and would turn a short file
into gigabytes of cameras."""


@dataclass(frozen=True, eq=False)
class Frame:
    """A frame of a shot.

    number: the number that `--frames` and `####` refer to.
    name: the value of `{name}`: the path of the frame's photograph, else the number in four digits.
    time: seconds from the first frame, if the source gives times.
    optics: shutter and lens from a USD stage.
    lens: the photograph's lens, if the frame is to get its distortion.
    """

    number: int
    camera: Camera
    name: str
    time: float | None = None
    optics: Optics | None = None
    lens: Lens | None = None


@dataclass(frozen=True, eq=False)
class Shot:
    """The frames to render, and settings of their source.

    frames: frames in increasing order of their numbers.
    warnings: one line each, for the user.
    fps: frames per second, if the source gives it.
    unapplied: names of the source's settings that are not applied to the frames.
    moment: function that returns the camera at a time in frames; None if the source only has cameras of frames.
    authored: times in frames at which the source has values, in increasing order.
    reach: first and last time, in frames, of the source's values for the camera's transform; None if there are none.
    window: part of the frame that a USD stage asks for, as in `usd_settings.Settings`; None for other sources.
    """

    frames: tuple[Frame, ...]
    warnings: tuple[str, ...] = ()
    fps: float | None = None
    unapplied: tuple[str, ...] = ()
    moment: Callable[[float], Camera] | None = None
    authored: tuple[float, ...] = ()
    reach: tuple[float, float] | None = None
    window: tuple[float, float, float, float] | None = None

    @property
    def cameras(self) -> list[Camera]:
        """Cameras of the frames, in their order."""
        return [frame.camera for frame in self.frames]

    def standing(self, numbers: Sequence[int]) -> Shot:
        """Return the shot with its only frame repeated, once for each of the frame numbers `numbers`. A shot of several
        frames is returned unchanged."""
        if len(self.frames) != 1 or not numbers:
            return self
        return replace(
            self, frames=tuple(replace(self.frames[0], number=number, name=f"{number:04d}") for number in numbers)
        )

    def only(self, text: str) -> Shot:
        """Return the shot with the frames that `text`, such as 1-100:2, lists. Adds a warning if some do not exist.

        Raises InputError for a text that `parse_frames` refuses, and if the shot has none of the listed frames.
        """
        wanted = parse_frames(text)
        numbers = {frame.number for frame in self.frames}
        missing = [number for number in wanted if number not in numbers]
        have = f"the shot has the frames {ranges(sorted(numbers))}"
        if len(missing) == len(wanted):
            raise InputError(f"--frames {text}: holds none of the frames to render, expected some; {have}")
        asked = set(wanted)
        warnings = self.warnings
        if missing:
            warnings += (f"--frames {text}: {len(missing)} of these frames do not exist; {have}",)
        return replace(self, frames=tuple(frame for frame in self.frames if frame.number in asked), warnings=warnings)

    def without_optics(self) -> Shot:
        """Return the shot without the shutter and lens of a USD stage. Their settings are added to `unapplied`."""
        named = [name for frame in self.frames if frame.optics for name in frame.optics.named()]
        found = {name.partition(" ")[0]: name for name in reversed(named)}  # keeps the first value of each setting
        frames = tuple(replace(frame, optics=frame.optics.still) if frame.optics else frame for frame in self.frames)
        return replace(self, frames=frames, unapplied=(*self.unapplied, *reversed(found.values())))

    def told(self, source: object, *more: str) -> tuple[str, ...]:
        """Return all warnings, one line each. The last line lists the settings of the source that are not applied.

        source: file or stage that the shot was read from, for the last line.
        more: further settings of the source that the caller does not apply.
        """
        unapplied = (*self.unapplied, *more)
        return (*self.warnings, f"{source}: not applied: {', '.join(unapplied)}") if unapplied else self.warnings

    def check(self, channels: Iterable[str] = ()) -> None:
        """Raise InputError if motion channels are requested between frames of different projections."""
        if not (moving := [name for name in channels if name in ("motion", "backward")]):
            return
        for before, frame in pairwise(self.frames):
            kind, wanted = frame.camera.projection, before.camera.projection
            if kind != wanted:
                raise InputError(
                    f"--channels {moving[0]}: frame {frame.number} is {kind}, expected {wanted} like "
                    f"frame {before.number}"
                )

    def at(self, frame: float) -> Camera:
        """The camera at a frame number that may be fractional, such as a time while the shutter is open.

        The camera is interpolated as between key frames.
        """
        return interpolate([Key(key.number, key.camera) for key in self.frames], [frame])[0]


def whole_frames(where: str, what: str, begin: float, end: float) -> list[int]:
    """Return the whole numbers from `begin` to `end`. Raises InputError if there are none or too many.

    where: file or prim, to begin the error's message. what: name of the numbers in the message, such as "frame".
    """
    if not (isfinite(end - begin) and end - begin < MAX_SHOT_FRAMES):
        found = f"has the {what}s {begin:,.15g} to {end:,.15g}"  # 15 digits: large numbers are written in full
        raise InputError(f"{where}: {found}, expected at most {MAX_SHOT_FRAMES:,} {what}s")
    frames = list(range(ceil(begin), floor(end) + 1))
    if not frames:
        raise InputError(f"{where}: has no whole {what} from {begin:g} to {end:g}, expected at least one")
    return frames


def numbered(cameras: Iterable[Camera], first: int = 1, fps: float | None = None) -> tuple[Frame, ...]:
    """Frames with the given cameras, numbered upwards from `first` and named after their numbers.

    fps: frames per second, which gives the frames' times; None for no times.
    """
    return tuple(
        Frame(first + index, camera, f"{first + index:04d}", None if fps is None else index / fps)
        for index, camera in enumerate(cameras)
    )


def photographs(images: Iterable[PosedImage]) -> tuple[Frame, ...]:
    """Frames with the photographs' pinhole cameras, numbered from 1 and named after the photographs' files. A frame has
    the photograph's lens if the lens distorts."""
    frames = []
    for index, image in enumerate(images, 1):
        lens = None if image.lens.is_pinhole else image.lens
        frames.append(Frame(index, image.lens.bare(image.rotation, image.translation), image.name, lens=lens))
    return tuple(frames)


def named(cameras: dict[str, Camera]) -> tuple[Frame, ...]:
    """Frames of named cameras, numbered from 1 in their order."""
    return tuple(Frame(index, camera, name) for index, (name, camera) in enumerate(cameras.items(), 1))
