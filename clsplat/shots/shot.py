# SPDX-License-Identifier: Apache-2.0
"""A shot: the frames to render, in order, each with its number, camera and name."""

from __future__ import annotations

from collections.abc import Callable, Iterable, Sequence
from dataclasses import dataclass, replace
from itertools import pairwise
from math import ceil, floor, isfinite

from clsplat.camera import Camera
from clsplat.errors import InputError
from clsplat.scenes.data_set import Lens, PosedImage
from clsplat.shots.frame_numbers import parse_frames, ranges
from clsplat.shots.keys import Key, interpolate
from clsplat.shots.optics import Optics

MOST_FRAMES = 100_000
"""Most frames of a shot: over an hour at 24 a second. More are a slip of the keyboard, and would be
gigabytes of cameras from a file of few lines."""


@dataclass(frozen=True, eq=False)
class Frame:
    """number: what `--frames` and `####` mean; name: what `{name}` means, a picture's path or the number in four
    digits; time: seconds from the first frame, where the source has any; optics: of a stage, shutter and lens; lens: of
    the photograph that the frame is to be bent as."""

    number: int
    camera: Camera
    name: str
    time: float | None = None
    optics: Optics | None = None
    lens: Lens | None = None


@dataclass(frozen=True, eq=False)
class Shot:
    """frames: numbers rise; warnings: a line each, for the user; fps: frames a second, where the source says it;
    unapplied: what the source has and no frame shows; moment: the camera at a time in frames, where the source has one
    for each; authored: the times, rising, that it has values for; reach: the first and the last of those that say where
    the camera is; window: part of the frame that it wants, as
    `usd_settings.Settings`."""

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
        """The camera of every frame."""
        return [frame.camera for frame in self.frames]

    def standing(self, numbers: Sequence[int]) -> Shot:
        """Of one frame, the same camera in the frames of these numbers; other shots as they are."""
        if len(self.frames) != 1 or not numbers:
            return self
        return replace(
            self, frames=tuple(replace(self.frames[0], number=number, name=f"{number:04d}") for number in numbers)
        )

    def only(self, text: str) -> Shot:
        """The frames that `text`, such as 1-100:2, lists and the shot has; a warning where it lists others too.

        Raises InputError for a text that `parse_frames` refuses, and where the shot has none of its frames.
        """
        wanted = parse_frames(text)
        numbers = {frame.number for frame in self.frames}
        missing = [number for number in wanted if number not in numbers]
        have = f"there are the frames {ranges(sorted(numbers))}"
        if len(missing) == len(wanted):
            raise InputError(f"--frames {text}: holds none of the frames to render, expected some; {have}")
        asked = set(wanted)
        warnings = self.warnings
        if missing:
            warnings += (f"--frames {text}: {len(missing)} of these frames do not exist; {have}",)
        return replace(self, frames=tuple(frame for frame in self.frames if frame.number in asked), warnings=warnings)

    def without_optics(self) -> Shot:
        """The frames without the stage's shutter and lens, which are among what is not applied."""
        named = [name for frame in self.frames if frame.optics for name in frame.optics.named()]
        found = {name.partition(" ")[0]: name for name in reversed(named)}  # of each the first value
        frames = tuple(replace(frame, optics=frame.optics.still) if frame.optics else frame for frame in self.frames)
        return replace(self, frames=frames, unapplied=(*self.unapplied, *reversed(found.values())))

    def told(self, source: object, *more: str) -> tuple[str, ...]:
        """The warnings, a line each: the last names all that the source has and is not applied. more: of it that this
        call does not apply."""
        unapplied = (*self.unapplied, *more)
        return (*self.warnings, f"{source}: not applied: {', '.join(unapplied)}") if unapplied else self.warnings

    def check(self, channels: Iterable[str] = ()) -> None:
        """Raises InputError where these channels are not defined: motion from one projection to another."""
        if not (moving := [name for name in channels if name in ("motion", "backward")]):
            return
        for before, frame in pairwise(self.frames):
            kind, wanted = frame.camera.projection, before.camera.projection
            if kind != wanted:
                raise InputError(
                    f"--channels {moving[0]}: frame {frame.number} is {kind}, expected {wanted} as frame "
                    f"{before.number} is"
                )

    def at(self, frame: float) -> Camera:
        """The camera at a frame that need not be whole, such as within a shutter's time: interpolated as keys are."""
        return interpolate([Key(key.number, key.camera) for key in self.frames], [frame])[0]


def whole_frames(where: str, what: str, begin: float, end: float) -> list[int]:
    """The whole numbers from `begin` to `end`. Raises InputError for none of them, and for too many."""
    if not (isfinite(end - begin) and end - begin < MOST_FRAMES):
        raise InputError(f"{where}: has the {what}s {begin:g} to {end:g}, expected at most {MOST_FRAMES:,}")
    frames = list(range(ceil(begin), floor(end) + 1))
    if not frames:
        raise InputError(f"{where}: has no whole {what} from {begin:g} to {end:g}, expected at least one")
    return frames


def numbered(cameras: Iterable[Camera], first: int = 1, fps: float | None = None) -> tuple[Frame, ...]:
    """Frames from the number `first` on, named after their numbers."""
    return tuple(
        Frame(first + index, camera, f"{first + index:04d}", None if fps is None else index / fps)
        for index, camera in enumerate(cameras)
    )


def photographs(images: Iterable[PosedImage]) -> tuple[Frame, ...]:
    """Frames of pictures as they were taken, by name, from 1 on: pinhole cameras, with the lens where it bends."""
    frames = []
    for index, image in enumerate(images, 1):
        lens = None if image.lens.is_pinhole else image.lens
        frames.append(Frame(index, image.lens.bare(image.rotation, image.translation), image.name, lens=lens))
    return tuple(frames)


def named(cameras: dict[str, Camera]) -> tuple[Frame, ...]:
    """Frames of pictures, from 1 on in their order."""
    return tuple(Frame(index, camera, name) for index, (name, camera) in enumerate(cameras.items(), 1))
