# SPDX-License-Identifier: Apache-2.0
"""Search for sidecar files of photographs, such as masks and depth maps, in a folder inside or next to the
photographs' own."""

from __future__ import annotations

import re
import unicodedata
from collections.abc import Callable, Iterable, Mapping, Sequence
from pathlib import Path, PurePosixPath
from typing import Protocol

from clsplat.errors import InputError, examples

_INNER_EXTENSION = re.compile(
    r"\.(?:jpe?g|png|tiff?|webp|bmp|exr|hei[cf]|hif|avif|dng|cr[23]|nef|arw|raf|orf|rw2)(?=[._-]|\Z)"
)
"""Photograph's extension inside the name of a sidecar file, as in IMAGE.jpg.png."""

_TRAILING_NUMBER = re.compile(r"(.*?)([0-9]{1,18})\Z", re.DOTALL)
"""A name that ends in a number: the text before it, and the number."""


class Named(Protocol):
    """A photograph: its name in the data set, and its file."""

    @property
    def name(self) -> str:
        """Name of the photograph, with sub-folders."""

    @property
    def path(self) -> Path:
        """Path of the photograph's file."""


def bases_of(images: Sequence[Named]) -> list[Path]:
    """Return folders that contain all photographs. Sidecar folders are searched inside them and next to them.

    The photographs' names are relative to the last folder of the list. If all names begin with the same sub-folder, as
    is usual in transforms.json, the list begins with this sub-folder.
    """
    top = images[0].path
    for _ in PurePosixPath(images[0].name).parts:
        top = top.parent
    firsts = {PurePosixPath(image.name).parts[0] for image in images}
    bases = [*(top / first for first in firsts if len(firsts) == 1 and (top / first).is_dir()), top]
    return [base for base in bases if all(image.path.is_relative_to(base) for image in images)]


def beside(base: Path, names: Sequence[str]) -> Path | None:
    """Return the folder in `base` or next to it with one of these lower-case names, or None.

    The case of the folder's name is ignored. Earlier names take precedence.
    """
    return next((at for parent in (base, base.parent) if (at := inside(parent, names)) is not None), None)


def inside(parent: Path, names: Sequence[str]) -> Path | None:
    """Return the folder in `parent` with one of these lower-case names, or None.

    The case of the folder's name is ignored. Earlier names take precedence.
    """
    for name in names:
        if (at := parent / name).is_dir():
            return at
    try:
        there = sorted(path for path in parent.iterdir() if path.name.casefold() in names and path.is_dir())
    except OSError:
        return None
    return min(there, key=lambda path: names.index(path.name.casefold()), default=None)


def owned(
    folder: Path,
    paths: Iterable[Path],
    known: Mapping[str, str],
    what: str,
    example: str,
    *,
    without: Iterable[Path] = (),
    strict: bool = True,
    numbered: bool = False,
) -> dict[str, Path]:
    """Match the sidecar files of a folder to photographs. Returns the file of each photograph, by its name.

    paths: the sidecar files in `folder`.
    known: maps each name that a sidecar file may have, without extension, to the name of its photograph.
    what: the kind of sidecar file, such as "mask", for messages.
    example: name of a photograph, for messages.
    without: files to skip.
    strict: raise InputError for a file that fits no photograph; otherwise it is skipped.
    numbered: match mask_0007.png to image_0007.png if no other match is found. The files' names must differ only in a
        number, and the photographs' names too.

    Exact names are matched first. In later steps a file may differ from a name in case, then also in the photograph's
    extension, then also in folders, if it fits exactly one photograph. Raises InputError for two files of a photograph;
    if not `strict`, only if both names are exact.
    """
    found: dict[str, Path] = {}
    passed = {path.resolve() for path in without}
    left = {path: path.relative_to(folder).as_posix() for path in paths if path.resolve() not in passed}
    for step in _NAME_KEYS:
        owners = _unambiguous(known, step)
        by_owner: dict[str, list[Path]] = {}
        for path, relative in left.items():
            if (owner := owners.get(step(str(PurePosixPath(relative).with_suffix(""))))) is not None:
                by_owner.setdefault(owner, []).append(path)
        for owner, files in by_owner.items():
            first, *more = [*([found[owner]] if owner in found else []), *files]
            if more and (strict or step is str):
                second = f"{more[0]}: is a second {what} of {owner}, besides {first.name}"
                raise InputError(f"{second}; remove one of them")
            if not more:
                found[owner] = first
                del left[first]
    if numbered and not found:
        numbers, photographs = _series(left.values()), _series(set(known.values()))
        by_relative = {relative: path for path, relative in left.items()}
        for number in numbers.keys() & photographs.keys():
            found[photographs[number]] = path = by_relative[numbers[number]]
            del left[path]
    if left and strict:
        raise InputError(
            f"{folder}: {len(left):,} {what}(s) fit no photograph ({examples(left.values())}): expected names such as "
            f"{example}.png; rename or remove them"
        )
    return found


def _series(names: Iterable[str]) -> dict[int, str]:
    """Map the numbers at the end of names, before the extension, to the names.

    The result is empty unless there are at least two names that differ only in this number.
    """
    texts, numbers = set(), {}
    names = sorted(names)
    for name in names:
        match = _TRAILING_NUMBER.match(_INNER_EXTENSION.sub("", _loose(str(PurePosixPath(name).with_suffix("")))))
        if match is None:
            return {}
        texts.add(match[1])
        numbers[int(match[2])] = name
    return numbers if len(texts) == 1 and 1 < len(numbers) == len(names) else {}


def _loose(name: str) -> str:
    return unicodedata.normalize("NFC", name).casefold()


_NAME_KEYS: tuple[Callable[[str], str], ...] = (
    str,
    _loose,
    lambda name: _INNER_EXTENSION.sub("", _loose(name)),
    lambda name: _INNER_EXTENSION.sub("", _loose(name)).rpartition("/")[2],
)
"""Functions that reduce a name to a key, for successive steps of matching. Each step ignores more of the name."""


def _unambiguous(known: Mapping[str, str], step: Callable[[str], str]) -> dict[str, str]:
    """Map keys to names of photographs. Keys that belong to several photographs are left out.

    known: maps each name that a sidecar file may have to the name of its photograph.
    step: function that reduces a name of `known` to a key, one of _NAME_KEYS.
    """
    if step is str:
        return dict(known)
    owners: dict[str, set[str]] = {}
    for name, owner in known.items():
        owners.setdefault(step(name), set()).add(owner)
    return {key: next(iter(each)) for key, each in owners.items() if len(each) == 1}
