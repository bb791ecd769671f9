# SPDX-License-Identifier: Apache-2.0
"""Shutter and lens settings (f-stop, focus) from a USD stage, and the OpenEXR attributes made from them."""

from __future__ import annotations

from collections.abc import Iterator
from dataclasses import dataclass, replace
from fractions import Fraction
from typing import Any

from clsplat.camera import Camera
from clsplat.config.pictures import SamplingConfig
from clsplat.images.video import rate_of

MAX_TIME_CODE_FPS = 30
"""Highest frame rate that SMPTE time codes can count."""


@dataclass(frozen=True)
class Optics:
    """Shutter and lens at a frame.

    shutter: opening and closing time, in frames relative to the frame.
    f_stop: f-number, 0 for a pinhole.
    focus: focus distance in world units, 0 if it is not set.
    focal_length: focal length in world units.
    metres: length of a world unit in metres.
    fps: frames per second, 0 if unknown.
    """

    shutter: tuple[float, float] = (0.0, 0.0)
    f_stop: float = 0.0
    focus: float = 0.0
    focal_length: float = 0.0
    metres: float = 1.0
    fps: float = 0.0

    def radius(self, f_stop: float) -> float:
        """Radius of the lens aperture at the given f-number, in world units."""
        return self.focal_length / (2 * f_stop)

    @property
    def still(self) -> Optics:
        """A copy of these settings without motion blur or depth of field: instantaneous shutter, pinhole lens."""
        return replace(self, shutter=(0.0, 0.0), f_stop=0.0)

    def named(self) -> Iterator[str]:
        """USD names and values, such as "fStop (2.8)", of the settings that would change a picture."""
        if self.f_stop:
            yield f"fStop ({self.f_stop:g})"
            if self.focus:
                yield f"focusDistance ({self.focus:g})"
        for name, time in zip(("open", "close"), self.shutter, strict=True):
            if time:
                yield f"shutter:{name} ({time:g})"


def headers(camera: Camera, number: int, optics: Optics | None, sampling: SamplingConfig) -> dict[str, tuple[str, Any]]:
    """Return OpenEXR's standard attributes for a frame of a USD stage, by name, as (type, value).

    camera: camera of the whole frame.
    number: the frame's number, from which the time code is computed.
    optics: the frame's settings in the stage; None for a frame of another source, which gets no attributes.
    sampling: the settings of shutter and lens with which the frame is rendered.
    Lens and sensor attributes are written for perspective cameras only: lengths in millimetres, focus distance in
    metres. The sensor size is the part of the sensor that the picture shows.
    """
    if optics is None:
        return {}
    found: dict[str, tuple[str, Any]] = {"pixelAspectRatio": ("float", camera.fy / camera.fx)}
    if optics.fps > 0:
        rate = rate_of(optics.fps)
        found["framesPerSecond"] = "rational", (rate.numerator, rate.denominator)
        if (code := time_code(number, rate)) is not None:
            found["timeCode"] = "timecode", (code, 0)
        if sampling.moves:
            opens, closes = sampling.shutter
            found["expTime"] = "float", (closes - opens) / optics.fps
    if not camera.is_pinhole:
        return found
    millimetres = 1000 * optics.metres
    focal = optics.focal_length * millimetres
    for name in ("nominalFocalLength", "pinholeFocalLength", "effectiveFocalLength"):
        found[name] = "float", focal
    found["sensorOverallDimensions"] = "float[2]", (focal * camera.width / camera.fx, focal * camera.height / camera.fy)
    if sampling.has_lens:
        assert sampling.focus is not None
        if sampling.f_stop or sampling.aperture:
            found["aperture"] = "float", sampling.f_stop or optics.focal_length / (2 * (sampling.aperture or 0.0))
        found["focus"] = "float", sampling.focus * optics.metres
    return found


def time_code(number: int, rate: Fraction) -> int | None:
    """Return the SMPTE time code of a frame as packed bits, non-drop-frame, with frame 0 at 00:00:00:00.

    Returns None for a frame before 0, and for a rate above 30 frames per second or not close to a whole number.
    """
    whole = round(rate)
    if number < 0 or not 1 <= whole <= MAX_TIME_CODE_FPS or abs(float(rate) - whole) > whole / 500:
        return None
    seconds, frame = divmod(number, whole)
    minutes, second = divmod(seconds, 60)
    hours, minute = divmod(minutes, 60)
    code = 0
    for value in (hours % 24, minute, second, frame):  # each value takes two decimal digits of four bits
        code = code << 8 | value // 10 << 4 | value % 10
    return code
