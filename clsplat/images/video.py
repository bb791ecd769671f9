# SPDX-License-Identifier: Apache-2.0
"""Video: frames to an .mp4, H.264, or a .mov, ProRes, as they come, by PyAV (`pip install 'clsplat[video]'`)."""

from __future__ import annotations

import errno
import os
from collections.abc import Collection, Iterator
from contextlib import contextmanager, suppress
from fractions import Fraction
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import NDArray

from clsplat.config.pictures import FPS, ProRes, VideoConfig
from clsplat.errors import ClsplatError, InputError
from clsplat.files import FULL, atomic_name, native_name
from clsplat.images.alpha import unassociate
from clsplat.images.frame_files import VIDEOS
from clsplat.images.records import parse_record

_LUMA = (0.2126, 0.7152, 0.0722)
_BLUE, _RED = np.float32(2 * (1 - 0.0722)), np.float32(2 * (1 - 0.2126))
"""Ranges of B - Y and R - Y, from end to end."""


VideoPlanes = NDArray[np.uint8] | tuple[NDArray[np.uint16], ...]
"""A frame as its encoder takes it: of `frame_planes`, or of `prores_planes`."""
_PROFILES: dict[ProRes, str] = {"422": "standard", "hq": "hq", "4444": "4444"}
"""FFmpeg's names of ProRes."""


def video_missing() -> str:
    """The reason that no video can be written, in one line; '' if it can."""
    try:
        import av  # noqa: F401
    except ImportError:
        return "video needs PyAV, which is not installed: pip install 'clsplat[video]'"
    return ""


SMALL = 128
"""Pixels of the shorter side under which x264 does without its tree of macroblocks: with it up to 102 of 250 videos of
48x40 had other bytes on a busy machine, none of 225 of 320x240. It saves a quarter of a larger video's bytes."""


LARGEST_SIDE = 16384
"""Pixels: x264's MAX_RESOLUTION."""
LARGEST_AREA = 260
"""Megapixels, about: FFmpeg's av_image_check_size wants 8 (width + 128) (height + 128) under 2^31."""


def video_record(path: Path, frames: int | None = None) -> dict[str, str]:
    """The record (`records`) of a video; nothing where the file is no video or has none, or, with `frames`, where it is
    not whole or has another number of them."""
    import av

    try:
        with av.open(native_name(path)) as container:
            record = parse_record(container.metadata.get("comment"))
            if not record or not container.streams.video:
                return {}
            packets = container.demux(video=0) if frames is not None else ()
            return record if frames is None or sum(packet.size > 0 for packet in packets) == frames else {}
    except (av.error.FFmpegError, OSError, ValueError):
        return {}


def check_video(path: Path) -> None:
    """Raise InputError where this installation cannot write a video there."""
    if path.suffix.lower() not in VIDEOS:
        raise InputError(f"{path}: has the extension {path.suffix or 'none'!r}, expected {' or '.join(VIDEOS)}")
    if reason := video_missing():
        raise InputError(f"{path}: {reason}")
    if not path.parent.is_dir():
        raise InputError(f"{path.parent}: no such folder to write {path.name} to")


def check_codec(path: str, config: VideoConfig, channels: Collection[str]) -> None:
    """Raise InputError for settings of the other codec, and for alpha that the codec has none of."""
    usual = VideoConfig()
    if Path(path).suffix.lower() == ".mp4":
        if config.prores != usual.prores:
            raise InputError(f"--video.prores {config.prores}: is of ProRes, expected the name of a .mov, not {path}")
        return
    for name in ("crf", "preset"):
        if getattr(config, name) != getattr(usual, name):
            value = getattr(config, name)
            raise InputError(f"--video.{name} {value}: is of H.264, expected the name of an .mp4, not {path}")
    if "alpha" in channels and config.prores != "4444":
        raise InputError(f"{path}: ProRes {config.prores} cannot hold alpha, expected --video.prores 4444 with it")


def check_size(path: Path, width: int, height: int) -> None:
    """Raise InputError where frames are larger than the encoder takes."""
    if max(width, height) > LARGEST_SIDE or 8 * (width + 128) * (height + 128) >= 1 << 31:
        raise InputError(
            f"{path}: frames of {width}x{height}, expected at most {LARGEST_SIDE:,} pixels a side and {LARGEST_AREA} "
            "megapixels, which is what a video is encoded of here; give a smaller --width, or write pictures"
        )


def frame_planes(image: NDArray[Any]) -> NDArray[np.uint8]:
    """(3 H / 2, W): luma, below it chroma at half the size, as PyAV takes them; sizes rounded up to even ones. Rec.709,
    limited range, chroma sited at the left as in H.264. FFmpeg's own is darker by a level.

    image: (H, W, 3), floats as they are to be displayed, clipped to [0, 1], NaN as 0, or uint8. Raises ValueError for
    another shape."""
    pixels = np.asarray(image)
    if pixels.ndim != 3 or pixels.shape[2] != 3 or 0 in pixels.shape:
        raise ValueError(f"frame {pixels.shape}: expected (H, W, 3)")
    values = pixels / np.float32(255) if pixels.dtype == np.uint8 else np.clip(np.nan_to_num(pixels), 0, 1)
    rgb = values.astype(np.float32, copy=False)
    height, width, _ = rgb.shape
    rgb = np.pad(rgb, ((0, height % 2), (0, width % 2), (0, 0)), mode="edge")
    luma = rgb @ np.array(_LUMA, np.float32)
    chroma = np.stack([(rgb[:, :, 2] - luma) / _BLUE, (rgb[:, :, 0] - luma) / _RED])
    chroma = 0.5 * (chroma[:, 0::2] + chroma[:, 1::2])
    chroma = _left_sited(chroma)
    flat = np.concatenate([(16 + 219 * luma).ravel(), (128 + 224 * chroma).ravel()])
    return np.asarray(np.rint(flat).reshape(-1, luma.shape[1]), np.uint8)


def prores_planes(image: NDArray[Any], alpha: NDArray[Any] | None, prores: ProRes) -> tuple[NDArray[np.uint16], ...]:
    """Luma, chroma and, where there is alpha, that, (H, W) each, as ProRes takes them: 10 bits, Rec.709 in limited
    range, alpha in full range. Of 422 and hq chroma is half as wide, sited at the left, and the width rounded up to an
    even one.

    image: (H, W, 3), floats as they are to be displayed, clipped to [0, 1], NaN as 0; alpha: (H, W), which image is
    associated with; in the file it is straight.
    """
    rgb = np.nan_to_num(np.asarray(image, np.float32))
    if alpha is not None:
        rgba = unassociate(np.concatenate([rgb, np.nan_to_num(np.asarray(alpha, np.float32))[:, :, None]], axis=2))
        rgb, alpha = rgba[:, :, :3], np.clip(rgba[:, :, 3], 0, 1)
    rgb = np.clip(rgb, 0, 1)
    if prores != "4444":
        rgb = np.pad(rgb, ((0, 0), (0, rgb.shape[1] % 2), (0, 0)), mode="edge")
    luma = rgb @ np.array(_LUMA, np.float32)
    chroma = np.stack([(rgb[:, :, 2] - luma) / _BLUE, (rgb[:, :, 0] - luma) / _RED])
    if prores != "4444":
        chroma = _left_sited(chroma)
    planes = [64 + 876 * luma, *(512 + 896 * chroma)]
    planes += [] if alpha is None else [1023 * alpha]
    return tuple(np.ascontiguousarray(np.rint(plane), np.uint16) for plane in planes)


def _left_sited(chroma: NDArray[Any]) -> NDArray[Any]:
    """(2, H, W / 2): a quarter of each neighbour, half of the sample that it is at."""
    left = np.concatenate([chroma[:, :, :1], chroma[:, :, 1:-1:2]], axis=2)
    return np.asarray(0.25 * (left + chroma[:, :, 1::2]) + 0.5 * chroma[:, :, 0::2])


def planes_of(path: Path, image: NDArray[Any], alpha: NDArray[Any] | None, prores: ProRes) -> VideoPlanes:
    """The frame as the encoder of a video of that name takes it."""
    return prores_planes(image, alpha, prores) if path.suffix.lower() == ".mov" else frame_planes(image)


def rate_of(fps: float) -> Fraction:
    """Frames a second for a file: those of television, which are said in two or three decimals, in 1001ths."""
    whole = round(fps * 1.001)
    ntsc = Fraction(1000 * whole, 1001)
    near = 5e-3 if whole % 24 == 0 or whole % 30 == 0 else 1e-4
    if fps != round(fps) and abs(float(ntsc) - fps) < near:
        return ntsc
    return Fraction(fps).limit_denominator(1001)


@contextmanager
def video_writer(path: Path, config: VideoConfig | None = None, comment: str = "") -> Iterator[VideoWriter]:
    """A video that takes the place of `path` when the block ends well; on any exception nothing is left there. comment:
    of what it was made.

    Raises InputError for another extension, a folder that does not exist, no frames, and where PyAV is not installed.
    """
    config = config or VideoConfig()
    config.check()
    check_video(path)
    with atomic_name(path) as temporary:
        video = VideoWriter(path, temporary, config, comment)
        try:
            yield video
            video.finish()
        finally:
            video.close()


def _frame_of(planes: tuple[NDArray[np.uint16], ...], form: str) -> Any:
    """PyAV's frame of planes of whole numbers."""
    import av

    height, width = planes[0].shape
    frame = av.VideoFrame(width, height, form)
    for plane, values in zip(frame.planes, planes, strict=True):
        lines = np.zeros((values.shape[0], plane.line_size // 2), np.uint16)
        lines[:, : values.shape[1]] = values
        plane.update(lines)
    # ProRes has them in each frame's header too, where an encoder takes them from the frame
    frame.colorspace = frame.color_primaries = frame.color_trc = frame.color_range = 1
    return frame


class VideoWriter:
    """A video that is written frame by frame, in order.

    H.264 has 8-bit 4:2:0 in Rec.709's limited range, which halves the colour's resolution; where a size is odd the
    last column or row is repeated, as the format has none. ProRes has 10 bits, 4:2:2 or 4:4:4.
    """

    def __init__(self, path: Path, temporary: Path, config: VideoConfig, comment: str = "") -> None:
        """temporary: the file's name as long as it is written; comment: in its header."""
        self._path, self._temporary, self._config, self._comment = path, temporary, config, comment
        self._container: Any = None
        self._stream: Any = None
        self._size = (0, 0)
        self.frames = 0

    def add(self, planes: VideoPlanes) -> None:
        """Append a frame as `planes_of` gives it; all of one size and kind.

        Raises ClsplatError if writing fails, ValueError for a frame of another size.
        """
        import av

        whole = isinstance(planes, tuple)
        height, width = planes[0].shape if isinstance(planes, tuple) else (planes.shape[0] * 2 // 3, planes.shape[1])
        size = height, width
        if self.frames and size != self._size:
            raise ValueError(f"frame {size}: expected {self._size}, the size of the first")
        self._size = size
        with self._refusals():
            if self._container is None:
                self._open(width, height, alpha=len(planes) == 4 if whole else False)
            if isinstance(planes, tuple):
                frame = _frame_of(planes, self._stream.pix_fmt)
            else:
                frame = av.VideoFrame.from_ndarray(planes, format="yuv420p")
            frame.pts = self.frames
            frame.time_base = self._stream.codec_context.time_base
            self._container.mux(self._stream.encode(frame))
        self.frames += 1

    def _open(self, width: int, height: int, *, alpha: bool = False) -> None:
        import av

        check_size(self._path, width, height)
        config = self._config
        rate = rate_of(FPS if config.fps is None else config.fps)
        kind = self._path.suffix.lower()[1:]
        self._container = av.open(native_name(self._temporary), "w", format=kind, options={"movflags": "+faststart"})
        if self._comment:
            self._container.metadata["comment"] = self._comment
        if kind == "mov":
            # Apple's readers want its mark; alpha of 16 bits loses nothing
            options = {"profile": _PROFILES[config.prores], "vendor": "apl0", "alpha_bits": "16" if alpha else "0"}
            codec, form = "prores_ks", "yuv422p10le" if config.prores != "4444" else "yuv444p10le"
            form = "yuva444p10le" if alpha else form
        else:
            # one thread a core, but the same bytes whatever their number
            parameters = "threads=4:sliced-threads=0" + (":mbtree=0" if min(width, height) < SMALL else "")
            options = {"crf": str(config.crf), "preset": config.preset, "x264-params": parameters}
            codec, form = "libx264", "yuv420p"
        self._stream = self._container.add_stream(codec, rate=rate, options=options)
        self._stream.width, self._stream.height, self._stream.pix_fmt = width, height, form
        context = self._stream.codec_context
        context.time_base = 1 / rate
        # Rec.709's matrix, limited range, sRGB's transfer as near as the list has it
        context.colorspace = context.color_primaries = context.color_trc = 1
        context.color_range = 1

    @contextmanager
    def _refusals(self) -> Iterator[None]:
        """Turn what FFmpeg raises into errors of the system, or of ours."""
        import av

        try:
            yield
        except (av.error.FFmpegError, OSError) as error:
            if error.errno in FULL or error.errno == errno.EFBIG:
                raise OSError(error.errno, os.strerror(error.errno)) from None
            reason = error.strerror or str(error)
            raise ClsplatError(f"{self._path}: cannot be written: {reason}") from None

    def finish(self) -> None:
        """Write what the encoder still holds, to the disk. Raises InputError for a video of no frames."""
        if self.frames == 0:
            raise InputError(f"{self._path}: a video of no frames, expected at least one")
        with self._refusals():
            self._container.mux(self._stream.encode(None))
            self._container.close()
            with open(self._temporary, "r+b") as file:  # Windows flushes only what may be written to
                os.fsync(file.fileno())

    def close(self) -> None:
        """Close the file, whatever is in it."""
        if self._container is not None:
            with suppress(Exception):  # it is closed if all went well; else what it says is not the reason
                self._container.close()
