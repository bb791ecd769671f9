# SPDX-License-Identifier: Apache-2.0
"""Writing of image files (PNG, EXR and others) with OpenImageIO, atomically: a failure leaves the earlier file.

Depth, compression and quality of files: `Encoding` in `config/pictures.py`.
"""

from __future__ import annotations

import os
from collections.abc import Callable, Iterable, Iterator, Sequence
from concurrent.futures import ThreadPoolExecutor
from pathlib import Path
from typing import Any

import numpy as np
import OpenImageIO as oiio
from numpy.typing import NDArray

from clsplat.errors import ClsplatError, InputError, plain
from clsplat.files.atomic import atomic_name, require_room, room_error
from clsplat.files.names import native_name
from clsplat.images.alpha import associate
from clsplat.images.reading import decodes, one_line, opened, png_is_whole

CHANNEL_NAMES_BY_COUNT = {1: ("Y",), 3: ("R", "G", "B"), 4: ("R", "G", "B", "A")}
"""Names of an image's channels in a file, by the number of channels."""


def write_image(path: Path, image: NDArray[Any]) -> None:
    """Write an image, atomically: 8-bit PNG or float EXR, by the extension.

    image: (H, W) or (H, W, C), C = 1, 3 or 4, with straight alpha; uint8 or floats. For a PNG, floats are clipped to
      [0, 1] and rounded. The colour space is not converted (`images/colour.py` does that).
    Raises InputError for another extension or a missing folder, ClsplatError if writing fails, as on a full disk. After
    a failure an earlier file is intact, and no temporary file is left.
    """
    path = Path(path)
    extension = path.suffix.lower()
    if extension not in (".png", ".exr"):
        raise InputError(f"{path}: has the extension {extension or 'none'!r}, expected .png or .exr")
    if not path.parent.is_dir():
        raise InputError(f"{path.parent}: no such folder to write {path.name} to")
    pixels = np.asarray(image)
    pixels = pixels[:, :, None] if pixels.ndim == 2 else pixels
    if pixels.ndim != 3 or pixels.shape[2] not in CHANNEL_NAMES_BY_COUNT or 0 in pixels.shape:
        raise ValueError(f"image has the shape {np.shape(image)}, expected (H, W), (H, W, 1), (H, W, 3) or (H, W, 4)")
    if pixels.dtype == np.uint8:
        pixels = pixels.astype(np.float32) / np.float32(255)
    pixels = pixels.astype(np.float32)

    is_png = extension == ".png"
    if is_png:
        pixels = steps_of([pixels], 8)
    elif pixels.shape[2] == 4:
        pixels = associate(pixels)
    height, width, channels = pixels.shape
    spec = oiio.ImageSpec(width, height, channels, oiio.UINT8 if is_png else oiio.FLOAT)
    spec.channelnames = CHANNEL_NAMES_BY_COUNT[channels]
    if is_png:
        spec.attribute("oiio:UnassociatedAlpha", 1)
    write_spec(path, [np.ascontiguousarray(pixels)], [spec], extension[1:])


def steps_of(planes: Sequence[NDArray[Any]], bits: int) -> NDArray[Any]:
    """Quantise planes (H, W, C) to integers and interleave them: [0, 1] becomes 0 to 2^bits - 1, NaN becomes 0.

    The loop is over channels, because a pass over interleaved channels takes several times as long.
    """
    height, width = planes[0].shape[:2]
    whole = np.empty((height, width, sum(plane.shape[2] for plane in planes)), np.uint8 if bits == 8 else np.uint16)
    # float64, because float32 would round 16-bit values twice
    scratch = np.empty((height, width), np.float32 if bits == 8 else np.float64)
    most = scratch.dtype.type(2**bits - 1)
    channels = (plane[:, :, channel] for plane in planes for channel in range(plane.shape[2]))
    for at, channel in enumerate(channels):
        np.fmin(np.fmax(channel, 0, out=scratch), 1, out=scratch)
        np.multiply(scratch, most, out=scratch)
        whole[:, :, at] = np.rint(scratch, out=scratch)
    return whole


def write_spec(path: Path, parts: Sequence[NDArray[Any]], specs: Sequence[Any], kind: str) -> None:
    """Write an image file of one or more parts, atomically. Raises ClsplatError if writing fails.

    parts, specs: pixels (H, W, C) and OpenImageIO specification of each part.
    kind: the file's extension without the dot.
    """

    def steps(file: Any, name: str) -> Iterator[bool]:
        for index, pixels in enumerate(parts):
            yield index == 0 or file.open(name, specs[index], "AppendSubimage")
            yield file.write_image(pixels)

    _write(path, specs, kind, steps)


def write_rows(path: Path, spec: Any, kind: str, pieces: Iterable[tuple[Any, int]]) -> None:
    """Write an image file of one part, atomically, in pieces of consecutive rows, the top rows first.

    kind: the file's extension without the dot.
    pieces: pixels or OpenImageIO's deep data, each with its number of rows. The next piece is requested while the last
      deep piece is being written.
    Raises ClsplatError if writing fails.
    """
    reasons: list[str] = []

    def steps(file: Any, _: str) -> Iterator[bool]:
        row = spec.y
        if not spec.deep:
            for pixels, count in pieces:
                yield file.write_scanlines(row, row + count, 0, pixels)
                row += count
            return

        def written(row: int, count: int, pixels: Any) -> bool:
            done = bool(file.write_deep_scanlines(row, row + count, 0, pixels))
            if not done:
                reasons.append(file.geterror())  # OpenImageIO reports the error to this thread only
            return done

        # Write in a thread: compression of a piece takes longer than rendering the next one for most frames.
        with ThreadPoolExecutor(1) as pool:
            under_way = None
            for pixels, count in pieces:
                if under_way is not None:
                    yield under_way.result()
                under_way = pool.submit(written, row, count, pixels)
                row += count
            if under_way is not None:
                yield under_way.result()

    _write(path, [spec], kind, steps, reasons)


def _write(
    path: Path,
    specs: Sequence[Any],
    kind: str,
    steps: Callable[[Any, str], Iterable[bool]],
    reasons: Sequence[str] = (),
) -> None:
    """Write an image file, atomically, and check that it is complete.

    specs: OpenImageIO specification of each part of the file.
    kind: the file's extension without the dot.
    steps: generator function that writes the pixels, given OpenImageIO's open file and the file's name. After each call
        of OpenImageIO that writes, it yields whether the call succeeded.
    reasons: messages of calls that failed in another thread.
    """
    # Before a JPEG is written, disk space is checked, because libjpeg ends the process if it cannot write.
    most = jpeg_room(specs[0]) if kind in ("jpg", "jpeg") else 0
    with atomic_name(path) as temporary:
        file: Any = oiio.ImageOutput.create(kind)
        name = native_name(temporary)
        try:
            with require_room(path, most):
                # OpenImageIO needs the specifications of all parts to open the file.
                opens = file.open(name, specs[0] if len(specs) == 1 else tuple(specs))
                written = opens and all(steps(file, name)) and file.close()
            # A full disk may lose the last bytes without an error.
            if written and _is_whole(temporary, kind, len(specs)):
                if kind == "dpx":
                    _without_name(temporary)
                return
            reason = "the file is incomplete" if written else "; ".join(reasons) or file.geterror()
            if error := room_error(temporary.parent):  # OpenImageIO seldom reports a full disk as such
                raise OSError(error.errno, error.strerror)
            raise ClsplatError(f"{path}: cannot be written: {plain(one_line(reason))}")
        finally:
            file.close()


_DPX_FILE_NAME_BYTES = slice(36, 136)
"""Bytes of a DPX header that hold the file name (SMPTE ST 268)."""


def _without_name(path: Path) -> None:
    """Clear the path that OpenImageIO writes to a DPX header, so that equal frames have equal bytes."""
    with open(path, "r+b") as file:
        file.seek(_DPX_FILE_NAME_BYTES.start)
        file.write(bytes(_DPX_FILE_NAME_BYTES.stop - _DPX_FILE_NAME_BYTES.start))
        file.flush()
        os.fsync(file.fileno())


def _is_whole(path: Path, kind: str, parts: int) -> bool:
    """Return True if a written image is complete: all chunks of a PNG, or the last row in other formats."""
    if kind == "png":
        return png_is_whole(path)
    with opened(path) as source:
        return source is not None and all(
            source.seek_subimage(part, 0) and decodes(source, part, source.spec().height - 1) for part in range(parts)
        )


def jpeg_room(spec: Any) -> int:
    """Return an upper bound in bytes of a JPEG with this OpenImageIO specification."""
    return int(spec.width * spec.height * spec.nchannels * 5 // 4) + (1 << 16)
