# SPDX-License-Identifier: Apache-2.0
"""Photographs for structure from motion: search in a folder, decoding, upright copies, and grouping by camera."""

from __future__ import annotations

import hashlib
import os
import shutil
from collections.abc import Callable, Collection, Sequence
from concurrent.futures import ThreadPoolExecutor
from dataclasses import dataclass
from functools import partial
from pathlib import Path, PurePosixPath
from typing import Any

import numpy as np
import OpenImageIO as oiio
from numpy.typing import NDArray

from clsplat.errors import ClsplatError, InputError, examples
from clsplat.files.atomic import require_room, room_error, write_error
from clsplat.files.documents import is_file
from clsplat.files.names import ON_WINDOWS, native_name
from clsplat.images.decoders.colour_profiles import SrgbPhoto
from clsplat.images.decoders.decoded_photo import PHOTOS_EXTRA
from clsplat.images.decoders.orientation import turned
from clsplat.images.decoders.photo_decoders import (
    DECODED_PHOTO_EXTENSIONS,
    PHOTO_DECODERS,
    lacks_decoder,
    without_converted,
)
from clsplat.images.exif import lens_of
from clsplat.images.reading import alpha_of, companions, error_of, open_photograph, opened
from clsplat.images.writing import jpeg_room
from clsplat.scenes.sfm.captured_files import captured_files
from clsplat.scenes.sfm.copies import Thumb, thumb_of, to_compare

SFM_PHOTO_EXTENSIONS = frozenset({".jpg", ".jpeg", ".png", ".tif", ".tiff", ".bmp"})
"""Extensions that pycolmap's wheel reads and writes. The wheel's OpenImageIO has no WebP, JPEG 2000 or HEIF."""
CONVERTED_PHOTO_EXTENSIONS = frozenset({".webp", *DECODED_PHOTO_EXTENSIONS})
"""Extensions of photographs that are decoded for pycolmap, and written as JPEG, or as PNG if they are transparent."""
SFM_IMAGE_FORMATS = frozenset({"jpeg", "png", "tiff", "bmp"})
"""OpenImageIO's names of the formats that pycolmap's wheel reads. The format is recognised by the file's contents."""
UNREADABLE_PHOTO_EXTENSIONS = frozenset({".jp2", ".jxl", ".gif", ".exr"})
"""Extensions of photographs that structure from motion does not use. A warning asks for conversion."""
MADE_BY_CLSPLAT = "made by clsplat from a video or photos; to use such pictures, give only their folder"
"""Why folders that clsplat made are left out of a search (`captured_files`), for messages."""


@dataclass(frozen=True)
class Photo:
    """A photograph that was decoded and put into the folder that pycolmap reads.

    name: path below the folder, with forward slashes.
    scene_name: path of its copy in the scene, such as IMG_1.heic.jpg for IMG_1.heic.
    width, height: size in pixels of the upright photograph.
    lens: camera, lens and focal lengths from EXIF (`images.exif.lens_of`).
    transparent: True if the alpha channel makes any pixel transparent.
    thumb: thumbnail from `copies.thumb_of`, for photographs that may be copies.
    """

    name: str
    scene_name: str
    width: int
    height: int
    lens: tuple[str, ...]
    transparent: bool = False
    thumb: Thumb | None = None


def find_photos(
    folder: Path, excluded: Collection[Path] = (), *, needed: bool = True
) -> tuple[list[Path], dict[str, list[Path]]]:
    """Return the photographs below a folder, sorted by name, and the files that are left out, keyed by the reason.

    The search is that of `captured_files`. Raises InputError for a folder that does not exist or cannot be read, and
    for a photograph whose name has unprintable characters.

    excluded: folders to skip, such as outputs inside the folder.

    needed: True to raise InputError if there are no photographs.
    """
    if not folder.is_dir():
        raise InputError(f"{folder}: no such folder, expected a folder with photos")
    photos: list[Path] = []
    others: list[Path] = []
    lacking: list[Path] = []
    broken: list[Path] = []
    known = SFM_PHOTO_EXTENSIONS | CONVERTED_PHOTO_EXTENSIONS
    searched = captured_files(folder, excluded)
    for here, names in searched.folders:
        for name in names:
            extension = Path(name).suffix.lower()
            if extension in known and not name.isprintable():
                raise InputError(f"{here / name}: its name has unprintable characters; rename it")
            if extension in known and (here / name).is_symlink() and not (here / name).exists():
                broken.append(here / name)
            elif lacks_decoder(here / name):
                lacking.append(here / name)
            elif extension in known:
                photos.append(here / name)
            elif extension in UNREADABLE_PHOTO_EXTENSIONS:
                others.append(here / name)
    if not photos and needed:
        raise _no_photos(folder, lacking, others, broken, searched.made)
    key = partial(photo_name, folder)
    converted = set(without_converted([*photos, *lacking])[1])
    # also a photograph whose copy in the scene would have another photograph's name: a.webp beside a.webp.jpg
    used = set(photos)
    converted |= {path for path in photos if _is_converted(path) and path.with_name(f"{path.name}.jpg") in used}
    photos = [path for path in photos if path not in converted]
    aside = companions(photos, photos, folder)
    kept = [path for path in photos if path not in aside]
    left_out = {
        MADE_BY_CLSPLAT: searched.made,
        f"reading them needs another package: {PHOTOS_EXTRA}": [path for path in lacking if path not in converted],
        "their folder has the same photos in another format": list(converted),
        "convert to JPEG, PNG or TIFF first": others,
        "broken links": broken,
        "their names mark masks, depth maps or the like of other photos": aside,
    }
    return sorted(kept, key=key), {why: sorted(paths, key=key) for why, paths in left_out.items() if paths}


def _no_photos(
    folder: Path, lacking: Sequence[Path], others: Sequence[Path], broken: Sequence[Path], made: Sequence[Path]
) -> InputError:
    """Return the error for a folder without photographs, which names the files and folders that are there instead.

    lacking: photographs whose decoder is not installed. others: photographs in unsupported formats.
    broken: broken links. made: folders that clsplat made.
    """
    if lacking:
        found = f"{len(lacking)} photo(s) such as {min(lacking).name}"
        return InputError(f"{folder}: has only {found}, and reading them needs another package: {PHOTOS_EXTRA}")
    unusable = f", only {len(others)} in unsupported formats such as {others[0].name}" if others else ""
    unusable += f", only {len(broken)} broken link(s) such as {broken[0].name}" if broken else ""
    if made:
        unusable += f", only in {examples(sorted(photo_name(folder, path) for path in made))}, {MADE_BY_CLSPLAT}"
    kinds = " ".join(sorted(SFM_PHOTO_EXTENSIONS | CONVERTED_PHOTO_EXTENSIONS))
    return InputError(f"{folder}: no photos found{unusable}; expected files ending in {kinds}")


def _is_converted(path: Path) -> bool:
    """Return True if structure from motion uses a JPEG or PNG copy of a photograph, by its extension."""
    return path.suffix.lower() in CONVERTED_PHOTO_EXTENSIONS


def photo_name(folder: Path, path: Path) -> str:
    """Return the name of a photograph in the scene: its path below the folder, with forward slashes."""
    return path.relative_to(folder).as_posix()


def fingerprint(folder: Path, photos: Sequence[Path], settings: str) -> str:
    """Return a digest of settings and of the photographs' names, sizes and modification times. Reads no pixels."""
    digest = hashlib.sha256(settings.encode())
    for path in photos:
        status = path.stat()
        digest.update(f"\n{photo_name(folder, path)}\t{status.st_size}\t{status.st_mtime_ns}".encode())
    return digest.hexdigest()


def stage_photos(
    folder: Path, photos: Sequence[Path], target: Path, report: Callable[[float], None], threads: int
) -> list[Photo]:
    """Put a copy of every photograph, or a link to it, under `target`, and decode it once. Returns the photographs.

    pycolmap ignores the EXIF orientation and ICC profiles, and cannot read some formats. So photographs with an
    orientation, in Display P3 or Adobe RGB, or in such a format, are rewritten upright and in sRGB. The copies have the
    EXIF data from which pycolmap takes focal lengths and GPS positions. Other files are linked, or copied if the file
    system has no links. Raises InputError that names the first photograph that does not decode, as pycolmap would
    silently skip it.

    report: function that is called with the fraction of the photographs that are done.
    """
    staged: list[Photo] = []
    compared = to_compare([photo_name(folder, path) for path in photos])
    with ThreadPoolExecutor(threads) as pool:
        work = pool.map(partial(_stage, folder, target, compared), photos)
        try:
            for photo in work:
                staged.append(photo)
                report(len(staged) / len(photos))
        except BaseException:
            pool.shutdown(wait=True, cancel_futures=True)
            raise
    return staged


def _stage(folder: Path, target: Path, compared: Collection[str], path: Path) -> Photo:
    if not is_file(path):
        raise InputError(f"{path}: cannot be decoded as an image: is not a regular file")
    source = open_photograph(path)
    try:
        spec, kind = source.spec(), source.format_name()
        pixels = source.read_image(spec.format)
        # A truncated JPEG still gives pixels, with grey at the end. Only the error text tells that it is truncated.
        trouble = error_of(source)
    finally:
        source.close()
    if pixels is None or trouble:
        raise InputError(f"{path}: cannot be decoded as an image: {_last_line(trouble)}")

    name = photo_name(folder, path)
    alpha = alpha_of(spec)
    transparent = _is_transparent(pixels, alpha)
    scene_name = _scene_name(name, transparent=transparent)
    copy = target / scene_name
    copy.parent.mkdir(parents=True, exist_ok=True)
    orientation = spec.get_int_attribute("Orientation", 1)
    width, height = spec.width, spec.height
    decoded = kind in PHOTO_DECODERS or isinstance(source, SrgbPhoto)
    if orientation in range(2, 9) or kind not in SFM_IMAGE_FORMATS or decoded:
        if orientation in range(5, 9):
            width, height = height, width
        _write_upright(path, copy, spec, pixels if decoded else None)
    else:
        try:
            if ON_WINDOWS and not os.access(path, os.W_OK):
                raise PermissionError("a link to a read-only file cannot be removed later")
            os.link(path.resolve(), copy)
        except OSError:
            shutil.copyfile(path, copy)
    thumb = thumb_of(turned(pixels, orientation), alpha) if name in compared else None
    return Photo(name, scene_name, width, height, lens_of(spec), transparent, thumb)


def _scene_name(name: str, *, transparent: bool) -> str:
    """Return the name of a photograph's copy, whose extension pycolmap can write. transparent: the copy needs alpha."""
    if PurePosixPath(name).suffix.lower() in SFM_PHOTO_EXTENSIONS:
        return name
    return name + (".png" if transparent else ".jpg")


def _is_transparent(pixels: NDArray[Any], alpha_channel: int) -> bool:
    """Return True if a picture (H, W, C) is not opaque everywhere. alpha_channel: index of alpha, -1 for none."""
    if alpha_channel < 0:
        return False
    opaque = np.iinfo(pixels.dtype).max if pixels.dtype.kind == "u" else 1
    return bool((pixels[:, :, alpha_channel] < opaque).any())


def has_alpha(path: Path) -> bool:
    """Return True if an image file has an alpha channel. Reads only the file's header."""
    with opened(path) as source:
        return source is not None and alpha_of(source.spec()) >= 0


def _write_upright(path: Path, copy: Path, spec: Any, pixels: NDArray[Any] | None) -> None:
    """Write an upright copy of a photograph, in the format of the copy's extension.

    EXIF is kept for the focal length, but its orientation is set to upright.

    spec: OpenImageIO's specification of the photograph.
    pixels: the decoded pixels, None if OpenImageIO decodes the photograph.
    """
    if pixels is None:
        stored = oiio.ImageBuf(native_name(path))
    else:
        stored = oiio.ImageBuf(spec)
        assert stored.set_pixels(oiio.ROI(), pixels), stored.geterror()
    upright = oiio.ImageBufAlgo.reorient(stored)
    upright.specmod().attribute("Orientation", 1)
    upright.specmod().attribute("Compression", "jpeg:98" if copy.suffix.lower() in (".jpg", ".jpeg") else "lzw")
    with require_room(copy, jpeg_room(spec)):  # libjpeg would end the process if it could not write
        written = not upright.has_error and upright.write(native_name(copy))
    if not written:
        if error := room_error(copy.parent):
            raise write_error(copy, error)
        raise ClsplatError(f"{copy}: cannot write the upright copy of {path}: {_last_line(upright.geterror())}")


def _last_line(text: str) -> str:
    lines = [line.strip() for line in text.splitlines() if line.strip()]
    return lines[-1] if lines else "unknown kind of file"


def camera_groups(photos: Sequence[Photo], shared_camera: bool | str) -> list[list[str]]:
    """Group the photographs' names in the scene by camera. The photographs of a group share their intrinsics.

    shared_camera: True groups all photographs of the same size. "auto" also requires the same camera, lens and focal
        lengths in EXIF. False gives each photograph its own camera.
    """
    groups: dict[tuple[object, ...], list[str]] = {}
    for photo in photos:
        if shared_camera is False:
            key: tuple[object, ...] = (photo.name,)
        elif shared_camera is True:
            key = (photo.width, photo.height)
        else:
            key = (photo.width, photo.height, *photo.lens)
        groups.setdefault(key, []).append(photo.scene_name)
    return list(groups.values())
