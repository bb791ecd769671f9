# SPDX-License-Identifier: Apache-2.0
"""Reading and scaling pictures, through OpenImageIO.

In memory a picture is float32 (H, W, C), C = 3 (RGB) or 4 (RGBA), with *straight* (unassociated) alpha whatever the
file has, in the file's own colour space: nothing is linearised. In files alpha is what OpenImageIO writes:
unassociated in PNG, associated (premultiplied) in EXR.
"""

from __future__ import annotations

import os
import re
import struct
from collections.abc import Iterable, Iterator
from contextlib import contextmanager
from pathlib import Path
from typing import Any, TypeVar

import numpy as np
import OpenImageIO as oiio
from numpy.typing import NDArray
from scipy import sparse

from clsplat.arrays import Float32
from clsplat.errors import InputError, examples, reason_of
from clsplat.files import is_file, native_name, open_input
from clsplat.images.alpha import associate, unassociate

EXTENSIONS = (".png", ".jpg", ".jpeg", ".exr", ".tif", ".tiff", ".webp", ".bmp", ".hdr", ".tga", ".ppm", ".pgm")
"""Extensions of pictures when a folder is searched, in lower case. Named files may be anything OpenImageIO reads."""

T = TypeVar("T", bound=np.generic)

PNG_SIGNATURE = b"\x89PNG\r\n\x1a\n"
MAX_PIXELS = 1 << 28
FREE_FLOATS, FLOATS_A_BYTE = 48 << 20, 4096
"""Channel values that a picture may have whatever its file's length is, and for each byte of it. Both are more than any
real picture has, compressed, as deflate makes at most 1032 bytes of one."""
_ROWS = 64
MAX_FILE_BYTES, FREE_FILE_BYTES = 1 << 30, 1 << 26
SIGNATURES = (
    *(PNG_SIGNATURE, b"\xff\xd8\xff", b"\x76\x2f\x31\x01", b"II*\0", b"MM\0*", b"II+\0", b"MM\0+", b"BM", b"#?"),
    *(b"SDPX", b"XPDS", b"RIFF", b"P1", b"P2", b"P3", b"P4", b"P5", b"P6", b"PF", b"Pf"),
)
"""First bytes of pictures larger than FREE_FILE_BYTES: some decoders read the whole of a file that is not theirs."""
# libjpeg's notes about data that it can do without; every other message means that pixels are lost
HARMLESS = ("extraneous bytes",)


COMPANION = (
    r"(?:depths?|disp|disparity|normals?|alpha|albedo|masks?|mattes?|seg|segmentations?|semantics?|confidence|conf|flow"
    r"|edges?|silhouettes?|labels?)"
)
GROUND = r"(?:fg|foreground)"
"""Words in names of masks that count only where a mark parts them from the photograph's."""
_COMPANION_FOLDER = re.compile(rf"(?:\w+[_-])?{COMPANION}(?:[_-]\w+)?", re.IGNORECASE)
_COMPANION_AFTER = re.compile(
    rf"(?:[._-]?{COMPANION}|[._-]{GROUND})(?:[._-]?(?:\d+|vis|map|raw|image))*", re.IGNORECASE
)
_COMPANION_BEFORE = re.compile(rf"(?:dynamic[._-])?(?:{COMPANION}|{GROUND})(?:[._-]map)?[._-]", re.IGNORECASE)
_COLOUR = re.compile(r"[._-](?:colou?r|rgba?|image|img)\Z", re.IGNORECASE)


def companions(paths: Iterable[Path], pictures: Iterable[Path], folder: Path) -> set[Path]:
    """Those of `paths` that go with one of the pictures and are none: masks, depths, normals and the like.

    Their names tell, in any case. Such a word stands behind a picture's name (r_0_depth_0001.png), before it
    (mask_r_0.png) or in place of "color" (frame-1.color.jpg, frame-1.depth.png). COLMAP's masks have .png behind the
    picture's extension. Whatever is in a sub-folder of `folder` that is called by such a word counts too.
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
    stems |= {_COLOUR.sub("", stem) for stem in stems}
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
    """All pictures (by extension) under `folder`, if `deep` with its sub-folders, sorted; hidden files and folders are
    left out, and links that lead nowhere. Links to folders are followed, to each folder once. Raises InputError for a
    folder that cannot be read."""
    paths: list[Path] = []
    seen: set[str] = set()
    for root, folders, files in os.walk(folder, followlinks=True, onerror=cannot_be_searched):
        real = os.path.realpath(root)  # not the inode: some file systems of Windows number every folder 0
        if real in seen:
            folders.clear()
            continue
        seen.add(real)
        folders[:] = sorted(name for name in folders if deep and not name.startswith("."))
        paths += [
            path
            for path in (Path(root, name) for name in files)
            if not path.name.startswith(".") and path.suffix.lower() in EXTENSIONS and is_file(path)
        ]
    return sorted(paths)


def cannot_be_searched(error: OSError) -> None:
    """Raise InputError: handed to `os.walk`, which else passes over a folder that it cannot read."""
    why = reason_of(error)
    raise InputError(f"{error.filename}: cannot be searched for pictures: {why}; make it readable or move it away")


def image_size(path: Path, *, orient: bool = True) -> tuple[int, int]:
    """Width and height from the header, without decoding the pixels, as `read_image` would give them.

    Raises InputError for a file that is missing, no picture, or a PNG that is cut short.
    """
    source = open_image(path)
    spec = source.spec()
    source.close()
    width, height = spec.full_width, spec.full_height
    if source.format_name() != "openexr":
        width, height = spec.width, spec.height
    if source.format_name() == "png":
        _check_png_is_whole(path)
    return (height, width) if orient and _orientation(spec) >= 5 else (width, height)


def stored_range(path: Path) -> tuple[int, bool]:
    """Largest whole number that a file's pixels can hold, 0 for floats, and whether these numbers are what was written:
    JPEG's are about that. Raises InputError."""
    source = open_image(path)
    dtype, kind = np.dtype(str(source.spec().format)), source.format_name()
    source.close()
    return (int(np.iinfo(dtype).max) if dtype.kind == "u" else 0), kind not in ("jpeg", "jpeg2000", "webp")


def read_image(path: Path, *, orient: bool = True) -> Float32:
    """Read a picture as float32 (H, W, 3), or (H, W, 4) if it has alpha, straight.

    Integers of 8 or 16 bits are scaled to [0, 1], floats kept as they are, beyond 1 too. Grey becomes RGB. Of an EXR
    with more channels R, G, B and A are taken, and its whole display window. orient: turn the picture as its EXIF
    orientation says, right for photos as such; pictures of a COLMAP model are read without, as COLMAP itself
    (pycolmap 4.2.1) keeps the pixels as stored: keypoints and camera sizes refer to those.

    Raises InputError, naming the file and the decoder's reason, for a file that is missing, no picture, damaged, cut
    short, of another kind of channels, or with values that are not finite.
    """
    source = open_image(path)
    spec = source.spec()
    if source.format_name() == "png":
        _check_png_is_whole(path)
    pixels = source.read_image(oiio.FLOAT)
    reason = error_of(source)
    source.close()
    if pixels is None or (reason and not any(harmless in reason for harmless in HARMLESS)):
        raise InputError(f"{path}: does not decode: {one_line(reason)}; copy the picture again or leave it out")
    pixels = np.asarray(pixels, np.float32)
    if pixels.size != spec.height * spec.width * spec.nchannels:
        raise InputError(f"{path}: does not decode: its header and its pixels are of different sizes; save it again")
    pixels = pixels.reshape(spec.height, spec.width, spec.nchannels)
    image = _as_rgb(path, pixels, spec)
    if not np.isfinite(image).all():
        count = int(np.count_nonzero(~np.isfinite(image).all(axis=2)))
        raise InputError(f"{path}: {count} pixels are not finite, expected numbers only; repair or leave it out")
    if source.format_name() == "openexr":
        image = _display_window(image, spec)
    if image.shape[2] == 4 and not spec.get_int_attribute("oiio:UnassociatedAlpha", 0):
        image = unassociate(image)
    return np.ascontiguousarray(turned(image, _orientation(spec)) if orient else image)


def downscale(image: Float32, width: int, height: int) -> Float32:
    """Resample (H, W, C) to (height, width, C): each new pixel is the mean of the area it covers.

    The exact area, so that a whole factor is a box filter, and pixel corners stay where they are, as
    `Camera.resized` has it. An axis that grows is interpolated linearly. With four channels the mean is taken of
    premultiplied colour, so that what is transparent does not bleed in. Straight alpha in and out.
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


def turned(image: NDArray[T], orientation: int) -> NDArray[T]:
    """The image turned by EXIF orientations 1 to 8: from 5 on rows and columns change places, then the axes are
    flipped."""
    if orientation >= 5:
        image = image.transpose(1, 0, 2)
    if orientation in (3, 4, 7, 8):
        image = image[::-1]
    if orientation in (2, 3, 6, 7):
        image = image[:, ::-1]
    return image


def channels_of(spec: Any) -> list[str]:
    """Names of the channels in upper case, one each; a decoder's list may be shorter or longer than its pixels are
    deep."""
    names = [name.upper() for name in spec.channelnames][: spec.nchannels]
    return names + [""] * (spec.nchannels - len(names))


def alpha_of(spec: Any) -> int:
    """Index of the alpha channel, -1 for none. That of a decoder may be no channel (OpenImageIO's of GIF is 4 of 4),
    or one of colour; then names tell."""
    names, index = channels_of(spec), int(spec.alpha_channel)
    if 0 <= index < len(names) and names[index] not in ("R", "G", "B", "Y", "I"):
        return index
    return names.index("A") if index >= 0 and "A" in names else -1


def open_image(path: Path) -> Any:
    """OpenImageIO's input of a file, whose header makes sense. Alpha is straight where the format has it so. Raises
    InputError."""
    if not is_file(path):
        raise InputError(f"{path}: no such image file")
    hints = oiio.ImageSpec()
    hints.attribute("oiio:UnassociatedAlpha", 1)
    size = path.stat().st_size
    with open_input(path, "a picture") as file:
        known = file.read(8).startswith(SIGNATURES)
    if size > MAX_FILE_BYTES or (size > FREE_FILE_BYTES and not known):
        raise InputError(f"{path}: has {size} bytes and does not begin as a picture, expected at most {MAX_FILE_BYTES}")
    source = oiio.ImageInput.open(native_name(path), hints)
    if source is None:
        raise InputError(f"{path}: does not decode: {one_line(error_of(oiio))}; expected an image")
    spec = source.spec()
    shown = max(spec.width, 0) * max(spec.height, 0), max(spec.full_width, 0) * max(spec.full_height, 0)
    floats = max(shown) * spec.nchannels
    if spec.depth > 1 or min(spec.width, spec.height, spec.full_width, spec.full_height) < 1:
        raise InputError(f"{path}: is {spec.width} x {spec.height} x {spec.depth} pixels, expected a flat picture")
    if max(shown) > MAX_PIXELS or floats > max(FREE_FLOATS, FLOATS_A_BYTE * size):
        raise InputError(
            f"{path}: says that it is {spec.width} x {spec.height} pixels of {spec.nchannels} channels, shown as "
            f"{spec.full_width} x {spec.full_height}, in {size} bytes; is it damaged?"
        )
    return source


@contextmanager
def opened(path: Path) -> Iterator[Any]:
    """OpenImageIO's input of a file, None where that is none. Its messages are not looked at."""
    source = oiio.ImageInput.open(native_name(path))
    try:
        yield source
    finally:
        (source or oiio).geterror()
        if source is not None:
            source.close()


def decodes(source: Any, part: int, first: int) -> bool:
    """True if the rows of an input's part decode, from the picture's row `first` on. They are read a few at a time."""
    spec = source.spec()
    for top in range(spec.y + first, spec.y + spec.height, _ROWS):
        place = (part, 0, top, min(top + _ROWS, spec.y + spec.height), 0, 0, spec.nchannels)
        rows = source.read_native_deep_scanlines(*place) if spec.deep else source.read_scanlines(*place, oiio.FLOAT)
        if rows is None or source.geterror():
            return False
    return True


def error_of(source: Any) -> str:
    """OpenImageIO's message about what went wrong."""
    try:
        return str(source.geterror())
    except UnicodeDecodeError:
        return "in words that are no text"


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
    """The whole picture of an EXR whose data window is only a part of it; outside is 0."""
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
    """Raise InputError for a file that is cut short, before training, and before libpng prints."""
    if not png_is_whole(path):
        size = path.stat().st_size
        raise InputError(
            f"{path}: does not decode: the PNG ends early, after {size} bytes; copy it again or leave it out"
        )


def png_is_whole(path: Path) -> bool:
    """True if the chunks lead to the last one."""
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
    """The sparse matrix (target, source) whose rows are the weights of an axis, each summing to 1."""
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
        index = np.minimum(index, source - 1)  # the weight beyond the last pixel is 0
        weights /= weights.sum(axis=0)
    rows = np.broadcast_to(np.arange(target), index.shape)
    matrix = sparse.coo_matrix((weights.ravel(), (rows.ravel(), index.ravel())), shape=(target, source))
    return matrix.tocsr().astype(np.float32)
