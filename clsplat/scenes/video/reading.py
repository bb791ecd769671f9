# SPDX-License-Identifier: Apache-2.0
"""Decoding of videos with PyAV (`pip install 'clsplat[video]'`): facts of the file, and its frames in display order."""

from __future__ import annotations

import re
from collections.abc import Iterator
from contextlib import contextmanager
from dataclasses import dataclass, field, replace
from fractions import Fraction
from pathlib import Path
from typing import Any

import numpy as np

from clsplat.errors import InputError
from clsplat.files.documents import open_input
from clsplat.images.video import video_missing
from clsplat.scenes.video.colours import Coding, Planes

VIDEO_INPUT_SUFFIXES = (".mp4", ".mov", ".m4v", ".mkv", ".webm", ".avi", ".mts", ".m2ts", ".3gp", ".mpg", ".mpeg")
"""Lower-case extensions of the videos that a search in folders finds, and that may be given in place of a folder."""
VIDEO_CONTAINERS = "mov,mp4,m4a,3gp,3g2,mj2,matroska,webm,avi,mpegts,mpeg"
"""FFmpeg's names of the containers that are read. Playlists are not among them, because they name other files or
network addresses."""
SD_HEIGHT_PX = 576
"""Shorter side in pixels up to which a video's luma matrix is taken as Rec.601 if the file does not name one."""
MIN_VIDEO_SIDE_PX = 32
"""Smallest side in pixels of a video whose motion can be measured."""
MAX_VIDEO_PIXELS = 1 << 27
"""Largest number of pixels of a video's frame: 16384 x 8192. A decoder keeps several frames in memory."""

_ISO6709 = re.compile(r"([+-]\d+(?:\.\d*)?)([+-]\d+(?:\.\d*)?)([+-]\d+(?:\.\d*)?)?(?:CRS[^/]*)?/?\s*\Z")
_PLACE_KEYS = ("com.apple.quicktime.location.ISO6709", "location", "location-eng")
_TIME_KEYS = ("com.apple.quicktime.creationdate", "creation_time", "date")
_MAKE_KEYS = ("com.apple.quicktime.make", "com.android.manufacturer", "make")
_MODEL_KEYS = ("com.apple.quicktime.model", "com.android.model", "model")
_RGB = re.compile(r"gbr|[a0x]?(rgb|bgr)|pal8")
"""Beginnings of FFmpeg's names of pixel formats of RGB."""
_PLANAR = re.compile(r"yuvj?(420|422|444)p(?:(10|12|16)le)?\Z")


def is_video_name(path: Path) -> bool:
    """Return True if the extension is one of VIDEO_INPUT_SUFFIXES."""
    return path.suffix.lower() in VIDEO_INPUT_SUFFIXES


@dataclass(frozen=True)
class VideoFacts:
    """Facts from the header of a video.

    width, height: size in pixels of the stored pictures, or of the upright ones in the result of `turned`.
    seconds: length by the header; None if the header does not have it.
    frames: number of frames by the header; 0 if the header does not have it.
    codec: FFmpeg's name of the codec.
    coding: how the pixels are coded.
    place: latitude and longitude in degrees, and altitude in metres if it is known; empty if the file has no place.
    time: when the video was recorded, as text of the file; "" if the file lacks it.
    make, model: the camera's, as text of the file; "" if the file lacks them.
    """

    width: int
    height: int
    seconds: float | None
    frames: int
    codec: str
    coding: Coding
    place: tuple[float, ...] = ()
    time: str = ""
    make: str = ""
    model: str = ""

    def turned(self, quarter_turns: int) -> VideoFacts:
        """Return the facts with the size of the picture after quarter turns."""
        if quarter_turns % 2 == 0:
            return self
        return replace(self, width=self.height, height=self.width)


@dataclass(frozen=True, eq=False)
class VideoFrame:
    """A decoded frame.

    index: number of the frame in display order, from 0.
    seconds: time since the first frame.
    quarter_turns: number of counter-clockwise quarter turns that bring the stored picture upright.
    whole: False if the decoder had to conceal errors.
    raw: PyAV's frame.
    """

    index: int
    seconds: float
    quarter_turns: int
    whole: bool
    raw: Any

    def planes(self) -> Planes:
        """Return luma and chroma as stored: views of the decoder's memory, which are valid while this frame exists."""
        return _planes(self.raw)

    def luma(self) -> np.ndarray[Any, Any]:
        """Return the luma plane as stored (H, W), uint8 or uint16."""
        return _planes(self.raw).y


@dataclass
class VideoReader:
    """A video that is open for reading. `trouble` lists the damage that was found, for messages."""

    path: Path
    facts: VideoFacts
    trouble: list[str] = field(default_factory=list)
    _container: Any = None
    _stream: Any = None

    def frames(self) -> Iterator[VideoFrame]:
        """Decode the frames in display order. Damaged packets are skipped, and `trouble` names them."""
        import av

        first: float | None = None
        last: float | None = None
        index = 0
        packets = self._container.demux(self._stream)
        while True:
            try:
                packet = next(packets)
            except StopIteration:
                break
            except (av.error.FFmpegError, OSError) as error:
                self.trouble.append(_reason(error))
                break
            try:
                decoded = packet.decode()
            except (av.error.FFmpegError, ValueError) as error:
                if packet.size:  # an empty packet asks the decoder for its last frames
                    self.trouble.append(_reason(error))
                continue
            for raw in decoded:
                at = _seconds(raw, last, self._stream)
                first = at if first is None else first
                last = at
                yield VideoFrame(index, at - first, _quarter_turns(raw), not getattr(raw, "is_corrupt", False), raw)
                index += 1


@contextmanager
def open_video(path: Path) -> Iterator[VideoReader]:
    """Open a video as a context manager.

    Raises InputError if PyAV is missing, or the file is missing, is not a video, has no pictures, or has a codec that
    PyAV does not decode.
    """
    if reason := video_missing():
        raise InputError(f"{path}: {reason}")
    import av

    kinds = " ".join(VIDEO_INPUT_SUFFIXES)
    with open_input(path, "a video") as file:
        try:
            # the open file, not its name, because FFmpeg takes some names for network addresses or patterns
            container = av.open(file, metadata_errors="replace", options={"format_whitelist": VIDEO_CONTAINERS})
        except (av.error.FFmpegError, OSError, ValueError) as error:
            raise InputError(
                f"{path}: cannot be read as a video ({_reason(error)}), expected a complete file of a kind in {kinds}"
            ) from None
        with container:
            streams = [stream for stream in container.streams.video if not _is_cover(stream)]
            if not streams:
                found = ", ".join(sorted({stream.type for stream in container.streams})) or "no streams"
                raise InputError(f"{path}: has no video stream (only {found}), expected a video with pictures")
            stream = streams[0]
            yield VideoReader(path, _facts(path, container, stream), [], container, _prepared(path, stream))


def _prepared(path: Path, stream: Any) -> Any:
    """Check a video stream's codec and size, and let its decoder use all cores. Returns the stream."""
    context = stream.codec_context
    if context is None:
        raise InputError(f"{path}: has a codec that PyAV does not decode, expected H.264, HEVC, AV1, VP9 or ProRes")
    if min(context.width, context.height) < MIN_VIDEO_SIDE_PX:
        raise InputError(
            f"{path}: its pictures are {context.width}x{context.height}, expected at least {MIN_VIDEO_SIDE_PX} pixels "
            "a side"
        )
    if context.width * context.height > MAX_VIDEO_PIXELS:
        raise InputError(
            f"{path}: its pictures are {context.width}x{context.height}, expected at most {MAX_VIDEO_PIXELS:,} pixels"
        )
    context.thread_type = "AUTO"
    return stream


def _is_cover(stream: Any) -> bool:
    """Return True if a video stream is a still picture, such as the cover of a sound file."""
    disposition = getattr(stream, "disposition", 0)
    return bool(int(getattr(disposition, "value", disposition)) & 0x400)


def _reason(error: Exception) -> str:
    return str(getattr(error, "strerror", "") or error or type(error).__name__)


def _facts(path: Path, container: Any, stream: Any) -> VideoFacts:
    context = stream.codec_context
    if context is None:
        raise InputError(f"{path}: has a codec that PyAV does not decode, expected H.264, HEVC, AV1, VP9 or ProRes")
    known = {**container.metadata, **stream.metadata}
    length = stream.duration * stream.time_base if stream.duration else None
    if length is None and container.duration:
        length = Fraction(container.duration, 1_000_000)
    return VideoFacts(
        width=context.width,
        height=context.height,
        seconds=None if length is None else float(length),
        frames=stream.frames,
        codec=context.name,
        coding=_coding(context),
        place=parse_place(_first(known, _PLACE_KEYS)),
        time=_first(known, _TIME_KEYS),
        make=_first(known, _MAKE_KEYS),
        model=_first(known, _MODEL_KEYS),
    )


def _first(known: dict[str, str], keys: tuple[str, ...]) -> str:
    return next((known[key].strip() for key in keys if known.get(key)), "")


def parse_place(text: str) -> tuple[float, ...]:
    """Parse latitude, longitude and, if given, altitude from a text as in ISO 6709. Empty for any other text.

    Phones write degrees with decimals, as in +48.8577+002.2950+035.000/.
    """
    found = _ISO6709.match(text.strip())
    if not found:
        return ()
    place = tuple(float(number) for number in found.groups() if number is not None)
    return place if abs(place[0]) <= 90 and abs(place[1]) <= 180 else ()


def _coding(context: Any) -> Coding:
    """Return how a stream's pixels are coded, by the numbers of ISO/IEC 23091-2 (H.273) in its header."""
    form = context.pix_fmt or ""
    matrix = int(context.colorspace or 2)
    if _RGB.match(form):
        matrix = 6  # by which FFmpeg converts RGB in `_planes`
    elif matrix in (0, 2, 3):  # RGB, unknown, reserved
        matrix = 6 if min(context.width, context.height) <= SD_HEIGHT_PX else 1
    return Coding(
        matrix=matrix,
        primaries=int(context.color_primaries or 2),
        transfer=int(context.color_trc or 2),
        full_range=form.startswith("yuvj") or int(context.color_range or 0) == 2,
    )


def _seconds(raw: Any, last: float | None, stream: Any) -> float:
    """Return the time in seconds of PyAV's frame `raw`. Times never fall.

    A frame without a time, or with an earlier one than `last`, is one frame duration after `last`. Times begin anew in
    files that were joined, as cameras' .mts files often are.

    last: time of the frame before; None for the first frame.
    """
    if raw.pts is not None and raw.time_base is not None:
        at = float(raw.pts * raw.time_base)
        if last is None or at >= last:
            return at
    return 0.0 if last is None else last + float(1 / Fraction(stream.average_rate or 25))


def _quarter_turns(raw: Any) -> int:
    """Return the counter-clockwise quarter turns in the file's display matrix, whose angle is rounded to them."""
    return int(round(raw.rotation / 90) % 4)


def _planes(raw: Any) -> Planes:
    form = raw.format.name
    found = _PLANAR.match(form)
    if found is None:  # packed, RGB, grey or another rare layout: FFmpeg converts it
        raw = raw.reformat(format="yuv444p16le" if raw.format.components[0].bits > 8 else "yuv444p")
        found = _PLANAR.match(raw.format.name)
        assert found is not None
    bits = int(found[2] or 8)
    dtype = np.dtype("<u2" if bits > 8 else "u1")
    y, cb, cr = (
        np.frombuffer(plane, dtype).reshape(plane.height, plane.line_size // dtype.itemsize)[:, : plane.width]
        for plane in raw.planes
    )
    return Planes(y, cb, cr, bits)
