# SPDX-License-Identifier: Apache-2.0
"""The same photograph twice in a folder: smaller or corrected copies, other types, other names. One of them is used."""

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
from clsplat.files import is_file, short_digest
from clsplat.images.reading import EXTENSIONS, downscale, image_size, read_image
from clsplat.scenes.glance import GREY, SHARP_SIDE, reduced

STAGES = (
    ("input", "inputs", "original", "originals", "raw", "distorted"),
    ("images", "image", "rgb", "color", "colour", "frames", "photos"),
    (
        *("corrected_images", "images_corrected", "corrected", "undistorted", "undistorted_images"),
        *("images_undistorted", "dense"),
    ),
)
"""Names of folders that may hold the same photographs before and after their lens was undone, earlier ones first: those
of the 3DGS authors' convert.py, of Polycam, OpenSfM (undistorted/images), COLMAP (dense/0/images), and the like."""
PLAIN, UNDONE = 1, 2
"""Places in STAGES of photographs in no such folder, and of those whose lens was undone."""
LOSSLESS = (".png", ".tif", ".tiff", ".bmp")
THUMB = (96, 72)
"""Width and height of what is compared of a picture."""
FINEST, COARSEST = 0.5, 24
"""Most pixels of it for each of the picture's, and fewest that are compared across: in small ones resizing shows."""
SAME, SHIFT = 1.0, 0.2
"""Root mean square difference of two such up to which both are one photograph, in 255ths, or in the differences of
neighbouring pixels: what a shift by a fifth of a pixel makes, a 480th of the picture's width. JPEG and the filters of
resizing change less, down to pictures of 240 pixels."""
ALIKE, ACROSS = 0.9, 24
"""Correlation, of pictures of so many pixels across, from which on those of two folders whose names tell are the same:
the median of SAMPLES. Of photographs and themselves through an undone lens it is 0.9995 (fox, k1 0.058, k2 -0.081), and
0.93 or more in six scenes with k1 from 0.1 to -0.35 at a focal length of 0.8 of the width, cropped to what is full. Of
photographs and the next in the same scenes it is 0.16 to 0.87, of those further on 0.45 at most; but of a video's next
frames, where it stands almost still, more than of itself through a strong lens: such folders are taken for copies."""
SAMPLES = 5
"""Pairs of pictures of two folders that are decoded to compare these."""
TURNED = 1.3
"""Factor from which on proportions are those of another picture, though undoing a lens cuts borders off."""
FLAT = 8.0
"""Standard deviation, in 255ths, under which a picture shows nothing, and is like no other."""
SHAPE = 0.02
"""Part by which the proportions of one photograph may differ, as sides are rounded."""
SLICE = 4096
"""Bytes from the middle of a file that are compared before all of it is."""

_NUMBERED = re.compile(r"(.+?)[_-](\d{1,2})\Z")
Thumb = NDArray[np.uint8]
P = TypeVar("P", "_Place", "_Staged")


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
    """Copies that are told before all is decoded: files of the same bytes, and pictures of the same names in folders
    whose names tell and whose pictures look alike, of which some are decoded.

    Such are images_2 beside images, with half of their size, and those of STAGES, beside each other or one in another.
    Kept is the folder whose pictures have most pixels, then the earlier.
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


@dataclass(frozen=True)
class _Staged:
    """A photograph by what the names of its folders say. head: the path to the last folder that tells, "" for none;
    stage: its place in STAGES, the latest of these folders'; factor: by which it is smaller."""

    name: str
    head: str
    stage: int
    factor: int

    @property
    def kind(self) -> tuple[int, int]:
        """Stage and factor."""
        return self.stage, self.factor


class _Pictures:
    """The pictures in a folder, by the folders in it, as far as they are looked at. groups: those of the same name."""

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
        """Width and height, 0 of what does not decode: that is told when it is staged."""
        if name not in self._sizes:
            try:
                self._sizes[name] = image_size(self._folder / name)
            except InputError:
                self._sizes[name] = (0, 0)
        return self._sizes[name]

    def pixels(self, head: str) -> int:
        """Pixels of the median picture."""
        if head not in self._pixels:
            self._pixels[head] = sorted(math.prod(self.size(name)) for name in self._names[head])[
                len(self._names[head]) // 2
            ]
        return self._pixels[head]

    def are_alike(self, one: str, two: str) -> bool:
        """True if the pictures of two folders are the same ones, but for a lens that was undone."""
        key = frozenset((one, two))
        if key not in self._alike:
            pairs = self._pairs[key]
            chosen = sorted({round(at) for at in np.linspace(0, len(pairs) - 1, min(SAMPLES, len(pairs)))})
            likeness = [each for at in chosen if (each := self._likeness(*pairs[at])) is not None]
            self._alike[key] = bool(likeness) and float(np.median(likeness)) >= ALIKE
        return self._alike[key]

    def _likeness(self, one: str, two: str) -> float | None:
        """Correlation of two pictures, None where one shows nothing."""
        (width, height), (across, down) = self.size(one), self.size(two)
        thumbs = [thumb for thumb in (self._thumb(one), self._thumb(two)) if thumb is not None]
        if len(thumbs) < 2 or min(width, height, across, down) < 1:
            return None
        if not 1 / TURNED < width * down / (height * across) < TURNED:
            return 0.0
        first, second = (reduced(each.astype(np.float32)[:, :, None], ACROSS) for each in thumbs)
        if min(float(first.std()), float(second.std())) < FLAT:
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
    """Photographs of one name, but for the extension, in folders of one name, but for those that tell, where there are
    two kinds. Before a folder of pictures whose lens was undone there may be others, of the program's."""
    groups: dict[tuple[Hashable, ...], list[_Staged]] = defaultdict(list)
    for name in names:
        parts = [part.casefold() for part in PurePosixPath(name).parts[:-1]]
        stage, factor, told, undone = -1, 1, set(), 0
        for at, part in enumerate(parts):
            word, by = _numbered(part)
            its = min(_stage(part), _stage(word))
            if its < len(STAGES):
                stage, factor = max(stage, its), by if _stage(part) == len(STAGES) else 1
                undone = at if its == UNDONE else undone
                told.add(at)
            elif part.isdigit() and at and parts[at - 1] == "dense":
                told.add(at)
        head = "/".join(PurePosixPath(name).parts[: max(told, default=-1) + 1])
        place = _Staged(name, head, stage if told else PLAIN, factor)
        for start in {0, undone}:
            others = tuple(part for at, part in enumerate(parts) if at >= start and at not in told)
            groups[(others, _plain_stem(name))].append(place)
    return [group for group in groups.values() if len({place.kind for place in group}) > 1]


def _plain_stem(name: str) -> str:
    """A picture's name in lower case, without its extensions: OpenSfM undoes IMG.JPG to IMG.JPG.jpg."""
    stem = PurePosixPath(PurePosixPath(name).stem.casefold())
    return stem.stem if stem.suffix in EXTENSIONS else stem.name


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
    groups: Iterable[list[P]], rank: Callable[[P], tuple[Hashable, ...]], why: Callable[[P, P], str]
) -> dict[str, Copy]:
    """In each group, in the order of rank, what is a copy of one before it, which may be one itself; why(kept, other)
    is empty where it is none."""
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


def _is_downscaled(factor: int, by: int, whole: tuple[int, int], size: tuple[int, int]) -> bool:
    """True if sizes say that a picture is the other by the factors in the names of their folders."""
    return factor < by and all(abs(side * by / factor - long) <= by for side, long in zip(size, whole, strict=True))


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
