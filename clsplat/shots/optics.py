# SPDX-License-Identifier: Apache-2.0
"""Shutter and lens that a stage has for a frame, beside the flags, which go before them."""

from __future__ import annotations

from collections.abc import Iterator
from dataclasses import dataclass, replace
from fractions import Fraction
from typing import Any

from clsplat.camera import Camera
from clsplat.config.pictures import SamplingConfig
from clsplat.images.video import rate_of

MOST_FRAMES_OF_A_SECOND = 30
"""An SMPTE time code has no number for more."""


@dataclass(frozen=True)
class Optics:
    """Shutter and lens at a frame. shutter: opening and closing in frames from the frame; f_stop: 0 for a pinhole;
    focus: depth in focus, 0 for none, and focal_length, both in the world's units; metres: of such a unit; fps: frames
    a second, 0 where that is not known."""

    shutter: tuple[float, float] = (0.0, 0.0)
    f_stop: float = 0.0
    focus: float = 0.0
    focal_length: float = 0.0
    metres: float = 1.0
    fps: float = 0.0

    def radius(self, f_stop: float) -> float:
        """The radius of the lens with that f-number, in the world's units."""
        return self.focal_length / (2 * f_stop)

    @property
    def still(self) -> Optics:
        """The same without a shutter that is open and a lens."""
        return replace(self, shutter=(0.0, 0.0), f_stop=0.0)

    def named(self) -> Iterator[str]:
        """USD's names, with the values, of those that would change a picture."""
        if self.f_stop:
            yield f"fStop ({self.f_stop:g})"
            if self.focus:
                yield f"focusDistance ({self.focus:g})"
        for name, time in zip(("open", "close"), self.shutter, strict=True):
            if time:
                yield f"shutter:{name} ({time:g})"


def settled(flags: SamplingConfig, optics: Optics | None, camera: Camera) -> SamplingConfig:
    """Shutter and lens of a frame: the flags', and what these leave open the stage's. The lens's size becomes a radius
    unless flags say what the sensor and a unit are."""
    if optics is None:
        return flags
    changes: dict[str, Any] = {}
    if flags.shutter_angle is None and flags.shutter_open is None and any(optics.shutter):
        changes |= dict(zip(("shutter_open", "shutter_close"), optics.shutter, strict=True))
    focus = flags.focus if flags.focus is not None else optics.focus or None
    asked = flags.aperture is not None or flags.f_stop is not None
    f_stop = flags.f_stop if asked else optics.f_stop
    if f_stop and camera.projection == "perspective" and (asked or focus is not None):
        if flags.sensor_width is None and flags.metres is None:
            changes |= {"aperture": optics.radius(f_stop), "f_stop": None}
        else:
            metres = flags.metres or optics.metres
            sensor = optics.focal_length * camera.width / camera.fx * 1000 * metres
            changes |= {"f_stop": f_stop, "sensor_width": flags.sensor_width or sensor, "metres": metres}
    if asked or changes.keys() & {"aperture", "f_stop"}:
        changes["focus"] = focus
    return replace(flags, **changes)


def headers(camera: Camera, number: int, optics: Optics | None, sampling: SamplingConfig) -> dict[str, tuple[str, Any]]:
    """OpenEXR's standard attributes of a frame of a stage, by name: type and value. Of other frames none.

    camera: of the whole frame. Lens and sensor are those of a perspective camera, in millimetres; the sensor is as much
    of it as the picture shows.
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
    if camera.projection != "perspective":
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
    """The bits of the SMPTE time code of a frame, counted from 0 at 00:00:00:00, no frames dropped; None where it has
    none: before 0, at a rate that is not near a whole number, and above 30 frames a second."""
    whole = round(rate)
    if number < 0 or not 1 <= whole <= MOST_FRAMES_OF_A_SECOND or abs(float(rate) - whole) > whole / 500:
        return None
    seconds, frame = divmod(number, whole)
    minutes, second = divmod(seconds, 60)
    hours, minute = divmod(minutes, 60)
    code = 0
    for value in (hours % 24, minute, second, frame):  # each in two decimal digits of four bits
        code = code << 8 | value // 10 << 4 | value % 10
    return code
