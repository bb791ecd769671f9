# SPDX-License-Identifier: Apache-2.0
"""Files that go with photographs, in a folder beside theirs: masks, depth maps."""

from __future__ import annotations

from collections.abc import Iterable, Mapping, Sequence
from pathlib import Path, PurePosixPath
from typing import Protocol

from clsplat.errors import InputError, examples


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
    transforms.json, the first folder of all names."""
    top = images[0].path
    for _ in PurePosixPath(images[0].name).parts:
        top = top.parent
    firsts = {PurePosixPath(image.name).parts[0] for image in images}
    return [*(top / first for first in firsts if len(firsts) == 1 and (top / first).is_dir()), top]


def beside(base: Path, names: Sequence[str]) -> Path | None:
    """The folder of one of these names in a folder of photographs, or beside it, which may be outside the scene."""
    return next((at for parent in (base, base.parent) for name in names if (at := parent / name).is_dir()), None)


def owned(
    folder: Path,
    paths: Iterable[Path],
    known: Mapping[str, str],
    what: str,
    example: str,
    *,
    without: Iterable[Path] = (),
    strict: bool = True,
) -> dict[str, Path]:
    """The files of a folder by the photographs that they go with. known: these by the names that a file may have,
    without its extension; what: a word for such a file; example: a photograph's name; without: files to pass over;
    strict: whether files that fit no photograph are refused, or passed over too.

    Raises InputError for a file that fits no photograph, and for two of one.
    """
    found: dict[str, Path] = {}
    lost: list[str] = []
    passed = {path.resolve() for path in without}
    for path in (path for path in paths if path.resolve() not in passed):
        relative = path.relative_to(folder).as_posix()
        owner = known.get(str(PurePosixPath(relative).with_suffix("")))
        if owner is None:
            lost.append(relative)
        elif owner in found:
            raise InputError(f"{path}: is a second {what} of {owner}, beside {found[owner].name}; remove one of them")
        else:
            found[owner] = path
    if lost and strict:
        raise InputError(
            f"{folder}: {len(lost):,} {what}(s) fit no photograph ({examples(lost)}): expected names such as "
            f"{example}.png; rename or remove them"
        )
    return found
