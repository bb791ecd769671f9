# SPDX-License-Identifier: Apache-2.0
"""Reading of images with OpenImageIO, resampling, and the search for images in folders.

In memory an image is float32 (H, W, C), C = 3 (RGB) or 4 (RGBA), in the file's own colour space; nothing is linearised.
Only photographs in Display P3 and Adobe RGB are converted, to sRGB.
Alpha in memory is always straight (unassociated). In files it is straight in PNG, premultiplied (associated) in EXR.
"""

from __future__ import annotations

import os
import re
import struct
from collections.abc import Iterable, Iterator
from contextlib import contextmanager
from pathlib import Path
from typing import Any

import numpy as np
import OpenImageIO as oiio

from clsplat.arrays import Float32
from clsplat.errors import InputError, examples, reason_of
from clsplat.files.documents import is_file, open_input
from clsplat.files.names import native_name
from clsplat.images.alpha import associate, unassociate
from clsplat.images.decoders.colour_profiles import in_srgb
from clsplat.images.decoders.orientation import turned
from clsplat.images.decoders.photo_decoders import (
    DECODED_PHOTO_EXTENSIONS,
    LOSSY_PHOTO_FORMATS,
    PHOTO_HEAD_BYTES,
    decoder_of,
    without_converted,
    wrong_contents,
)

IMAGE_SUFFIXES = (
    *(".png", ".jpg", ".jpeg", ".exr", ".tif", ".tiff", ".webp", ".bmp", ".hdr", ".tga", ".ppm", ".pgm"),
    *DECODED_PHOTO_EXTENSIONS,
)
"""Lower-case extensions of the images that a search in folders finds. A file given by name may have any extension."""

PNG_SIGNATURE = b"\x89PNG\r\n\x1a\n"
MAX_IMAGE_PIXELS = 1 << 28
"""Largest number of pixels of an image that is read."""
MAX_UNCHECKED_CHANNEL_VALUES, MAX_CHANNEL_VALUES_PER_BYTE = 48 << 20, 4096
"""Limits of the values (pixels times channels) that an image may have: a number for all files, and a number for each
byte of the file. The larger of the two limits applies.

No real image has more values per byte, as deflate expands a byte to at most 1032 bytes.
"""
_DECODE_CHECK_ROWS = 64
"""Number of rows that `decodes` reads at a time."""
MAX_IMAGE_FILE_BYTES, MAX_UNSIGNED_IMAGE_BYTES = 1 << 30, 1 << 26
"""Largest image file in bytes, and largest file without one of IMAGE_SIGNATURES."""
IMAGE_SIGNATURES = (
    *(PNG_SIGNATURE, b"\xff\xd8\xff", b"\x76\x2f\x31\x01", b"II*\0", b"MM\0*", b"II+\0", b"MM\0+", b"BM", b"#?"),
    *(b"SDPX", b"XPDS", b"RIFF", b"P1", b"P2", b"P3", b"P4", b"P5", b"P6", b"PF", b"Pf"),
)
"""First bytes of image formats. A file over MAX_UNSIGNED_IMAGE_BYTES must start with one of them, because some decoders
read a whole file before they find that it is not in their format."""
HARMLESS_DECODER_NOTES = ("extraneous bytes",)
"""Parts of libjpeg's messages about superfluous data. Every other message means lost pixels."""


COMPANION_PATTERN = (
    r"(?:depths?|disp|disparity|normals?|alpha|albedo|masks?|mattes?|seg|segmentations?|semantics?|confidence|conf|flow"
    r"|edges?|silhouettes?|labels?)"
)
"""Words in names of files and folders that accompany photographs, such as masks and depth maps."""
FOREGROUND_PATTERN = r"(?:fg|foreground)"
"""Words in names of masks that are recognised only if a separator is between them and the photograph's name."""
_COMPANION_FOLDER = re.compile(rf"(?:\w+[_-])?{COMPANION_PATTERN}(?:[_-]\w+)?", re.IGNORECASE)
_COMPANION_AFTER = re.compile(
    rf"(?:[._-]?{COMPANION_PATTERN}|[._-]{FOREGROUND_PATTERN})(?:[._-]?(?:\d+|vis|map|raw|image))*", re.IGNORECASE
)
_COMPANION_BEFORE = re.compile(
    rf"(?:dynamic[._-])?(?:{COMPANION_PATTERN}|{FOREGROUND_PATTERN})(?:[._-]map)?[._-]", re.IGNORECASE
)
_COLOUR_SUFFIX = re.compile(r"[._-](?:colou?r|rgba?|image|img)\Z", re.IGNORECASE)


def companions(paths: Iterable[Path], pictures: Iterable[Path], folder: Path) -> set[Path]:
    """Return the files among `paths` that accompany one of the pictures: masks, depths, normals and the like.

    They are recognised by words such as mask or depth, in upper or lower case. One of these must hold:

    - The word follows a picture's name (r_0_depth_0001.png) or precedes it (mask_r_0.png).
    - The word replaces "color" (frame-1.color.jpg, frame-1.depth.png).
    - The name is a picture's full name with .png appended, as in COLMAP's masks.
    - The file is in a sub-folder of `folder` whose name has such a word.
    """
    pictures = list(pictures)

    def is_beside(path: Path) -> bool:
        inside = path.parent.relative_to(folder).parts if path.is_relative_to(folder) else ()
        return any(_COMPANION_FOLDER.fullmatch(part) for part in inside)

    folders = {picture.parent for picture in pictures}
    others = [picture for picture in pictures if not is_beside(picture)]
    pictures, alone = others or pictures, not others
    names = {picture.name.casefold() for picture in pictures}
    stems = {picture.stem.casefold() for picture in pictures} | names
    stems |= {_COLOUR_SUFFIX.sub("", stem) for stem in stems}
    return {
        path
        for path in paths
        if (is_beside(path) and not (path.parent in folders and (alone or path.stem.casefold() not in stems)))
        or _goes_with(path, names, stems)
    }


def _goes_with(path: Path, names: set[str], stems: set[str]) -> bool:
    stem = path.stem.casefold()
    if stem in names and path.suffix.lower() == ".png":
        return True
    before = _COMPANION_BEFORE.match(stem)
    if before and stem[before.end() :] in stems:
        return True
    return any(stem[:at] in stems and _COMPANION_AFTER.fullmatch(stem, at) for at in range(1, len(stem)))


def find_images(folder: Path, *, deep: bool = True) -> list[Path]:
    """Return sorted paths of the images in `folder`, recognised by extension. deep: search its sub-folders too.

    Hidden files, hidden folders and broken links are left out. Links to folders are followed, but each folder is
    searched only once. HEIC, AVIF and raw files are left out if their folder has the same picture in another format.
    Raises InputError for a folder that cannot be read.
    """
    paths: list[Path] = []
    seen: set[str] = set()
    for root, folders, files in os.walk(folder, followlinks=True, onerror=cannot_be_searched):
        real = os.path.realpath(root)  # not the inode, which is 0 for every folder on some file systems of Windows
        if real in seen:
            folders.clear()
            continue
        seen.add(real)
        folders[:] = sorted(name for name in folders if deep and not name.startswith("."))
        paths += [
            path
            for path in (Path(root, name) for name in files)
            if not path.name.startswith(".") and path.suffix.lower() in IMAGE_SUFFIXES and is_file(path)
        ]
    return sorted(without_converted(paths)[0])


def cannot_be_searched(error: OSError) -> None:
    """Raise InputError for a folder that cannot be read. `os.walk` calls this instead of skipping the folder."""
    why = reason_of(error)
    raise InputError(f"{error.filename}: cannot be searched for pictures: {why}; make it readable or move it away")


def image_size(path: Path, *, orient: bool = True) -> tuple[int, int]:
    """Return width and height of the image that `read_image` would return, from the header alone.

    Raises InputError if the file is missing, is not an image, or is a truncated PNG.
    """
    source = open_photograph(path)
    width, height = stored_size(path, source)
    is_turned = orient and _orientation(source.spec()) >= 5
    source.close()
    return (height, width) if is_turned else (width, height)


def stored_size(path: Path, source: Any) -> tuple[int, int]:
    """Return width and height of an open image before its EXIF orientation is applied; for EXR, of the display window.

    source: as from `open_image`. Raises InputError for a truncated PNG.
    """
    spec, kind = source.spec(), source.format_name()
    if kind == "png":
        _check_png_is_whole(path)
    return (spec.full_width, spec.full_height) if kind == "openexr" else (spec.width, spec.height)


def stored_range(path: Path) -> tuple[int, bool]:
    """Return the largest integer of an image's pixel type, 0 for floats, and True if its compression is lossless.

    Raises InputError if the file is missing, not an image, or has an implausible size.
    """
    source = open_photograph(path)
    dtype, kind = np.dtype(str(source.spec().format)), source.format_name()
    source.close()
    return (int(np.iinfo(dtype).max) if dtype.kind == "u" else 0), kind not in (
        "jpeg",
        "jpeg2000",
        "webp",
        *LOSSY_PHOTO_FORMATS,
    )


def read_image(path: Path, *, orient: bool = True) -> Float32:
    """Read an image as float32 (H, W, 3), or (H, W, 4) with straight alpha.

    Integers of 8 or 16 bits are scaled to [0, 1]; floats are kept, also above 1. Grey becomes RGB. Of an EXR, only R,
    G, B and A are read, on the whole display window.

    orient: apply the EXIF orientation. Use False for photographs of a COLMAP model: COLMAP (pycolmap 4.2.1) ignores the
      orientation, so its keypoints and camera sizes refer to the pixels as stored.

    Raises InputError, with the decoder's reason, if the file is missing, not an image, damaged or truncated. Also
    raises InputError for unsupported channels and non-finite values.
    """
    source = open_photograph(path)
    spec = source.spec()
    if source.format_name() == "png":
        _check_png_is_whole(path)
    pixels = source.read_image(oiio.FLOAT)
    reason = error_of(source)
    source.close()
    if pixels is None or (reason and not any(harmless in reason for harmless in HARMLESS_DECODER_NOTES)):
        raise InputError(f"{path}: does not decode: {one_line(reason)}; copy the picture again or leave it out")
    pixels = np.asarray(pixels, np.float32)
    if pixels.size != (expected := spec.height * spec.width * spec.nchannels):
        raise InputError(
            f"{path}: does not decode: has {pixels.size} values, expected {expected} as in its header; save it again"
        )
    pixels = pixels.reshape(spec.height, spec.width, spec.nchannels)
    image = _as_rgb(path, pixels, spec)
    if not np.isfinite(image).all():
        count = int(np.count_nonzero(~np.isfinite(image).all(axis=2)))
        raise InputError(f"{path}: has {count} pixels that are not finite; repair the picture or leave it out")
    if source.format_name() == "openexr":
        image = _display_window(image, spec)
    if image.shape[2] == 4 and not spec.get_int_attribute("oiio:UnassociatedAlpha", 0):
        image = unassociate(image)
    return np.ascontiguousarray(turned(image, _orientation(spec)) if orient else image)


def downscale(image: Float32, width: int, height: int) -> Float32:
    """Resample an image (H, W, C) to (height, width, C): each new pixel is the mean of the area that it covers.

    A partly covered pixel is weighted by its covered fraction. The image's corners stay in place, as in
    `Camera.resized`. An axis that grows is interpolated linearly. The mean is of premultiplied colours, so that
    transparent pixels do not bleed in; alpha is straight in input and output.
    """
    if image.shape[:2] == (height, width):
        return image
    has_alpha = image.shape[2] == 4
    source = associate(image) if has_alpha else image
    rows, columns, channels = source.shape
    half = _resampling(rows, height) @ source.reshape(rows, columns * channels)
    half = half.reshape(height, columns, channels).transpose(1, 0, 2).reshape(columns, height * channels)
    result = (_resampling(columns, width) @ half).reshape(width, height, channels).transpose(1, 0, 2)
    result = np.ascontiguousarray(result, np.float32)
    return unassociate(result) if has_alpha else result


def channels_of(spec: Any) -> list[str]:
    """Return each channel's name in upper case; "" for channels after the end of the decoder's list of names."""
    names = [name.upper() for name in spec.channelnames][: spec.nchannels]
    return names + [""] * (spec.nchannels - len(names))


def alpha_of(spec: Any) -> int:
    """Return the index of the alpha channel in OpenImageIO's specification of an image; -1 if there is none.

    The decoder's index may be too large (OpenImageIO gives 4 for a GIF of 4 channels) or point to a colour channel. In
    both cases the channel called A is used.
    """
    names, index = channels_of(spec), int(spec.alpha_channel)
    if 0 <= index < len(names) and names[index] not in ("R", "G", "B", "Y", "I"):
        return index
    return names.index("A") if index >= 0 and "A" in names else -1


def open_photograph(path: Path) -> Any:
    """Open a picture like `open_image`, also in formats that only cameras write.

    HEIF, AVIF and raw photographs, which OpenImageIO does not decode, give a `DecodedPhoto` with the same methods.
    Photographs with an ICC profile of Display P3 or Adobe RGB give an `SrgbPhoto`, which converts their colours.
    """
    head = _first_bytes(path)
    decoder = decoder_of(path, head)
    if decoder is None:
        return in_srgb(open_image(path, head, wrong_contents(path, head)))
    source = decoder.open(path)
    _check_header(path, source.spec())
    return in_srgb(source)


def open_image(path: Path, head: bytes | None = None, wrong: InputError | None = None) -> Any:
    """Open an image and check its header. Returns OpenImageIO's input, which does not premultiply straight alpha.

    Images with data in their pixels, such as depth maps and STMaps, are opened by this function. `open_photograph` also
    opens formats that only cameras write.

    head: first bytes of the file; None to read them.
    wrong: the error for a file that OpenImageIO cannot open; None for one with OpenImageIO's reason.
    Raises InputError if the file is missing, not an image, or has an implausible size.
    """
    head, size = _first_bytes(path) if head is None else head, path.stat().st_size
    if size > MAX_UNSIGNED_IMAGE_BYTES and not head.startswith(IMAGE_SIGNATURES):
        raise InputError(f"{path}: has {size} bytes that do not begin like an image, expected a picture")
    hints = oiio.ImageSpec()
    hints.attribute("oiio:UnassociatedAlpha", 1)
    source = oiio.ImageInput.open(native_name(path), hints)
    if source is None:
        reason = one_line(error_of(oiio))
        raise wrong or InputError(f"{path}: does not decode: {reason}; expected an image")
    _check_header(path, source.spec())
    return source


def _first_bytes(path: Path) -> bytes:
    """Return the first PHOTO_HEAD_BYTES of a file. Raises InputError if the file is missing or too large."""
    if not is_file(path):
        raise InputError(f"{path}: no such image file")
    if (size := path.stat().st_size) > MAX_IMAGE_FILE_BYTES:
        raise InputError(f"{path}: has {size} bytes, expected a picture of at most {MAX_IMAGE_FILE_BYTES} bytes")
    with open_input(path, "a picture") as file:
        return file.read(PHOTO_HEAD_BYTES)


def _check_header(path: Path, spec: Any) -> None:
    """Raise InputError for a header that gives an implausible size. spec: OpenImageIO's specification of the image."""
    size = path.stat().st_size
    shown = max(spec.width, 0) * max(spec.height, 0), max(spec.full_width, 0) * max(spec.full_height, 0)
    floats = max(shown) * spec.nchannels
    if spec.depth > 1 or min(spec.width, spec.height, spec.full_width, spec.full_height) < 1:
        raise InputError(f"{path}: is {spec.width} x {spec.height} x {spec.depth} pixels, expected a flat picture")
    if max(shown) > MAX_IMAGE_PIXELS or floats > max(MAX_UNCHECKED_CHANNEL_VALUES, MAX_CHANNEL_VALUES_PER_BYTE * size):
        raise InputError(
            f"{path}: its header gives {spec.width} x {spec.height} pixels of {spec.nchannels} channels and a display "
            f"window of {spec.full_width} x {spec.full_height}, too many for a file of {size} bytes; is it damaged?"
        )


@contextmanager
def opened(path: Path) -> Iterator[Any]:
    """Open a file and yield OpenImageIO's input, None if the file is not an image. At the end, close the input and
    discard OpenImageIO's errors."""
    source = oiio.ImageInput.open(native_name(path))
    try:
        yield source
    finally:
        (source or oiio).geterror()
        if source is not None:
            source.close()


def decodes(source: Any, part: int, first: int) -> bool:
    """Return True if the rows of a part of an open image decode, from the row `first` to the last."""
    spec = source.spec()
    for top in range(spec.y + first, spec.y + spec.height, _DECODE_CHECK_ROWS):
        place = (part, 0, top, min(top + _DECODE_CHECK_ROWS, spec.y + spec.height), 0, 0, spec.nchannels)
        rows = source.read_native_deep_scanlines(*place) if spec.deep else source.read_scanlines(*place, oiio.FLOAT)
        if rows is None or source.geterror():
            return False
    return True


def error_of(source: Any) -> str:
    """Return the message of the last error of `source`, OpenImageIO's input; '' if there was none."""
    try:
        return str(source.geterror())
    except UnicodeDecodeError:
        return "in a message that is not text"


def one_line(reason: str) -> str:
    lines = [line.strip() for line in reason.splitlines() if line.strip()]
    return lines[0] if lines else "the decoder gives no reason"


def _orientation(spec: Any) -> int:
    value = int(spec.get_int_attribute("Orientation", 1))
    return value if 1 <= value <= 8 else 1


def _as_rgb(path: Path, pixels: Float32, spec: Any) -> Float32:
    names, alpha = channels_of(spec), alpha_of(spec)
    if all(name in names for name in "RGB"):
        colour = [names.index(name) for name in "RGB"]
    else:
        others = [index for index in range(len(names)) if index != alpha]
        if len(others) not in (1, 3):
            listed = examples(spec.channelnames)
            raise InputError(f"{path}: has the channels {listed}; expected grey or RGB, with alpha or without")
        colour = others * 3 if len(others) == 1 else others
    return pixels[:, :, [*colour, alpha] if alpha >= 0 else colour]


def _display_window(image: Float32, spec: Any) -> Float32:
    """Extend or crop an image from an EXR's data window to its display window, with 0 outside the data window."""
    x, y = spec.x - spec.full_x, spec.y - spec.full_y
    width, height = spec.full_width, spec.full_height
    if (x, y, spec.width, spec.height) == (0, 0, width, height):
        return image
    whole = np.zeros((height, width, image.shape[2]), np.float32)
    left, top = max(x, 0), max(y, 0)
    right, bottom = min(x + spec.width, width), min(y + spec.height, height)
    if left < right and top < bottom:
        whole[top:bottom, left:right] = image[top - y : bottom - y, left - x : right - x]
    return whole


def _check_png_is_whole(path: Path) -> None:
    """Raise InputError for a truncated PNG, before libpng prints a message about it."""
    if not png_is_whole(path):
        size = path.stat().st_size
        raise InputError(
            f"{path}: does not decode: the PNG ends early, after {size} bytes; copy it again or leave it out"
        )


def png_is_whole(path: Path) -> bool:
    """Return True if all chunks of a PNG are complete, up to the last chunk, IEND."""
    size = path.stat().st_size
    with open(path, "rb") as file:
        position = len(PNG_SIGNATURE) if file.read(len(PNG_SIGNATURE)) == PNG_SIGNATURE else size
        while position + 12 <= size:
            file.seek(position)
            length, kind = struct.unpack(">I4s", file.read(8))
            if not kind.isalpha():
                break
            position += 12 + length
            if kind == b"IEND" and position <= size:
                return True
    return False


def _resampling(source: int, target: int) -> Any:
    """Return a sparse matrix (target, source) that resamples an axis of `source` pixels to `target` pixels.

    The weights in each row sum to 1.
    """
    from scipy import sparse  # imported here, as the import takes 0.25 s and few commands need it

    if target >= source:
        centres = (np.arange(target) + 0.5) * (source / target) - 0.5
        first = np.clip(np.floor(centres).astype(int), 0, source - 1)
        fraction = np.clip(centres - first, 0, 1)
        index = np.stack([first, np.minimum(first + 1, source - 1)])
        weights = np.stack([1 - fraction, fraction])
    else:
        edges = np.arange(target + 1) * (source / target)
        low, high = edges[:-1], edges[1:]
        index = np.floor(low).astype(int) + np.arange(int(np.ceil(source / target)) + 1)[:, None]
        weights = np.clip(np.minimum(index + 1, high) - np.maximum(index, low), 0, None)
        index = np.minimum(index, source - 1)  # indices beyond the last pixel have weight 0
        weights /= weights.sum(axis=0)
    rows = np.broadcast_to(np.arange(target), index.shape)
    matrix = sparse.coo_matrix((weights.ravel(), (rows.ravel(), index.ravel())), shape=(target, source))
    return matrix.tocsr().astype(np.float32)
