# SPDX-License-Identifier: Apache-2.0
"""Writing of videos frame by frame: .mp4 (H.264) or .mov (ProRes), with PyAV (`pip install 'clsplat[video]'`).

The settings of a video are in `config.pictures`: `VideoConfig` and DEFAULT_VIDEO_FPS.
"""

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

from clsplat.config.pictures import DEFAULT_VIDEO_FPS, VIDEO_SUFFIXES, ProRes, VideoConfig
from clsplat.errors import ClsplatError, InputError
from clsplat.files.atomic import DISK_FULL_ERRNOS, atomic_name
from clsplat.files.documents import is_file
from clsplat.files.names import native_name
from clsplat.images.alpha import unassociate
from clsplat.images.colour import REC709_LUMA_WEIGHTS
from clsplat.images.frame_files import parse_record

_BLUE_CHROMA_RANGE, _RED_CHROMA_RANGE = (np.float32(2 * (1 - REC709_LUMA_WEIGHTS[index])) for index in (2, 0))
"""Divisors of B - Y and R - Y (Rec.709) that make chroma range from -0.5 to 0.5."""


VideoPlanes = NDArray[np.uint8] | tuple[NDArray[np.uint16], ...]
"""Planes of luma, chroma and alpha of a frame to encode: the result of `frame_planes` or `prores_planes`."""
_PRORES_PROFILES: dict[ProRes, str] = {"422": "standard", "hq": "hq", "4444": "4444"}
"""FFmpeg's names of the ProRes profiles."""


def video_missing() -> str:
    """Return the reason, in one line, why this installation cannot write videos; '' if it can."""
    try:
        import av  # noqa: F401
    except ImportError:
        return "video needs PyAV, which is not installed: pip install 'clsplat[video]'"
    return ""


MBTREE_MIN_SIDE_PX = 128
"""x264's macroblock tree (mbtree) is switched off for videos whose shorter side is below this number of pixels.

With the tree, the bytes of small videos vary. On a busy machine, up to 102 of 250 encodings of a 48x40 video differed,
but none of 225 of a 320x240 video. In a larger video the tree saves a quarter of the bytes.
"""


MAX_VIDEO_SIDE_PX = 16384
"""Largest side of a video in pixels: x264's MAX_RESOLUTION."""
MAX_VIDEO_MEGAPIXELS = 260
"""Largest frame of a video in megapixels, as error messages give it. FFmpeg's exact limit (av_image_check_size) is
8 (width + 128) (height + 128) < 2^31."""


def video_record(path: Path, frames: int | None = None) -> dict[str, str]:
    """Return the provenance attributes that a video records; empty if the file is not a video or has no record.

    frames: expected number of frames. The result is also empty if the video has another number or is incomplete.
    """
    import av

    if not is_file(path):
        return {}
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
    """Raise InputError if this installation cannot write a video at `path`."""
    if path.suffix.lower() not in VIDEO_SUFFIXES:
        raise InputError(f"{path}: has the extension {path.suffix or 'none'!r}, expected {' or '.join(VIDEO_SUFFIXES)}")
    if reason := video_missing():
        raise InputError(f"{path}: {reason}")
    if not path.parent.is_dir():
        raise InputError(f"{path.parent}: no such folder to write {path.name} to")


def check_codec(path: str, config: VideoConfig, channels: Collection[str]) -> None:
    """Raise InputError if `config` has settings of a codec that the video does not use, or if `channels` contain alpha
    and the video's codec cannot hold it. The extension of `path` determines the codec: .mp4 is H.264, .mov is ProRes.
    """
    usual = VideoConfig()
    if Path(path).suffix.lower() == ".mp4":
        if config.prores != usual.prores:
            raise InputError(f"--video.prores {config.prores}: applies to ProRes only, expected a .mov, not {path}")
        return
    for name in ("crf", "preset"):
        if getattr(config, name) != getattr(usual, name):
            value = getattr(config, name)
            raise InputError(f"--video.{name} {value}: applies to H.264 only, expected an .mp4, not {path}")
    if "alpha" in channels and config.prores != "4444":
        raise InputError(f"{path}: ProRes {config.prores} cannot hold alpha, expected --video.prores 4444")


def check_size(path: Path, width: int, height: int) -> None:
    """Raise InputError if frames are larger than the encoder accepts."""
    if max(width, height) > MAX_VIDEO_SIDE_PX or 8 * (width + 128) * (height + 128) >= 1 << 31:
        raise InputError(
            f"{path}: its frames are {width}x{height}, expected at most {MAX_VIDEO_SIDE_PX:,} pixels a side and "
            f"{MAX_VIDEO_MEGAPIXELS} megapixels in a video; give a smaller --width, or write pictures"
        )


def frame_planes(image: NDArray[Any]) -> NDArray[np.uint8]:
    """Return planes (3 H / 2, W) of a frame for H.264: luma, and below it chroma at half the size, as PyAV expects.

    H and W are rounded up to even numbers. Colours are Rec.709 in limited range, with chroma sited left as in H.264.
    FFmpeg's own conversion is not used, because its result is darker by one level.

    image: (H, W, 3), display values as floats, clipped to [0, 1], NaN as 0; or as uint8.
    Raises ValueError for another shape.
    """
    pixels = np.asarray(image)
    if pixels.ndim != 3 or pixels.shape[2] != 3 or 0 in pixels.shape:
        raise ValueError(f"frame has the shape {pixels.shape}, expected (H, W, 3)")
    values = pixels / np.float32(255) if pixels.dtype == np.uint8 else np.clip(np.nan_to_num(pixels), 0, 1)
    rgb = values.astype(np.float32, copy=False)
    height, width, _ = rgb.shape
    rgb = np.pad(rgb, ((0, height % 2), (0, width % 2), (0, 0)), mode="edge")
    luma = rgb @ np.array(REC709_LUMA_WEIGHTS, np.float32)
    chroma = np.stack([(rgb[:, :, 2] - luma) / _BLUE_CHROMA_RANGE, (rgb[:, :, 0] - luma) / _RED_CHROMA_RANGE])
    chroma = 0.5 * (chroma[:, 0::2] + chroma[:, 1::2])
    chroma = _left_sited(chroma)
    flat = np.concatenate([(16 + 219 * luma).ravel(), (128 + 224 * chroma).ravel()])
    return np.asarray(np.rint(flat).reshape(-1, luma.shape[1]), np.uint8)


def prores_planes(image: NDArray[Any], alpha: NDArray[Any] | None, prores: ProRes) -> tuple[NDArray[np.uint16], ...]:
    """Return 10-bit planes (H, W) of a frame for ProRes: luma, two planes of chroma, and alpha if it is given.

    Colours are Rec.709 in limited range, alpha is in full range. For 422 and hq, chroma has half the width and is sited
    left, and the width is rounded up to an even number.

    image: (H, W, 3), display values as floats, clipped to [0, 1], NaN as 0.
    alpha: (H, W), by which `image` is premultiplied; None for opaque videos. The file stores straight alpha.
    """
    rgb = np.nan_to_num(np.asarray(image, np.float32))
    if alpha is not None:
        rgba = unassociate(np.concatenate([rgb, np.nan_to_num(np.asarray(alpha, np.float32))[:, :, None]], axis=2))
        rgb, alpha = rgba[:, :, :3], np.clip(rgba[:, :, 3], 0, 1)
    rgb = np.clip(rgb, 0, 1)
    if prores != "4444":
        rgb = np.pad(rgb, ((0, 0), (0, rgb.shape[1] % 2), (0, 0)), mode="edge")
    luma = rgb @ np.array(REC709_LUMA_WEIGHTS, np.float32)
    chroma = np.stack([(rgb[:, :, 2] - luma) / _BLUE_CHROMA_RANGE, (rgb[:, :, 0] - luma) / _RED_CHROMA_RANGE])
    if prores != "4444":
        chroma = _left_sited(chroma)
    planes = [64 + 876 * luma, *(512 + 896 * chroma)]
    planes += [] if alpha is None else [1023 * alpha]
    return tuple(np.ascontiguousarray(np.rint(plane), np.uint16) for plane in planes)


def _left_sited(chroma: NDArray[Any]) -> NDArray[Any]:
    """Halve the width of chroma (2, H, W), sited left: weights 1/4, 1/2, 1/4 around every second sample."""
    left = np.concatenate([chroma[:, :, :1], chroma[:, :, 1:-1:2]], axis=2)
    return np.asarray(0.25 * (left + chroma[:, :, 1::2]) + 0.5 * chroma[:, :, 0::2])


def planes_of(path: Path, image: NDArray[Any], alpha: NDArray[Any] | None, prores: ProRes) -> VideoPlanes:
    """Convert a frame to planes: by `prores_planes` if the video's `path` ends in .mov, else by `frame_planes`."""
    return prores_planes(image, alpha, prores) if path.suffix.lower() == ".mov" else frame_planes(image)


def rate_of(fps: float) -> Fraction:
    """Convert a frame rate to a fraction for a video file. Rounded NTSC rates become exact: 23.976 is 24000/1001."""
    whole = round(fps * 1.001)
    ntsc = Fraction(1000 * whole, 1001)
    near = 5e-3 if whole % 24 == 0 or whole % 30 == 0 else 1e-4
    if fps != round(fps) and abs(float(ntsc) - fps) < near:
        return ntsc
    return Fraction(fps).limit_denominator(1001)


@contextmanager
def video_writer(path: Path, config: VideoConfig | None = None, comment: str = "") -> Iterator[VideoWriter]:
    """Yield a writer of a video, as a context manager. If the block succeeds, the video replaces the file `path`.

    comment: provenance record for the header.
    Raises InputError for an extension other than .mp4 and .mov, a missing folder, a video without frames, or a missing
    PyAV.
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
    """Return a PyAV frame with these planes, luma first. form: FFmpeg's name of the frame's pixel format."""
    import av

    height, width = planes[0].shape
    frame = av.VideoFrame(width, height, form)
    for plane, values in zip(frame.planes, planes, strict=True):
        lines = np.zeros((values.shape[0], plane.line_size // 2), np.uint16)
        lines[:, : values.shape[1]] = values
        plane.update(lines)
    # The code 1 is Rec.709 for the first three, and limited range for color_range. The ProRes encoder writes these
    # codes to the header of each frame.
    frame.colorspace = frame.color_primaries = frame.color_trc = frame.color_range = 1
    return frame


class VideoWriter:
    """Writes a video frame by frame, in order.

    H.264 has 8 bits, 4:2:0, in Rec.709's limited range. Its sizes are even, so an odd last column or row is repeated.
    ProRes has 10 bits, 4:2:2 or 4:4:4.
    """

    def __init__(self, path: Path, temporary: Path, config: VideoConfig, comment: str = "") -> None:
        """Prepare the writer; the first frame opens the file.

        path: final name of the video, for its codec and for messages.
        temporary: name of the file while it is being written.
        comment: text for the file's header.
        """
        self._path, self._temporary, self._config, self._comment = path, temporary, config, comment
        self._container: Any = None
        self._stream: Any = None
        self._size = (0, 0)
        self.frames = 0

    def add(self, planes: VideoPlanes) -> None:
        """Append a frame, given its planes from `planes_of`. All frames must have the same size and planes.

        Raises ClsplatError if writing fails, ValueError for a frame of another size.
        """
        import av

        whole = isinstance(planes, tuple)
        height, width = planes[0].shape if isinstance(planes, tuple) else (planes.shape[0] * 2 // 3, planes.shape[1])
        size = height, width
        if self.frames and size != self._size:
            raise ValueError(f"frame is {width}x{height}, expected {self._size[1]}x{self._size[0]} like the first one")
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
        rate = rate_of(DEFAULT_VIDEO_FPS if config.fps is None else config.fps)
        kind = self._path.suffix.lower()[1:]
        self._container = av.open(native_name(self._temporary), "w", format=kind, options={"movflags": "+faststart"})
        if self._comment:
            self._container.metadata["comment"] = self._comment
        if kind == "mov":
            # Apple's programs expect Apple's vendor code. Alpha of 16 bits keeps all 10 bits of the plane.
            options = {
                "profile": _PRORES_PROFILES[config.prores],
                "vendor": "apl0",
                "alpha_bits": "16" if alpha else "0",
            }
            codec, form = "prores_ks", "yuv422p10le" if config.prores != "4444" else "yuv444p10le"
            form = "yuva444p10le" if alpha else form
        else:
            # The number of threads is fixed, so that every machine writes the same bytes.
            parameters = "threads=4:sliced-threads=0" + (":mbtree=0" if min(width, height) < MBTREE_MIN_SIDE_PX else "")
            options = {"crf": str(config.crf), "preset": config.preset, "x264-params": parameters}
            codec, form = "libx264", "yuv420p"
        self._stream = self._container.add_stream(codec, rate=rate, options=options)
        self._stream.width, self._stream.height, self._stream.pix_fmt = width, height, form
        context = self._stream.codec_context
        context.time_base = 1 / rate
        # The code 1 means Rec.709 (its transfer function is close to sRGB's), in color_range limited range.
        context.colorspace = context.color_primaries = context.color_trc = 1
        context.color_range = 1

    @contextmanager
    def _refusals(self) -> Iterator[None]:
        """Convert FFmpeg's errors in the block to OSError (disk full or file too large) or ClsplatError."""
        import av

        try:
            yield
        except (av.error.FFmpegError, OSError) as error:
            if error.errno in DISK_FULL_ERRNOS or error.errno == errno.EFBIG:
                raise OSError(error.errno, os.strerror(error.errno)) from None
            reason = error.strerror or str(error)
            raise ClsplatError(f"{self._path}: cannot be written: {reason}") from None

    def finish(self) -> None:
        """Flush the encoder and the file to disk. Raises InputError for a video without frames."""
        if self.frames == 0:
            raise InputError(f"{self._path}: the video has no frames, expected at least one")
        with self._refusals():
            self._container.mux(self._stream.encode(None))
            self._container.close()
            with open(self._temporary, "r+b") as file:  # Windows flushes only files opened for writing
                os.fsync(file.fileno())

    def close(self) -> None:
        """Close the file, complete or not."""
        if self._container is not None:
            with suppress(Exception):  # an error here would hide an earlier error, which is the cause
                self._container.close()
