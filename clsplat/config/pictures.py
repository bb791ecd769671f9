# SPDX-License-Identifier: Apache-2.0
"""Settings of rendered pictures (docs/pictures.md): colour space, overscan and region, supersampling, distortion,
shutter, lens, deep EXR, holdouts, video and file encoding.

The flags of `clsplat render` are built from these dataclasses, so this module imports nothing slow.
"""

from __future__ import annotations

from collections.abc import Collection
from dataclasses import dataclass, field
from functools import cache
from math import inf
from typing import TYPE_CHECKING, Literal

from clsplat.config.checks import Rule, check_rules
from clsplat.errors import InputError

if TYPE_CHECKING:
    from clsplat.cameras.model import CameraModel

Filter = Literal["box", "blackman-harris"]
Depths = Literal["z", "inverse", "ray"]

VIDEO_SUFFIXES = (".mp4", ".mov")
"""Lower-case extensions of the videos that frames are written to."""
STRIP_PIXELS = 1 << 24
"""Maximum number of pixels in a strip of a picture, before --supersample's filter. With every channel, a strip takes
about a gigabyte."""
DEEP_STRIP_FLOATS = 1 << 24
"""Maximum number of floats in all slices of a deep picture's strip. They take 64 MiB."""
DEEP_MERGE_FLOATS = 1 << 26
"""Maximum number of floats in memory at once while deep pictures are merged. They take 256 MiB."""
SENSOR_WIDTH_MM = 36.0
"""Default width of the picture on the sensor, in millimetres."""
HOLDOUT_SURFACE_FIELDS = ("Z", "BACK", "KEEP", "RATE")
"""Fields of a holdout surface. Z and BACK: depths of its front and back. KEEP: its transmittance. RATE: log2 of the
transmittance per unit of depth; 0 for a surface without thickness."""
_MAX_SUPERSAMPLES = 64
_MAX_SAMPLES_PER_FRAME = 4096
_MAX_DEEP_BINS = 256
_ENCODER_PRESETS = ("ultrafast", "superfast", "veryfast", "faster", "fast", "medium", "slow", "slower", "veryslow")


@dataclass(frozen=True)
class ColourConfig:
    """Colour spaces of the pictures and of the model."""

    colorspace: str = ""
    """Colour space of the pictures, a name of the OpenColorIO configuration such as ACEScg; '' is the model's own."""
    model_colorspace: str = ""
    """Colour space that the model was trained in; '' uses the model file's, or sRGB if the file names none."""
    ocio_config: str = ""
    """OpenColorIO configuration, a file or ocio://NAME; '' is $OCIO, or the built-in studio configuration."""


@dataclass(frozen=True)
class FramingConfig:
    """The pixels to render: overscan, region, supersampling."""

    overscan: str = "0"
    """Pixels to render beyond each edge of the frame, or a share of its width and height such as 5%. EXR files keep the
    frame as their display window. Other files contain the larger picture."""
    region: str = ""
    """Part of the frame to render alone, X,Y,WIDTH,HEIGHT in pixels from its top left corner; '' renders all of it. In
    EXR files it is the data window."""
    supersample: int = 1
    """Samples of a pixel across and down. The frame is rendered this many times larger, and filtered down in linear
    light. 1 turns it off."""
    filter: Filter = "box"
    """Filter that reduces --supersample's samples to a pixel. box: the mean over the pixel. blackman-harris: a window
    three pixels wide, which is smoother."""

    def check(self) -> None:
        """Raise InputError naming the first setting whose value is invalid."""
        parse_overscan(self.overscan)
        if self.region:
            parse_region(self.region)
        if self.region and parse_overscan(self.overscan) != (0, 0.0):
            raise InputError("--overscan and --region exclude each other: a region lies within the frame")
        if not 1 <= self.supersample <= _MAX_SUPERSAMPLES:
            raise InputError(f"--supersample {self.supersample}: expected 1 to {_MAX_SUPERSAMPLES}")

    def check_model(self, model: CameraModel) -> None:
        """Raise InputError if `model` is a panorama and the filter is wider than a pixel.

        A panorama has no pixels beyond its edges, which such a filter needs.
        """
        if self.supersample > 1 and self.filter != "box" and model.wraps:
            raise InputError(f"--filter {self.filter}: needs pixels beyond a panorama's edges; use --filter box")


def parse_overscan(text: str) -> tuple[int, float]:
    """Parse "32" to (32, 0.0), or "5%" to (0, 0.05): pixels, or a fraction of the frame's size. Raises InputError."""
    word = text.strip()
    try:
        pixels, share = (0, float(word[:-1]) / 100) if word.endswith("%") else (int(word), 0.0)
    except ValueError:
        pixels, share = -1, 0.0
    if not (0 <= pixels <= 1 << 16 and 0 <= share <= 1):
        raise InputError(f"--overscan {text}: expected pixels such as 32, or a share such as 5%, at most 100%")
    return pixels, share


def parse_region(text: str) -> tuple[int, int, int, int]:
    """Parse "100,50,640,480" to x, y, width and height in pixels. Raises InputError."""
    words = [word.strip() for word in text.split(",")]
    if len(words) != 4 or not all(word.isdecimal() for word in words) or "0" in words[2:]:
        raise InputError(f"--region {text}: expected X,Y,WIDTH,HEIGHT in pixels such as 100,50,640,480")
    x, y, width, height = (int(word) for word in words)
    return x, y, width, height


@dataclass(frozen=True)
class WarpConfig:
    """Lens distortion of rendered pictures, by an STMap or by the photographs' lenses."""

    stmap: str = ""
    """STMap, an EXR file, to warp the picture with. R and G give the source of each pixel, as fractions of the frame
    from its lower left corner. Rendering extends as far as the map reaches. '' warps nothing."""
    distort: bool = False
    """Distort pictures like the photographs' lenses, so that they match the original photographs. For cameras of a
    COLMAP model, of a transforms.json or of a survey."""

    def check(self, channels: Collection[str] = ()) -> None:
        """Raise InputError if both settings are given, or if distortion makes a channel undefined.

        channels: names of the channels to render.
        """
        if self.stmap and self.distort:
            raise InputError("--stmap and --distort exclude each other: both distort the picture")
        flag = "--stmap" if self.stmap else "--distort" if self.distort else ""
        if flag and (moving := [name for name in channels if name in ("motion", "backward")]):
            raise InputError(
                f"{flag}: {', '.join(moving)} is not defined for distorted pictures, omit it from --channels"
            )


@dataclass(frozen=True)
class SamplingConfig:
    """Shutter and lens, for motion blur and depth of field."""

    samples: int = 16  # shutter samples, lens samples
    """Pictures that are rendered and averaged for each frame with motion blur or depth of field. More are smoother, and
    take proportionally longer."""
    shutter_angle: float | None = None
    """Motion blur: shutter angle in degrees, centred on the frame; 360 is the time between frames, 0 is no blur. If not
    given: the shutter of a USD stage, else none."""
    shutter_open: float | None = None
    """Time at which the shutter opens, in frames before (-) or after the frame's time, such as -0.25. Replaces
    --shutter-angle, together with --shutter-close."""
    shutter_close: float | None = None
    """Time at which the shutter closes, in frames before (-) or after the frame's time, such as 0.25."""
    f_stop: float | None = None
    """Depth of field: f-number of the lens, such as 2.8. The focal length follows from the camera's field of
    view and --sensor-width. If neither this nor --aperture is given: the lens of a USD stage, else everything is in
    focus. Requires --focus."""
    aperture: float | None = None
    """Depth of field: radius of the lens in the scene's units, instead of --f-stop; 0 is none. Requires --focus."""
    focus: float | None = None
    """Depth that is in focus, along the camera's axis in the scene's units, for --f-stop and --aperture. If not given:
    the focus of a USD stage."""
    sensor_width: float | None = None
    """Width of the picture on the sensor in millimetres, for --f-stop. If not given: the width of a USD stage, else
    36."""
    metres: float | None = None
    """Metres per unit of the scene, for --f-stop. If not given: the unit of a USD stage, else 1."""

    def check(self, *, whole: bool = True) -> None:
        """Raise InputError naming the first setting whose value is invalid.

        whole: True for complete settings, which include the values of a USD stage. False for the flags alone: the focus
            may be missing, because a stage can supply it. Equal shutter times are refused, because only a stage may
            have them.
        """
        rules: tuple[Rule, ...] = (
            (("samples",), lambda value: 1 <= value <= _MAX_SAMPLES_PER_FRAME, f"1 to {_MAX_SAMPLES_PER_FRAME}"),
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
            raise InputError("--aperture and --f-stop exclude each other: both set the size of the lens")
        if self.has_lens and not (0 < (self.focus or 0.0) < inf) and (whole or self.focus is not None):
            raise InputError(f"--focus {self.focus or 0.0}: expected the depth that is in focus, above 0")

    @property
    def shutter(self) -> tuple[float, float]:
        """Times at which the shutter opens and closes, in frames. 0 is the time of the frame."""
        if self.shutter_open is not None and self.shutter_close is not None:
            return self.shutter_open, self.shutter_close
        half = (self.shutter_angle or 0.0) / 720
        return -half, half

    @property
    def middle(self) -> float:
        """Time half way between opening and closing of the shutter, in frames. 0 is the time of the frame."""
        begin, end = self.shutter
        return 0.5 * (begin + end)

    @property
    def moves(self) -> bool:
        """True if the shutter stays open for a time, so that the camera is sampled more than once."""
        return self.shutter[1] > self.shutter[0]

    @property
    def sample_times(self) -> list[float]:
        """Time of each sample, in frames. 0 is the time of the frame.

        The times are spread over the interval in which the shutter is open. Without motion blur all are the middle of
        this interval.
        """
        if not self.on or self.samples == 1:
            return [self.middle]
        if not self.moves:
            return [self.middle] * self.samples
        begin, end = self.shutter
        return [begin + (end - begin) * time for time in stratified_times(self.samples)]

    @property
    def has_lens(self) -> bool:
        """True if the lens has a radius above 0, so that there is depth of field."""
        return bool(self.aperture) or self.f_stop is not None

    @property
    def on(self) -> bool:
        """True if a frame is the mean of several samples."""
        return self.moves or self.has_lens

    @property
    def pictures(self) -> int:
        """Number of pictures that are averaged for a frame."""
        return self.samples if self.on else 1


@cache
def stratified_times(count: int) -> tuple[float, ...]:
    """Stratified samples of the time in (0, 1): `count` times, one in each of as many equal intervals.

    The order of the times follows van der Corput's sequence, so that time and position on the lens are uncorrelated.
    """
    times = [0.0] * count
    by_mirrored_digits = sorted(range(count), key=lambda index: f"{index:b}"[::-1])
    for rank, index in enumerate(by_mirrored_digits):
        times[index] = (rank + 0.5) / count
    return tuple(times)


@dataclass(frozen=True)
class PictureConfig:
    """Settings of a picture, except its channels: colour, framing, sampling, distortion."""

    colour: ColourConfig = field(default_factory=ColourConfig)
    framing: FramingConfig = field(default_factory=FramingConfig)
    sampling: SamplingConfig = field(default_factory=SamplingConfig)
    warp: WarpConfig = field(default_factory=WarpConfig)

    def check(self, *, whole: bool = True) -> None:
        """Raise InputError naming the first setting whose value is invalid.

        whole: True for complete settings; False for the flags alone, to which a USD stage may still add the focus.
        """
        self.framing.check()
        self.sampling.check(whole=whole)

    def check_deep(self) -> None:
        """Raise InputError for settings that deep pictures do not support."""
        if self.framing.supersample > 1:
            raise InputError("deep EXR: --supersample cannot filter deep samples, expected --supersample 1")


@dataclass(frozen=True)
class DeepConfig:
    """Settings of the slices of a deep EXR."""

    bins: int = 16
    """Maximum number of depth slices of a pixel, which are its samples in the file. Each pixel has its own slices, at
    the depths that contribute its light."""

    def check(self) -> None:
        """Raise InputError naming the first setting whose value is invalid."""
        check_rules(
            self, "--deep.", ((("bins",), lambda value: 1 <= value <= _MAX_DEEP_BINS, f"1 to {_MAX_DEEP_BINS}"),)
        )


ProRes = Literal["422", "hq", "4444"]
DEFAULT_VIDEO_FPS = 24.0
"""Frame rate, in frames per second, of a video if neither a flag nor the cameras' file gives a rate."""


@dataclass(frozen=True)
class VideoConfig:
    """Settings by which a video is encoded."""

    fps: float | None = None
    """Frames per second. If not given: the rate of the cameras' file, else 24. The rates 23.976, 29.97 and the like
    are 24000/1001, 30000/1001 and so on."""
    crf: int = 18
    """Quality of an .mp4: 0 is the best, 51 the worst. 18 is about the lowest quality without a visible loss."""
    preset: str = "medium"
    """Encoder preset, from ultrafast to veryslow. Slower presets make smaller files."""
    prores: ProRes = "hq"
    """ProRes of a .mov: 422, hq (422 HQ), or 4444, which may have alpha."""

    def check(self) -> None:
        """Raise InputError naming the first setting whose value is invalid."""
        if self.fps is not None and not 0.01 <= self.fps <= 1000:
            raise InputError(f"--video.fps {self.fps}: expected 0.01 to 1000 frames per second")
        if not 0 <= self.crf <= 51:
            raise InputError(f"--video.crf {self.crf}: expected 0 to 51")
        if self.preset not in _ENCODER_PRESETS:
            raise InputError(f"--video.preset {self.preset}: expected one of {', '.join(_ENCODER_PRESETS)}")


Parts = Literal["one", "several"]
ExrDepth = Literal["half", "float"]
DEFAULT_EXR_DEPTH: ExrDepth = "float"
Compression = Literal["none", "rle", "zips", "zip", "piz", "pxr24", "dwaa", "dwab"]


@dataclass(frozen=True)
class Encoding:
    """Encoding of picture files and videos.

    depth: type of colour, alpha and normals in EXR files: "half" or "float".
    parts: "one" part for all channels of an EXR file, or "several".
    compression: compression of EXR files.
    bits: bits per channel (bit depth), 8 or 16 for PNG and TIFF, 10 or 16 for DPX.
    quality: quality of JPEG files, 1 to 100.
    prores: ProRes profile of MOV files.
    """

    depth: ExrDepth = DEFAULT_EXR_DEPTH
    parts: Parts = "one"
    compression: Compression = "zip"
    bits: int = 8
    quality: int = 95
    prores: ProRes = "hq"


@dataclass(frozen=True)
class HoldoutConfig:
    """Settings for reading the files of --holdout."""

    channel: str = ""
    """Depth channel in --holdout's files, such as depth.Z; Z if not given. Alpha is the channel A of the same layer."""
    depths: Depths = "z"
    """Kind of the depths. z: along the camera's axis. inverse: 1 / z, as Nuke writes it. ray: distances from the
    camera."""
