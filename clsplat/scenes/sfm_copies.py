# SPDX-License-Identifier: Apache-2.0
"""The same photograph twice in a folder: smaller or corrected copies, other types, other names. One of them is used."""

from __future__ import annotations

import re
from collections import defaultdict
from collections.abc import Callable, Hashable, Iterable, Sequence
from dataclasses import dataclass
from pathlib import Path, PurePosixPath
from typing import Any, Protocol

import numpy as np
from numpy.typing import NDArray

from clsplat.errors import InputError, examples
from clsplat.files import is_file, short_digest
from clsplat.images.reading import downscale, image_size
from clsplat.scenes.glance import GREY, SHARP_SIDE, reduced

STAGES = (
    ("input", "inputs", "original", "originals", "raw", "distorted"),
    ("images", "image"),
    ("corrected_images", "images_corrected", "corrected", "undistorted", "undistorted_images", "images_undistorted"),
)
"""Names of folders that hold the same photographs before and after their lens was undone, earlier ones first: those of
the 3DGS authors' convert.py, of Polycam, and the like."""
LOSSLESS = (".png", ".tif", ".tiff", ".bmp")
THUMB = (96, 72)
"""Width and height of what is compared of a picture."""
FINEST, COARSEST = 0.5, 24
"""Most pixels of it for each of the picture's, and fewest that are compared across: in small ones resizing shows."""
SAME, SHIFT = 1.0, 0.2
"""Root mean square difference of two such up to which both are one photograph, in 255ths, or in the differences of
neighbouring pixels: what a shift by a fifth of a pixel makes, a 480th of the picture's width. JPEG and the filters of
resizing change less, down to pictures of 240 pixels."""
FLAT = 8.0
"""Standard deviation, in 255ths, under which a picture shows nothing, and is like no other."""
SHAPE = 0.02
"""Part by which the proportions of one photograph may differ, as sides are rounded."""
SLICE = 4096
"""Bytes from the middle of a file that are compared before all of it is."""

_NUMBERED = re.compile(r"(.+?)[_-](\d{1,2})\Z")
Thumb = NDArray[np.uint8]


class Decoded(Protocol):
    """A photograph that was decoded."""

    @property
    def name(self) -> str:
        """The path below the folder."""

    @property
    def width(self) -> int:
        """Pixels, upright."""

    @property
    def height(self) -> int:
        """Pixels, upright."""

    @property
    def lens(self) -> tuple[str, ...]:
        """Make, model and focal length from EXIF, empty strings for none."""

    @property
    def transparent(self) -> bool:
        """True if any pixel is."""

    @property
    def thumb(self) -> Thumb | None:
        """A `thumb_of` it, None where it is not compared."""


@dataclass(frozen=True)
class Copy:
    """A photograph that is another one again. kept: the other's name; why: by what it is, and is not the one kept."""

    kept: str
    why: str


def told_by_names(folder: Path, names: Sequence[str]) -> dict[str, Copy]:
    """Copies by name that need no decoding: files of the same bytes, and pictures of folders whose names tell.

    Pictures of images_2 are those of images, of the same names, if they have half of their size. Pictures of the
    folders in STAGES are the same where they have the same names: kept are those of most pixels, then the earlier.
    """
    copies = _of_same_bytes(folder, names)
    sizes: dict[str, tuple[int, int]] = {}

    def size_of(name: str) -> tuple[int, int]:
        if name not in sizes:
            try:
                sizes[name] = image_size(folder / name)
            except InputError:  # told when it is decoded
                sizes[name] = (0, 0)
        return sizes[name]

    def why(kept: _Place, other: _Place) -> str:
        size, whole = size_of(other.name), size_of(kept.name)
        if _is_downscaled(kept.folder, other.folder, whole, size):
            return "smaller"
        stages = {_stage(kept.folder), _stage(other.folder)}
        if len(stages) == 2 and max(stages) < len(STAGES) and min(*size, *whole) > 0:
            return "smaller" if size[0] * size[1] < whole[0] * whole[1] else "corrected"
        return ""

    def rank(place: _Place) -> tuple[Hashable, ...]:
        width, height = size_of(place.name)
        return (-width * height, _stage(place.folder), _numbered(place.folder)[1])

    left = [name for name in names if name not in copies]
    groups = [group for group in _alike(left) if any(_tells(place.folder) for place in group)]
    return resolved({**copies, **_found(groups, rank, why)})


def told_by_pictures(photos: Sequence[Decoded]) -> dict[str, Copy]:
    """Copies by name among decoded photographs: the same picture under the same name in folders beside each other, or
    of another type. Kept is that of most pixels, then with transparent parts, then with a lens in EXIF, then lossless.
    """
    by_name = {photo.name: photo for photo in photos}

    def why(kept: _Place, other: _Place) -> str:
        one, two = by_name[kept.name], by_name[other.name]
        if not _is_same(one, two):
            return ""
        return "smaller" if one.width * one.height > two.width * two.height else "same picture"

    def rank(place: _Place) -> tuple[Hashable, ...]:
        photo = by_name[place.name]
        lossless = PurePosixPath(photo.name).suffix.lower() in LOSSLESS
        return (-photo.width * photo.height, not photo.transparent, not any(photo.lens), not lossless)

    return resolved(_found(_alike(list(by_name)), rank, why))


def to_compare(names: Sequence[str]) -> set[str]:
    """The photographs of which `told_by_pictures` needs a `thumb_of`."""
    return {place.name for group in _alike(names) for place in group}


def thumb_of(pixels: NDArray[Any], alpha: int) -> Thumb:
    """A small picture (72, 96), grey, of one (H, W, C) of whole numbers, or of floats from 0 to 1, whatever its shape
    is. alpha: the channel that is no colour, -1 for none."""
    colour = [index for index in range(pixels.shape[2]) if index != alpha]
    small = np.asarray(reduced(pixels, SHARP_SIDE)[:, :, colour], np.float32)
    grey = small[:, :, :3] @ GREY if len(colour) >= 3 else small[:, :, 0]
    most = float(np.iinfo(pixels.dtype).max) if pixels.dtype.kind == "u" else 1.0
    levels = downscale(grey[:, :, None], *THUMB)[:, :, 0] * (255 / most)
    return np.asarray(np.rint(np.clip(np.nan_to_num(levels), 0, 255)), np.uint8)


def resolved(copies: dict[str, Copy]) -> dict[str, Copy]:
    """The copies with what is kept in the end: that of a copy may be one itself."""

    def last(name: str) -> str:
        while name in copies:
            name = copies[name].kept
        return name

    return {name: Copy(last(copy.kept), copy.why) for name, copy in copies.items()}


def listed(copies: dict[str, Copy]) -> str:
    """Copies for a line of text, the first of them by name."""
    return examples(f"{name} is {copy.kept}, {copy.why}" for name, copy in sorted(copies.items()))


@dataclass(frozen=True)
class _Place:
    """A photograph's name, and the folder in it, "" for none, in which it may differ from its copies."""

    name: str
    folder: str


def _alike(names: Iterable[str]) -> list[list[_Place]]:
    """Photographs of one name, but for the extension, in one folder, in folders beside each other, or in a folder and
    one in it: all that may be copies by their names. The folders may have folders in them, of the same names."""
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
    groups: Iterable[list[_Place]],
    rank: Callable[[_Place], tuple[Hashable, ...]],
    why: Callable[[_Place, _Place], str],
) -> dict[str, Copy]:
    """Of each group the first by rank is kept, with all that are none of its copies; why(kept, other) is empty then."""
    copies: dict[str, Copy] = {}
    for group in groups:
        kept: list[_Place] = []
        for place in sorted(group, key=lambda place: (*rank(place), len(place.name), place.name)):
            if place.name in copies:
                continue
            first = next(((one, text) for one in kept if (text := why(one, place))), None)
            if first is None:
                kept.append(place)
            else:
                copies[place.name] = Copy(first[0].name, first[1])
    return copies


def _of_same_bytes(folder: Path, names: Sequence[str]) -> dict[str, Copy]:
    """Files that are another's bytes. Kept is the one of the earliest of STAGES, then that of the shortest name."""
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
        return file.read(SLICE)


def _stage(folder: str) -> int:
    """Place of a folder's name in STAGES, behind all for another's."""
    return next((stage for stage, known in enumerate(STAGES) if folder.casefold() in known), len(STAGES))


def _numbered(folder: str) -> tuple[str, int]:
    """images_4 as images and 4; a factor of 1 where the name has none."""
    match = _NUMBERED.match(folder)
    return (match[1], int(match[2])) if match else (folder, 1)


def _tells(folder: str) -> bool:
    return _stage(folder) < len(STAGES) or _numbered(folder)[1] > 1


def _is_downscaled(kept: str, other: str, whole: tuple[int, int], size: tuple[int, int]) -> bool:
    """True if two folders' names and sizes say that one has the other's pictures, by the factors in their names."""
    (name, factor), (same, by) = _numbered(kept), _numbered(other)
    if name.casefold() != same.casefold() or not 0 < factor < by:
        return False
    return all(abs(side * by / factor - long) <= by for side, long in zip(size, whole, strict=True))


def _is_same(one: Decoded, two: Decoded) -> bool:
    if one.thumb is None or two.thumb is None:
        return False
    if abs(one.width * two.height / (one.height * two.width) - 1) > SHAPE:
        return False
    side = THUMB[0]
    while side > FINEST * min(one.width, two.width) and side > COARSEST:
        side //= 2
    first, second = (reduced(each.astype(np.float32)[:, :, None], side)[:, :, 0] for each in (one.thumb, two.thumb))
    if min(float(first.std()), float(second.std())) < FLAT:
        return False
    steps = np.sqrt(0.5 * (np.square(np.diff(first, axis=0)).mean() + np.square(np.diff(first, axis=1)).mean()))
    return float(np.sqrt(np.square(first - second).mean())) <= max(SAME, SHIFT * float(steps))
