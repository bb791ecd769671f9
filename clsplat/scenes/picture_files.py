# SPDX-License-Identifier: Apache-2.0
"""The pictures that a data set lists, on disk: under the listed names, under others, in other folders, or missing."""

from __future__ import annotations

import os
from collections.abc import Collection, Sequence
from pathlib import Path, PurePosixPath

from clsplat.config.training import Missing
from clsplat.errors import InputError, examples, warn
from clsplat.files import is_file
from clsplat.images.reading import companions, find_images
from clsplat.scenes.picture_names import legible, match, nearest, slashed

SMALLER = (2, 4, 8)
"""Factors of the folders of smaller pictures, images_2 and so on, that stand in where their size is asked for."""
COPIES = range(2, 65)
"""Factors of those that are taken where there are no others."""
FEW_MISSING = 0.1
"""Share of the pictures that may be missing where nothing is said of it: some are thrown away, or did not copy. Where
more are, the folder may be another one."""


def find_pictures(
    listed: Sequence[str],
    exact: Sequence[Path | None],
    folder: Path,
    listed_in: Path,
    missing: Missing = "few",
    present: Collection[Path] | None = None,
) -> list[Path | None]:
    """The file of each listed picture, None for those that are missing and left out.

    listed: names; exact: the files that they name, None for one that may not be opened; folder: where pictures are
    searched by other names (`picture_names`); present: the pictures in it, if they are known; missing: "error" leaves
    none out, "skip" any number but all, "few" up to FEW_MISSING of them. Warns of other names and of what is left out.
    Raises InputError that names what is missing, and what is there in its place.
    """
    files = [path if path is not None and is_file(path) else None for path in exact]
    lost = [index for index, path in enumerate(files) if path is None]
    if not lost:
        return files
    there = by_name(folder, find_images(folder) if present is None else present, [path for path in files if path])
    taken = {path for path in files if path}
    free = [name for name, path in there.items() if path not in taken]
    settled = [name for name, path in zip(listed, files, strict=True) if path]
    found = match([listed[index] for index in lost], free, settled)
    for index in lost:
        if listed[index] in found.names:
            files[index] = there[found.names[listed[index]]]
    if found.how:
        names = f"{len(found.names):,} picture(s) are there under other names than listed, and are used"
        warn(f"{listed_in}: {names}: {'; '.join(found.how)}")
    if gone := [index for index in lost if files[index] is None]:
        shown = examples(legible(str(exact[index] or listed[index])) for index in gone)
        text = f"{listed_in}: lists {len(gone):,} image(s) that are missing: {shown}"
        allowed = {"error": 0, "skip": len(listed) - 1, "few": int(FEW_MISSING * len(listed))}[missing]
        if len(gone) > allowed:
            others = len(find_images(folder) if present is None else present)
            close = nearest(listed[gone[0]], sorted(set(free).difference(found.names.values())))
            text += f"; of other names there is {close}" if close else f"; {others:,} others are in {folder}"
            usual = next((path.parent for path in exact if path is not None), folder)
            copies = [copy for factor in COPIES if has_pictures(copy := usual.with_name(f"{usual.name}_{factor}"))]
            text += f"; smaller ones are in {copies[0]}" if copies else ""
            some = "; train and eval go on with the others by --missing skip"
            raise InputError(text + ("" if len(gone) == len(listed) else some))
        warn(f"{text}; the other {len(listed) - len(gone):,} are used")
    return files


def called(listed: str, exact: Path | None, file: Path | None, folder: Path) -> str:
    """The name of a picture in its scene: the listed one, with the file's extension where it has none, or where it has
    other folders that of the file in the folder where it was found."""
    plain = listed if listed.isprintable() else slashed(legible(listed))
    if file is None or file == exact:
        return plain
    inner = file.relative_to(folder).as_posix() if file.is_relative_to(folder) else slashed(plain)
    if inner.count("/") != slashed(plain).count("/"):
        return inner
    return slashed(plain) if PurePosixPath(plain).suffix else f"{slashed(plain)}{file.suffix}"


def by_name(folder: Path, present: Collection[Path], used: Sequence[Path]) -> dict[str, Path]:
    """The pictures by their names in a folder, without those that go with others (masks, depths) and without smaller
    copies of a folder that has pictures."""
    aside = companions(present, used, folder)
    copies = {path for path in {path.parent for path in present} if is_smaller_copy(path)}
    kept = (path for path in present if path not in aside and not copies.intersection(path.parents))
    return {path.relative_to(folder).as_posix(): path for path in kept if path.is_relative_to(folder)}


def is_smaller_copy(folder: Path) -> bool:
    """True for images_2 and the like beside images/ with pictures."""
    base, _, factor = folder.name.rpartition("_")
    return factor in map(str, COPIES) and bool(base) and has_pictures(folder.with_name(base))


def has_pictures(folder: Path) -> bool:
    """True if a folder is there and has pictures in it or below it."""
    return os.path.isdir(folder) and bool(find_images(folder))  # noqa: PTH112  # Path raises for names too long


def or_smaller(folder: Path) -> Path:
    """The folder, or if it has no pictures the one beside it with the largest of its smaller copies (images_2), if
    there is one."""
    if has_pictures(folder):
        return folder
    copies = (folder.with_name(f"{folder.name}_{factor}") for factor in COPIES)
    return next((copy for copy in copies if has_pictures(copy)), folder)
