# SPDX-License-Identifier: Apache-2.0
"""Settings of pictures (docs/pictures.md), each default once, as in `training`. Nothing slow is imported here, as the
command line is made from them."""

from __future__ import annotations

from collections.abc import Collection
from dataclasses import dataclass, field
from math import inf
from typing import Literal

from clsplat.config.checks import Rule, check_rules
from clsplat.errors import InputError

Filter = Literal["box", "blackman-harris"]

STRIP_PIXELS = 1 << 24
"""Pixels that are on the host at once, before filtering: about a gigabyte with every layer."""
DEEP_STRIP_FLOATS = 1 << 24
"""Floats for the slices of a deep picture's strip: 64 MiB."""
SENSOR_WIDTH = 36.0
"""Millimetres of a picture's width, where nothing says otherwise."""
_MOST_SUPERSAMPLES = 64
_MOST_SAMPLES = 4096
_MOST_BINS = 256
_PRESETS = ("ultrafast", "superfast", "veryfast", "faster", "fast", "medium", "slow", "slower", "veryslow")


@dataclass(frozen=True)
class ColourConfig:
    """Colour spaces of the pictures and of the model."""

    colorspace: str = ""
    """Colour space of the pictures, a name of the OpenColorIO configuration such as ACEScg; '' is the model's own."""
    model_colorspace: str = ""
    """Colour space that the model was trained in; '' goes by the model file, and by sRGB where that says nothing."""
    ocio_config: str = ""
    """OpenColorIO configuration, a file or ocio://NAME; '' is $OCIO, or the studio configuration that is built in."""


@dataclass(frozen=True)
class FramingConfig:
    """The pixels to render: overscan, region, supersampling."""

    overscan: str = "0"
    """Pixels beyond each edge of the frame, or a share of its width and height such as 5%. EXR files keep the frame as
    their display window, others have a larger picture."""
    region: str = ""
    """Part of the frame to render alone, X,Y,WIDTH,HEIGHT in pixels from its top left corner; '' renders all of it. In
    EXR files it is the data window."""
    supersample: int = 1
    """Samples of a pixel across and down: the frame is rendered this many times larger, and made smaller in linear
    light. 1 does without."""
    filter: Filter = "box"
    """Filter that makes a pixel of --supersample's samples. box: the mean over it; blackman-harris: a window three
    pixels wide, which is smoother."""

    def check(self) -> None:
        """Raise InputError naming the first setting whose value makes no sense."""
        parse_overscan(self.overscan)
        if self.region:
            parse_region(self.region)
        if self.region and parse_overscan(self.overscan) != (0, 0.0):
            raise InputError("--overscan and --region exclude each other: a region lies within the frame")
        if not 1 <= self.supersample <= _MOST_SUPERSAMPLES:
            raise InputError(f"--supersample {self.supersample}: expected 1 to {_MOST_SUPERSAMPLES}")


def parse_overscan(text: str) -> tuple[int, float]:
    """(pixels, 0) or (0, share) of "32" or "5%". Raises InputError."""
    word = text.strip()
    try:
        pixels, share = (0, float(word[:-1]) / 100) if word.endswith("%") else (int(word), 0.0)
    except ValueError:
        pixels, share = -1, 0.0
    if not (0 <= pixels <= 1 << 16 and 0 <= share <= 1):
        raise InputError(f"--overscan {text}: expected pixels such as 32, or a share such as 5%, at most 100%")
    return pixels, share


def parse_region(text: str) -> tuple[int, int, int, int]:
    """x, y, width, height of "100,50,640,480". Raises InputError."""
    words = [word.strip() for word in text.split(",")]
    if len(words) != 4 or not all(word.isdecimal() for word in words) or "0" in words[2:]:
        raise InputError(f"--region {text}: expected X,Y,WIDTH,HEIGHT in pixels such as 100,50,640,480")
    x, y, width, height = (int(word) for word in words)
    return x, y, width, height


@dataclass(frozen=True)
class WarpConfig:
    """Lenses that bend."""

    stmap: str = ""
    """STMap, an EXR file, that the picture is bent by: R and G say where each pixel comes from, in parts of the frame
    from its lower left corner. The frame is rendered as far as they reach; '' bends nothing."""
    distort: bool = False
    """Bend pictures as the photographs' lenses do, so that they lie on the photographs as they were taken. For cameras
    of a COLMAP model or a transforms.json."""

    def check(self, channels: Collection[str] = (), *, deep: bool = False) -> None:
        """Raise InputError for settings that exclude each other, and for what a bent picture has not."""
        if self.stmap and self.distort:
            raise InputError("--stmap and --distort exclude each other: both bend the picture")
        flag = "--stmap" if self.stmap else "--distort" if self.distort else ""
        if flag and deep:
            raise InputError(f"{flag}: deep EXR has no bent pictures, expected a flat one")
        if flag and (moving := [name for name in channels if name in ("motion", "backward")]):
            raise InputError(f"{flag}: {', '.join(moving)} of a bent picture is not defined, expected other --channels")


@dataclass(frozen=True)
class SamplingConfig:
    """Shutter and lens."""

    samples: int = 16
    """Pictures that are rendered and averaged for each frame with motion blur or depth of field; more are smoother and
    take as much longer."""
    shutter_angle: float | None = None
    """Motion blur: how long the shutter is open, half before the frame and half after it, in degrees of which 360 are
    from frame to frame; 0 is none. If not given: the shutter of a USD stage, else none."""
    shutter_open: float | None = None
    """Opening of the shutter, in frames from the frame, such as -0.25; in place of --shutter-angle, with
    --shutter-close."""
    shutter_close: float | None = None
    """Closing of the shutter, in frames from the frame, such as 0.25."""
    f_stop: float | None = None
    """Depth of field: the f-number of a lens, such as 2.8, its focal length that of the camera on a sensor of
    --sensor-width. If neither this nor --aperture is given: the lens of a USD stage, else everything is in focus.
    Wants --focus."""
    aperture: float | None = None
    """Depth of field: the radius of the lens in the scene's units, in place of --f-stop; 0 is none. Wants --focus."""
    focus: float | None = None
    """Depth that is in focus, along the camera's axis in the scene's units, for --f-stop and --aperture; if not given
    that of a USD stage."""
    sensor_width: float | None = None
    """Millimetres that the picture's width is on the sensor, for --f-stop; if not given that of a USD stage, else
    36."""
    metres: float | None = None
    """Metres that a unit of the scene is, for --f-stop; if not given that of a USD stage, else 1."""

    def check(self, *, whole: bool = True) -> None:
        """Raise InputError naming the first setting whose value makes no sense. whole: False for flags that a stage
        may add the focus to."""
        rules: tuple[Rule, ...] = (
            (("samples",), lambda value: 1 <= value <= _MOST_SAMPLES, f"1 to {_MOST_SAMPLES}"),
            (("shutter_angle",), lambda value: value is None or 0 <= value <= 3600, "0 to 3600 degrees"),
            (("f_stop", "sensor_width", "metres"), lambda value: value is None or 0 < value < inf, "a number above 0"),
            (("aperture",), lambda value: value is None or 0 <= value < inf, "a radius of at least 0"),
        )
        check_rules(self, "--", rules)
        if self.shutter_open is not None or self.shutter_close is not None:
            if self.shutter_angle:
                raise InputError("--shutter-angle and --shutter-open exclude each other")
            if (
                self.shutter_open is None
                or self.shutter_close is None
                or not (-inf < self.shutter_open <= self.shutter_close < inf)
                or (self.shutter_open == self.shutter_close and not whole)
            ):
                times = f"--shutter-open {self.shutter_open} --shutter-close {self.shutter_close}"
                raise InputError(f"{times}: expected two times, the second after the first")
        if self.aperture and self.f_stop is not None:
            raise InputError("--aperture and --f-stop exclude each other: both are the size of the lens")
        if self.has_lens and not (0 < (self.focus or 0.0) < inf) and (whole or self.focus is not None):
            raise InputError(f"--focus {self.focus or 0.0}: expected the depth that is in focus, above 0")

    @property
    def shutter(self) -> tuple[float, float]:
        """Opening and closing of the shutter, in frames from the frame."""
        if self.shutter_open is not None and self.shutter_close is not None:
            return self.shutter_open, self.shutter_close
        half = (self.shutter_angle or 0.0) / 720
        return -half, half

    @property
    def middle(self) -> float:
        """The time half way between opening and closing, in frames from the frame."""
        begin, end = self.shutter
        return 0.5 * (begin + end)

    @property
    def moves(self) -> bool:
        """True if the shutter stays open for a time, so that the camera is looked at more than once."""
        return self.shutter[1] > self.shutter[0]

    @property
    def has_lens(self) -> bool:
        """True if the camera is more than a pinhole."""
        return bool(self.aperture) or self.f_stop is not None

    @property
    def on(self) -> bool:
        """True if a frame is more than one sample."""
        return self.moves or self.has_lens


@dataclass(frozen=True)
class PictureConfig:
    """Settings of a picture beside its channels: colour, framing, sampling, a lens that bends."""

    colour: ColourConfig = field(default_factory=ColourConfig)
    framing: FramingConfig = field(default_factory=FramingConfig)
    sampling: SamplingConfig = field(default_factory=SamplingConfig)
    warp: WarpConfig = field(default_factory=WarpConfig)

    def check(self, *, whole: bool = True) -> None:
        """Raise InputError naming the first setting whose value makes no sense. whole: as of `SamplingConfig.check`."""
        self.framing.check()
        self.sampling.check(whole=whole)

    def check_deep(self) -> None:
        """Raise InputError for what deep pictures have not."""
        if self.sampling.on or self.framing.supersample > 1:
            flag = "a shutter or a lens" if self.sampling.on else "--supersample"
            raise InputError(f"deep EXR: {flag} has no deep samples, expected a frame without")


@dataclass(frozen=True)
class DeepConfig:
    """Slices of a deep EXR."""

    bins: int = 16
    """Slices by depth, the most samples that a pixel has. Each pixel has them where its light is taken."""

    def check(self) -> None:
        """Raise InputError naming the first setting whose value makes no sense."""
        check_rules(self, "--deep.", ((("bins",), lambda value: 1 <= value <= _MOST_BINS, f"1 to {_MOST_BINS}"),))


ProRes = Literal["422", "hq", "4444"]
FPS = 24.0
"""Frames a second of a video where neither a flag nor the cameras' file says another rate."""


@dataclass(frozen=True)
class VideoConfig:
    """Encoding of a video."""

    fps: float | None = None
    """Frames a second; if not given the rate of the cameras' file, or 24 where that has none. 23.976, 29.97 and
    their like are 24000/1001, 30000/1001 and so on."""
    crf: int = 18
    """Quality of an .mp4: 0 is the best, 51 the worst, 18 about the least that shows no loss."""
    preset: str = "medium"
    """Effort of the encoder for a smaller file, from ultrafast to veryslow."""
    prores: ProRes = "hq"
    """ProRes of a .mov: 422, hq (422 HQ), or 4444, which may have alpha."""

    def check(self) -> None:
        """Raise InputError naming the first setting whose value makes no sense."""
        if self.fps is not None and not 0.01 <= self.fps <= 1000:
            raise InputError(f"--video.fps {self.fps}: expected 0.01 to 1000 frames a second")
        if not 0 <= self.crf <= 51:
            raise InputError(f"--video.crf {self.crf}: expected 0 to 51")
        if self.preset not in _PRESETS:
            raise InputError(f"--video.preset {self.preset}: expected one of {', '.join(_PRESETS)}")


Parts = Literal["one", "several"]
ExrDepth = Literal["half", "float"]
EXR_DEPTH: ExrDepth = "float"
Compression = Literal["none", "rle", "zips", "zip", "piz", "pxr24", "dwaa", "dwab"]


@dataclass(frozen=True)
class Encoding:
    """Encoding of pictures. bits: 8 or 16, of PNG and TIFF, 10 or 16 of DPX; quality: of JPEG; prores: of MOV."""

    depth: ExrDepth = EXR_DEPTH
    parts: Parts = "one"
    compression: Compression = "zip"
    bits: int = 8
    quality: int = 95
    prores: ProRes = "hq"
