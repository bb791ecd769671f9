# SPDX-License-Identifier: Apache-2.0
"""Detection of duplicate photographs in a folder: downscaled, undistorted, or with another file type or name."""

from __future__ import annotations

import math
import re
from collections import defaultdict
from collections.abc import Callable, Hashable, Iterable, Sequence
from dataclasses import dataclass
from itertools import combinations
from pathlib import Path, PurePosixPath
from typing import Any, Protocol, TypeVar

import numpy as np
from numpy.typing import NDArray

from clsplat.errors import InputError, examples
from clsplat.files.documents import is_file, short_digest
from clsplat.images.reading import IMAGE_SUFFIXES, downscale, image_size, read_image
from clsplat.scenes.thumbnail import REC601_LUMA, SHARPNESS_SIDE_PX, reduced

UNDISTORTION_FOLDERS = (
    ("input", "inputs", "original", "originals", "raw", "distorted"),
    ("images", "image", "rgb", "color", "colour", "frames", "photos"),
    (
        *("corrected_images", "images_corrected", "corrected", "undistorted", "undistorted_images"),
        *("images_undistorted", "dense"),
    ),
)
"""Names of folders that may hold the same photographs before and after undistortion, earlier stages first.

Programs with such folders are the 3DGS authors' convert.py, Polycam, OpenSfM (undistorted/images), COLMAP
(dense/0/images) and others.
"""
PLAIN_FOLDER_STAGE, UNDISTORTED_FOLDER_STAGE = 1, 2
"""Two indices in UNDISTORTION_FOLDERS. The first is the stage of photographs whose folders are not listed there. The
second is the stage of undistorted photographs."""
LOSSLESS_EXTENSIONS = (".png", ".tif", ".tiff", ".bmp")
"""Extensions of lossless photographs, which are preferred to their lossy copies."""
COPY_THUMBNAIL_SIZE_PX = (96, 72)
"""Width and height of the thumbnails that are compared."""
MAX_COMPARED_PIXELS_PER_PIXEL, MIN_COMPARED_WIDTH_PX = 0.5, 24
"""Maximum width of compared thumbnails as a fraction of the narrower picture's width, and minimum width in pixels.

The maximum is needed because resizing visibly changes the pixels of small pictures.
"""
MAX_COPY_RMS_LEVELS, MAX_COPY_RMS_PER_GRADIENT = 1.0, 0.2
"""Largest RMS difference of two thumbnails of one photograph: in 255ths, or as a multiple of the RMS difference of
neighbouring pixels. The larger limit applies.

A shift of 0.2 thumbnail pixels, 1/480 of the picture's width, reaches the second limit. JPEG and resizing filters cause
less in pictures of at least 240 pixels.
"""
MIN_FOLDER_CORRELATION, CORRELATION_SIDE_PX = 0.9, 24
"""Minimum correlation of the pictures in two related folders, and longer side in pixels at which they are correlated.

The median of FOLDER_PAIR_SAMPLES pairs is compared with the minimum. In the scene fox (k1 0.058, k2 -0.081),
the correlation of photographs with their undistorted copies is 0.9995. In six other scenes, with k1 from 0.1 to -0.35,
it is at least 0.93. The correlation of successive photographs of these scenes is 0.16 to 0.87, and that of photographs
farther apart is at most 0.45.

Frames of an almost still video correlate more than pictures and their copies after strong undistortion. So two related
folders with frames of such a video are mistaken for copies.
"""
FOLDER_PAIR_SAMPLES = 5
"""Number of pairs of pictures that are decoded to compare two folders."""
MAX_COPY_ASPECT_RATIO_CHANGE = 1.3
"""Two pictures differ if their aspect ratios differ by at least this factor. Cropping after undistortion changes them
by less."""
FEATURELESS_STD_LEVELS = 8.0
"""Standard deviation in 255ths below which a picture is featureless, and never counts as a copy."""
ASPECT_RATIO_TOLERANCE = 0.02
"""Relative tolerance between the aspect ratios of one photograph's copies, whose sides are rounded."""
COMPARED_MIDDLE_BYTES = 4096
"""Number of bytes from the middle of a file that are compared before the whole file."""

_NUMBERED_FOLDER = re.compile(r"(.+?)[_-](\d{1,2})\Z")
"""Name of a folder of downscaled pictures, such as images_4."""
Thumb = NDArray[np.uint8]
"""Grey thumbnail (72, 96) from `thumb_of`."""
P = TypeVar("P", "_Place", "_Staged")


class Decoded(Protocol):
    """A decoded photograph."""

    @property
    def name(self) -> str:
        """Path below the folder of photographs."""

    @property
    def width(self) -> int:
        """Width in pixels of the upright photograph."""

    @property
    def height(self) -> int:
        """Height in pixels of the upright photograph."""

    @property
    def lens(self) -> tuple[str, ...]:
        """Make, model and focal length from EXIF; empty strings for missing values."""

    @property
    def transparent(self) -> bool:
        """True if any pixel is transparent."""

    @property
    def thumb(self) -> Thumb | None:
        """Thumbnail from `thumb_of`, None if the photograph is not compared."""


@dataclass(frozen=True)
class Copy:
    """A photograph that is left out as a copy of another.

    kept: name of the photograph that is used instead.
    why: how the copy differs from the used photograph, or how it was recognised, such as "smaller" or "same bytes".
    """

    kept: str
    why: str


def found_by_name(folder: Path, names: Sequence[str]) -> dict[str, Copy]:
    """Find copies by names and bytes, before all photographs are decoded. Returns the copies by name.

    Copies are files with the same bytes, and pictures with the same names in related folders. A sample of these
    pictures is decoded to confirm that they look alike.

    Related folders are next to each other or nested. They have names such as images and images_2, with pictures of half
    the size, or names in UNDISTORTION_FOLDERS. The folder with the most pixels is used; among equals, the earliest in
    UNDISTORTION_FOLDERS.
    """
    copies = _of_same_bytes(folder, names)
    groups = _staged([name for name in names if name not in copies])
    pictures = _Pictures(folder, groups)

    def why(kept: _Staged, other: _Staged) -> str:
        if kept.kind == other.kind or not pictures.are_alike(kept.head, other.head):
            return ""
        size, whole = pictures.size(other.name), pictures.size(kept.name)
        if kept.stage == other.stage and not _is_downscaled(kept.factor, other.factor, whole, size):
            return ""
        if size[0] * size[1] < whole[0] * whole[1]:
            return "smaller"
        return "corrected" if kept.stage < other.stage else "not corrected"

    def rank(place: _Staged) -> tuple[Hashable, ...]:
        return (-pictures.pixels(place.head), *place.kind)

    return resolved({**copies, **_found(groups, rank, why)})


def found_by_picture(photos: Sequence[Decoded]) -> dict[str, Copy]:
    """Find copies among decoded photographs by their thumbnails and names. Returns the copies by name.

    Copies have the same picture and the same name, in a sibling folder or with another file type. The photograph with
    the most pixels is used. If several have as many pixels, a photograph with transparency is preferred, then a
    photograph with a lens in EXIF, then a lossless file.
    """
    by_name = {photo.name: photo for photo in photos}

    def why(kept: _Place, other: _Place) -> str:
        one, two = by_name[kept.name], by_name[other.name]
        if not _is_same(one, two):
            return ""
        return "smaller" if one.width * one.height > two.width * two.height else "same picture"

    def rank(place: _Place) -> tuple[Hashable, ...]:
        photo = by_name[place.name]
        lossless = PurePosixPath(photo.name).suffix.lower() in LOSSLESS_EXTENSIONS
        return (-photo.width * photo.height, not photo.transparent, not any(photo.lens), not lossless)

    return resolved(_found(_alike(list(by_name)), rank, why))


def to_compare(names: Sequence[str]) -> set[str]:
    """Return the names of photographs whose thumbnails `found_by_picture` compares."""
    return {place.name for group in _alike(names) for place in group}


def thumb_of(pixels: NDArray[Any], alpha: int) -> Thumb:
    """Return the grey thumbnail (72, 96) of a picture (H, W, C) of any aspect ratio.

    pixels: unsigned integers, or floats from 0 to 1.
    alpha: index of the alpha channel, -1 for none.
    """
    colour = [index for index in range(pixels.shape[2]) if index != alpha]
    small = np.asarray(reduced(pixels, SHARPNESS_SIDE_PX)[:, :, colour], np.float32)
    grey = small[:, :, :3] @ REC601_LUMA if len(colour) >= 3 else small[:, :, 0]
    most = float(np.iinfo(pixels.dtype).max) if pixels.dtype.kind == "u" else 1.0
    levels = downscale(grey[:, :, None], *COPY_THUMBNAIL_SIZE_PX)[:, :, 0] * (255 / most)
    return np.asarray(np.rint(np.clip(np.nan_to_num(levels), 0, 255)), np.uint8)


def resolved(copies: dict[str, Copy]) -> dict[str, Copy]:
    """Return the copies, with `Copy.kept` followed until it names a photograph that is not itself a copy."""

    def last(name: str) -> str:
        while name in copies:
            name = copies[name].kept
        return name

    return {name: Copy(last(copy.kept), copy.why) for name, copy in copies.items()}


def listed(copies: dict[str, Copy]) -> str:
    """Return text for a message with examples of the copies, such as "b.jpg is a.jpg, smaller"."""
    return examples(f"{name} is {copy.kept}, {copy.why}" for name, copy in sorted(copies.items()))


@dataclass(frozen=True)
class _Place:
    """A photograph that may have copies.

    folder: the folder in the photograph's path that may have another name in the paths of copies, "" for none.
    """

    name: str
    folder: str


@dataclass(frozen=True)
class _Staged:
    """A photograph, classified by the names of its folders: UNDISTORTION_FOLDERS, or names such as images_2.

    head: path up to the last folder with such a name, "" for none.
    stage: index in UNDISTORTION_FOLDERS of the latest stage that a folder in the path is named after.
    factor: factor by which the photograph is downscaled, according to the folder's name.
    """

    name: str
    head: str
    stage: int
    factor: int

    @property
    def kind(self) -> tuple[int, int]:
        """Stage of undistortion and factor of downscaling, which differ between a photograph and its copies."""
        return self.stage, self.factor


class _Pictures:
    """Sizes and thumbnails of the pictures in a folder, read on demand, to compare its sub-folders.

    groups: groups of photographs with the same name in related folders. Their `head` names the folders to compare.
    """

    def __init__(self, folder: Path, groups: Sequence[Sequence[_Staged]]) -> None:
        self._folder = folder
        self._sizes: dict[str, tuple[int, int]] = {}
        self._thumbs: dict[str, Thumb | None] = {}
        self._names: dict[str, set[str]] = defaultdict(set)
        self._pairs: dict[frozenset[str], list[tuple[str, str]]] = defaultdict(list)
        self._alike: dict[frozenset[str], bool] = {}
        self._pixels: dict[str, int] = {}
        for group in groups:
            for place in group:
                self._names[place.head].add(place.name)
            for one, two in combinations(group, 2):
                if one.kind != two.kind:
                    self._pairs[frozenset((one.head, two.head))].append((one.name, two.name))

    def size(self, name: str) -> tuple[int, int]:
        """Return width and height of a picture; (0, 0) if it does not decode, which `photos.stage_photos` reports."""
        if name not in self._sizes:
            try:
                self._sizes[name] = image_size(self._folder / name)
            except InputError:
                self._sizes[name] = (0, 0)
        return self._sizes[name]

    def pixels(self, head: str) -> int:
        """Return the number of pixels of the median picture in the folder `head`."""
        if head not in self._pixels:
            self._pixels[head] = sorted(math.prod(self.size(name)) for name in self._names[head])[
                len(self._names[head]) // 2
            ]
        return self._pixels[head]

    def are_alike(self, one: str, two: str) -> bool:
        """Return True if the pictures of two folders are the same, apart from undistortion."""
        key = frozenset((one, two))
        if key not in self._alike:
            pairs = self._pairs[key]
            chosen = sorted({round(at) for at in np.linspace(0, len(pairs) - 1, min(FOLDER_PAIR_SAMPLES, len(pairs)))})
            likeness = [each for at in chosen if (each := self._likeness(*pairs[at])) is not None]
            self._alike[key] = bool(likeness) and float(np.median(likeness)) >= MIN_FOLDER_CORRELATION
        return self._alike[key]

    def _likeness(self, one: str, two: str) -> float | None:
        """Return the correlation of two pictures, None if one is featureless or does not decode."""
        (width, height), (across, down) = self.size(one), self.size(two)
        thumbs = [thumb for thumb in (self._thumb(one), self._thumb(two)) if thumb is not None]
        if len(thumbs) < 2 or min(width, height, across, down) < 1:
            return None
        if not 1 / MAX_COPY_ASPECT_RATIO_CHANGE < width * down / (height * across) < MAX_COPY_ASPECT_RATIO_CHANGE:
            return 0.0
        first, second = (reduced(each.astype(np.float32)[:, :, None], CORRELATION_SIDE_PX) for each in thumbs)
        if min(float(first.std()), float(second.std())) < FEATURELESS_STD_LEVELS:
            return None
        return float(np.corrcoef(first.ravel(), second.ravel())[0, 1])

    def _thumb(self, name: str) -> Thumb | None:
        if name not in self._thumbs:
            try:
                pixels = read_image(self._folder / name)
                self._thumbs[name] = thumb_of(pixels, 3 if pixels.shape[2] == 4 else -1)
            except InputError:
                self._thumbs[name] = None
        return self._thumbs[name]


def _staged(names: Iterable[str]) -> list[list[_Staged]]:
    """Group photographs with the same stem in the same folders, ignoring folders that `_Staged` classifies.

    Each group has photographs of at least two kinds (`_Staged.kind`). Folders above a folder of undistorted pictures
    are also ignored, as another program may have made them.
    """
    groups: dict[tuple[Hashable, ...], list[_Staged]] = defaultdict(list)
    for name in names:
        parts = [part.casefold() for part in PurePosixPath(name).parts[:-1]]
        stage, factor, told, undone = -1, 1, set(), 0
        for at, part in enumerate(parts):
            word, by = _numbered(part)
            its = min(_stage(part), _stage(word))
            if its < len(UNDISTORTION_FOLDERS):
                stage, factor = max(stage, its), by if _stage(part) == len(UNDISTORTION_FOLDERS) else 1
                undone = at if its == UNDISTORTED_FOLDER_STAGE else undone
                told.add(at)
            elif part.isdigit() and at and parts[at - 1] == "dense":
                told.add(at)
        head = "/".join(PurePosixPath(name).parts[: max(told, default=-1) + 1])
        place = _Staged(name, head, stage if told else PLAIN_FOLDER_STAGE, factor)
        for start in {0, undone}:
            others = tuple(part for at, part in enumerate(parts) if at >= start and at not in told)
            groups[(others, _plain_stem(name))].append(place)
    return [group for group in groups.values() if len({place.kind for place in group}) > 1]


def _plain_stem(name: str) -> str:
    """Return a picture's stem in lower case, without a second extension: OpenSfM undistorts IMG.JPG to IMG.JPG.jpg."""
    stem = PurePosixPath(PurePosixPath(name).stem.casefold())
    return stem.stem if stem.suffix in IMAGE_SUFFIXES else stem.name


def _alike(names: Iterable[str]) -> list[list[_Place]]:
    """Group photographs that may be copies according to their names.

    The photographs of a group have the same stem. They are in one folder, in sibling folders, in a folder and its
    sub-folder, or in equally named sub-folders of such folders.
    """
    groups: dict[tuple[Hashable, ...], list[_Place]] = defaultdict(list)
    for name in names:
        plain = PurePosixPath(name)
        folders, stem = plain.parts[:-1], plain.stem.casefold()
        for at in range(len(folders) + 1):
            groups[(at, folders, stem)].append(_Place(name, ""))
        for at, folder in enumerate(folders):
            groups[(at, folders[:at] + folders[at + 1 :], stem)].append(_Place(name, folder))
    return [group for group in groups.values() if len(group) > 1]


def _found(
    groups: Iterable[list[P]], rank: Callable[[P], tuple[Hashable, ...]], why: Callable[[P, P], str]
) -> dict[str, Copy]:
    """Find the copies in each group: photographs that show the same things as a better photograph of the group.

    The better photograph may itself be a copy.

    rank: sort key of a photograph; better photographs have smaller keys.
    why: function of the better and the other photograph that returns the text for `Copy.why`; "" if they show
        different things.
    """
    copies: dict[str, Copy] = {}
    for group in groups:
        seen: list[P] = []
        for place in sorted(group, key=lambda place: (*rank(place), len(place.name), place.name)):
            first = next(((one, text) for one in seen if (text := why(one, place))), None)
            if first is not None:
                copies.setdefault(place.name, Copy(first[0].name, first[1]))
            seen.append(place)
    return copies


def _of_same_bytes(folder: Path, names: Sequence[str]) -> dict[str, Copy]:
    """Find files with the same bytes. Returns the copies by name.

    Of equal files, the file whose folder has the earliest stage in UNDISTORTION_FOLDERS is used. A file
    in no sub-folder is among the earliest. If several files share the stage, the file with the shortest name is used.
    """
    alike: dict[tuple[object, ...], list[str]] = {}
    keys: tuple[Callable[[Path], object], ...] = (lambda path: path.stat().st_size, _middle, short_digest)
    groups = [[name for name in names if is_file(folder / name)]]
    for key in keys:
        alike = defaultdict(list)
        for number, group in enumerate(groups):
            for name in group:
                alike[(number, key(folder / name))].append(name)
        groups = [group for group in alike.values() if len(group) > 1]
    copies = {}
    for group in groups:
        stages = {name: min((_stage(part) for part in PurePosixPath(name).parts[:-1]), default=0) for name in group}
        kept, *others = sorted(group, key=lambda name: (stages[name], len(name), name))
        copies.update({name: Copy(kept, "same bytes") for name in others})
    return copies


def _middle(path: Path) -> bytes:
    with open(path, "rb") as file:
        file.seek(path.stat().st_size // 2)
        return file.read(COMPARED_MIDDLE_BYTES)


def _stage(folder: str) -> int:
    """Return the index in UNDISTORTION_FOLDERS of a folder's name; len(UNDISTORTION_FOLDERS) for other names."""
    return next(
        (stage for stage, known in enumerate(UNDISTORTION_FOLDERS) if folder.casefold() in known),
        len(UNDISTORTION_FOLDERS),
    )


def _numbered(folder: str) -> tuple[str, int]:
    """Split a folder's name such as images_4 into "images" and the factor 4. Without a number, the factor is 1."""
    match = _NUMBERED_FOLDER.match(folder)
    return (match[1], int(match[2])) if match else (folder, 1)


def _is_downscaled(large_factor: int, small_factor: int, large: tuple[int, int], small: tuple[int, int]) -> bool:
    """Return True if two pictures' sizes agree with the factors in the names of their folders.

    large_factor, small_factor: factors by which the larger and the smaller picture are downscaled.
    large, small: width and height of the larger and the smaller picture.
    """
    if large_factor >= small_factor:
        return False
    sides = zip(large, small, strict=True)
    return all(abs(less * small_factor / large_factor - more) <= small_factor for more, less in sides)


def _is_same(one: Decoded, two: Decoded) -> bool:
    if one.thumb is None or two.thumb is None:
        return False
    if abs(one.width * two.height / (one.height * two.width) - 1) > ASPECT_RATIO_TOLERANCE:
        return False
    side = COPY_THUMBNAIL_SIZE_PX[0]
    while side > MAX_COMPARED_PIXELS_PER_PIXEL * min(one.width, two.width) and side > MIN_COMPARED_WIDTH_PX:
        side //= 2
    first, second = (reduced(each.astype(np.float32)[:, :, None], side)[:, :, 0] for each in (one.thumb, two.thumb))
    if min(float(first.std()), float(second.std())) < FEATURELESS_STD_LEVELS:
        return False
    steps = np.sqrt(0.5 * (np.square(np.diff(first, axis=0)).mean() + np.square(np.diff(first, axis=1)).mean()))
    return float(np.sqrt(np.square(first - second).mean())) <= max(
        MAX_COPY_RMS_LEVELS, MAX_COPY_RMS_PER_GRADIENT * float(steps)
    )
