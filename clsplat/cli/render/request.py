# SPDX-License-Identifier: Apache-2.0
"""Checks of the flags of `clsplat render`, before any camera or model is read."""

from __future__ import annotations

import os
from collections.abc import Callable, Collection
from dataclasses import dataclass, fields, replace
from pathlib import Path

from clsplat.camera import Camera
from clsplat.cli.render.flags import RenderVerb
from clsplat.config.channels import CRYPTOMATTE_CHANNELS
from clsplat.config.checks import parse_bytes
from clsplat.config.pictures import (
    ColourConfig,
    DeepConfig,
    Encoding,
    HoldoutConfig,
    PictureConfig,
    VideoConfig,
    WarpConfig,
)
from clsplat.device.selection import find_device, list_devices
from clsplat.errors import InputError, warn
from clsplat.images.alpha import background_colour
from clsplat.images.frame_files import check_format, parse_channels
from clsplat.images.video import check_codec, video_missing
from clsplat.shots import check_around

_EXTENSIONS_BY_FLAG = {
    **dict.fromkeys(("exr", "parts", "compression"), (".exr",)),
    "bits": (".png", ".tif", ".tiff", ".dpx"),
    "quality": (".jpg", ".jpeg"),
}
"""For each encoding flag, the endings of the files on which it has an effect."""


@dataclass(frozen=True)
class Request:
    """Call of `clsplat render` whose flags are valid, and agree with each other.

    pictures: picture settings from the flags. A USD stage may still change them.
    holdout: settings for reading holdout files, or None without --holdout.
    devices: selector of each device; None for the default device.
    memory_limit: limit of device memory in bytes; None for no limit.
    resize: function that resizes a camera by --width, --height and --scale.
    """

    flags: RenderVerb
    channels: tuple[str, ...]
    background: tuple[float, float, float]
    encoding: Encoding
    pictures: PictureConfig
    holdout: HoldoutConfig | None
    devices: tuple[str | None, ...]
    memory_limit: int | None
    resize: Callable[[Camera], Camera]


def checked(flags: RenderVerb) -> Request:
    """Check the flags and return them as a request. Warns of flags without effect.

    Raises InputError, and DeviceError for a device that does not exist.
    """
    if flags.cameras is None:
        check_around(flags.path, among_own=True)  # assume that the run has recorded cameras, which are read later
    channels = parse_channels(f"{flags.channels},alpha" if flags.alpha or flags.deep else flags.channels)
    check_format(flags.output, channels, video=True)
    flags.video.check()
    if flags.is_video:
        check_codec(flags.output, flags.video, channels)
        if reason := video_missing():
            raise InputError(f"{flags.output}: {reason}")
    elif flags.video != VideoConfig():
        raise InputError(f"-o {flags.output}: --video flags are for videos, expected the name of an .mp4 or .mov file")
    pictures = PictureConfig(_colour(flags.colour), flags.framing, flags.sampling, _warp(flags.warp))
    pictures.check(whole=False)
    if not 1 <= flags.quality <= 100:
        raise InputError(f"--quality {flags.quality}: expected 1 to 100")
    if "alpha" in channels and flags.background is not None:
        flag = "--deep" if flags.deep else "--alpha" if flags.alpha else "--channels alpha"
        raise InputError(f"{flag} and --background exclude each other: with alpha there is no background")
    flags.pairs.check(distort=flags.warp.distort)
    flags.warp.check(channels)
    _check_mattes(channels, flags.ids_from, flags.compression)
    flags.slices.check()
    _check_deep(flags, pictures, channels)
    bits = bits_of(flags.output, flags.bits, channels)
    encoding = Encoding(flags.exr, flags.parts, flags.compression, bits, flags.quality, flags.video.prores)
    colour, holdout = _background(flags.background or "black"), _holdout(flags)
    flags.rasterizer.check()
    resize = resizer(flags.width, flags.height, flags.scale)
    _warn_of_unused(flags, channels)
    devices, limit = _devices(flags), parse_bytes(flags.max_device_mem)
    return Request(flags, channels, colour, encoding, pictures, holdout, devices, limit, resize)


def _colour(colour: ColourConfig) -> ColourConfig:
    """Return the colour settings with the OCIO configuration's absolute path, as workers may run in other folders."""
    source = colour.ocio_config or os.environ.get("OCIO", "")
    if source and "://" not in source:
        source = str(Path(source).absolute())
    return replace(colour, ocio_config=source)


def _warp(warp: WarpConfig) -> WarpConfig:
    """Return the lens settings with an absolute path of the STMap, as workers may run in other folders."""
    return replace(warp, stmap=str(Path(warp.stmap).absolute())) if warp.stmap else warp


def _check_mattes(channels: Collection[str], ids_from: str | None, compression: str) -> None:
    """Raise InputError for Cryptomattes without --ids-from, or in a file whose compression would change their ids."""
    if ("semantic" in channels) != (ids_from is not None):
        given = f"--ids-from {ids_from}" if ids_from is not None else "--channels semantic"
        raise InputError(f"{given}: expected --channels semantic and --ids-from together")
    mattes = [name for name in channels if name in CRYPTOMATTE_CHANNELS]
    if mattes and compression in ("pxr24", "dwaa", "dwab"):
        raise InputError(f"--compression {compression}: changes the ids of --channels {mattes[0]}, expected zip or piz")


def _check_deep(flags: RenderVerb, pictures: PictureConfig, channels: tuple[str, ...]) -> None:
    if not flags.deep:
        if flags.slices != DeepConfig():
            raise InputError("--deep.bins is for deep EXR, expected --deep with it")
        return
    pictures.check_deep()
    if flags.extension != ".exr":
        raise InputError(f"--deep: {flags.output} cannot hold deep samples, expected an .exr file")
    if over := [name for name in channels if name not in ("rgb", "alpha")]:
        names = ", ".join(over)
        raise InputError(f"--deep: deep EXR cannot hold {names} besides its own depths, expected --channels rgb")
    if flags.parts != "one":
        raise InputError("--deep and --parts several exclude each other: a deep file has one part")


def bits_of(path: str, bits: int | None, channels: Collection[str]) -> int:
    """Return the bits per channel of the file `path`, from --bits or else the default of its format.

    bits: value of --bits, or None for the format's default.
    Raises InputError if the format does not support the bits.
    """
    extension = Path(path).suffix.lower()
    if extension == ".dpx" and bits == 8:
        raise InputError(f"--bits 8: is for PNG and TIFF, expected 10 or 16 for {path}")
    if extension != ".dpx" and bits == 10:
        raise InputError(f"--bits 10: is for DPX, expected 8 or 16 for {path}")
    chosen = bits or (10 if extension == ".dpx" else 8)
    if extension == ".dpx" and chosen == 10 and "alpha" in channels:
        raise InputError(f"{path}: DPX files of 10 bits are written without alpha, expected --bits 16 for alpha")
    return chosen


def _background(text: str) -> tuple[float, float, float]:
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


def _holdout(flags: RenderVerb) -> HoldoutConfig | None:
    """Return the settings for reading holdout files, or None without --holdout. Raises InputError."""
    config = flags.holding
    if flags.holdout is None:
        if config != HoldoutConfig():
            given = f"channel {config.channel}" if config.channel else f"depths {config.depths}"
            raise InputError(f"--holdout.{given}: is for holdouts, expected --holdout with it")
        return None
    if flags.deep:
        raise InputError("--deep and --holdout exclude each other: compositing applies holdouts to deep pictures")
    return config


def resizer(width: int | None, height: int | None, scale: float) -> Callable[[Camera], Camera]:
    """Return a function that resizes a camera by --width, --height and --scale.

    Raises InputError for impossible sizes.
    """
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


def _devices(flags: RenderVerb) -> tuple[str | None, ...]:
    """Return the device selectors of --device; (None,) for the default device. Raises InputError."""
    if flags.workers is not None and flags.workers < 1:
        raise InputError(f"--workers {flags.workers}: expected at least 1")
    if flags.workers is not None and flags.scheduler is not None:
        raise InputError("--workers and --scheduler exclude each other: --workers starts its own cluster")
    words = [word.strip() for word in flags.device.split(",")] if flags.device else []
    if not words:
        return (None,)
    if flags.on_farm:
        if len(words) > 1 or words == ["all"]:
            farm = "--workers" if flags.workers is not None else "--scheduler"
            raise InputError(f"--device {flags.device} and {farm} exclude each other: a worker has one device")
        return (words[0],)
    if words == ["all"]:
        return tuple(str(info.index) for info in list_devices())
    if len(words) > 1 and len({find_device(word).index for word in words}) < len(words):
        raise InputError(f"--device {flags.device}: names a device twice, expected each once")
    return tuple(words)


def _warn_of_unused(flags: RenderVerb, channels: Collection[str]) -> None:
    """Warn of flags that have no effect on files of this format and channels, or on a Dask cluster."""
    if flags.profile and flags.on_farm:
        warn("--profile has no effect: it measures devices of this process, and a Dask cluster renders")
    defaults = {field.name: field.default for field in fields(RenderVerb)}
    names = [
        name
        for name, extensions in _EXTENSIONS_BY_FLAG.items()
        if flags.extension not in extensions
        and getattr(flags, name) != defaults[name]
        and not (name == "exr" and flags.deep)
    ]
    what = f"{flags.extension} files"
    if "rgb" not in channels and flags.background is not None:
        names.append("background")
        what += " of these channels"
    if names:
        warn(f"flags without effect on {what}: {', '.join(f'--{name}' for name in names)}")
