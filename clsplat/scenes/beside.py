# SPDX-License-Identifier: Apache-2.0
"""Files that go with photographs, in a folder beside theirs: masks, depth maps."""

from __future__ import annotations

import re
import unicodedata
from collections.abc import Callable, Iterable, Mapping, Sequence
from pathlib import Path, PurePosixPath
from typing import Protocol

from clsplat.errors import InputError, examples

_INNER = re.compile(r"\.(?:jpe?g|png|tiff?|webp|bmp|exr|heic|dng)(?=[._-]|\Z)")
"""A photograph's extension in the name of a file that goes with it."""

_NUMBER = re.compile(r"(.*?)([0-9]{1,18})\Z", re.DOTALL)


class Named(Protocol):
    """A photograph: its name in the data set, and its file."""

    @property
    def name(self) -> str:
        """The name, with sub-folders."""

    @property
    def path(self) -> Path:
        """The file."""


def bases_of(images: Sequence[Named]) -> list[Path]:
    """Folders of photographs that others may stand beside, or in: that which their names begin in, and before it, as of
    transforms.json, the first folder of all names. All photographs are in each of them."""
    top = images[0].path
    for _ in PurePosixPath(images[0].name).parts:
        top = top.parent
    firsts = {PurePosixPath(image.name).parts[0] for image in images}
    bases = [*(top / first for first in firsts if len(firsts) == 1 and (top / first).is_dir()), top]
    return [base for base in bases if all(image.path.is_relative_to(base) for image in images)]


def beside(base: Path, names: Sequence[str]) -> Path | None:
    """The folder of one of these names, in any case, in a folder of photographs, or beside it, which may be outside the
    scene."""
    return next((at for parent in (base, base.parent) if (at := inside(parent, names)) is not None), None)


def inside(parent: Path, names: Sequence[str]) -> Path | None:
    """The folder of the first of these names, in lower case, that a folder has in any case."""
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
    """The files of a folder by the photographs that they go with. known: these by the names that a file may have,
    without its extension; what: a word for such a file; example: a photograph's name; without: files to pass over;
    strict: whether files that fit no photograph are refused, or passed over too; numbered: whether mask_0007.png is
    that of image_0007.png, where no name fits otherwise, and the files and the photographs are one series each.

    Names need not agree to the letter: what is left after exact ones may differ in case, then in the photograph's
    extension, then in folders, each where that leaves one photograph alone. Raises InputError for a file that fits no
    photograph, and for two of one.
    """
    found: dict[str, Path] = {}
    passed = {path.resolve() for path in without}
    left = {path: path.relative_to(folder).as_posix() for path in paths if path.resolve() not in passed}
    for step in _STEPS:
        owners = _unambiguous(known, step)
        by_owner: dict[str, list[Path]] = {}
        for path, relative in left.items():
            if (owner := owners.get(step(str(PurePosixPath(relative).with_suffix(""))))) is not None:
                by_owner.setdefault(owner, []).append(path)
        for owner, files in by_owner.items():
            first, *more = [*([found[owner]] if owner in found else []), *files]
            if more and (strict or step is str):
                second = f"{more[0]}: is a second {what} of {owner}, beside {first.name}"
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
    """Names by the number at their end, before extensions, where there are two or more that differ in that alone."""
    texts, numbers = set(), {}
    names = sorted(names)
    for name in names:
        match = _NUMBER.match(_INNER.sub("", _loose(str(PurePosixPath(name).with_suffix("")))))
        if match is None:
            return {}
        texts.add(match[1])
        numbers[int(match[2])] = name
    return numbers if len(texts) == 1 and 1 < len(numbers) == len(names) else {}


def _loose(name: str) -> str:
    return unicodedata.normalize("NFC", name).casefold()


_STEPS: tuple[Callable[[str], str], ...] = (
    str,
    _loose,
    lambda name: _INNER.sub("", _loose(name)),
    lambda name: _INNER.sub("", _loose(name)).rpartition("/")[2],
)
"""Parts of a name that count, from all of it to its end without a photograph's extension."""


def _unambiguous(known: Mapping[str, str], step: Callable[[str], str]) -> dict[str, str]:
    """Photographs by the parts that count of the names that their files may have, where these are one photograph's."""
    if step is str:
        return dict(known)
    owners: dict[str, set[str]] = {}
    for name, owner in known.items():
        owners.setdefault(step(name), set()).add(owner)
    return {key: next(iter(each)) for key, each in owners.items() if len(each) == 1}
