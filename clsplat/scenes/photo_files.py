# SPDX-License-Identifier: Apache-2.0
"""Search for the files of a data set's pictures, which may have other names, be in other folders, or be missing."""

from __future__ import annotations

import os
from collections.abc import Collection, Sequence
from pathlib import Path, PurePosixPath

from clsplat.config.training import Missing
from clsplat.errors import InputError, examples, warn
from clsplat.files.documents import is_file
from clsplat.images.reading import companions, find_images
from clsplat.scenes.photo_names import legible, match, nearest, slashed

DOWNSCALED_FOLDER_FACTORS = (2, 4, 8)
"""Factors by which the sides of downscaled pictures are divided, such as 2 in the folder images_2. Folders with these
factors are used if pictures of exactly their size are requested."""
FALLBACK_FOLDER_FACTORS = range(2, 65)
"""Factors, such as 3 in images_3, by which a folder is recognised as a downscaled copy. Such folders are used only if
there are no other pictures."""
MAX_MISSING_FRACTION = 0.1
"""Maximum fraction of missing pictures by default, as users delete some or do not copy all.

If more pictures are missing, the folder may be the wrong one.
"""


def by_label(folder: Path, present: Sequence[Path]) -> dict[str, Path]:
    """Map labels to pictures. A label is a path below the folder without its extension.

    Of IMG.jpg and IMG.png the first one in alphabetical order is the photograph, because the PNG may be a mask.

    present: the pictures in `folder`, sorted.
    """
    return {path.relative_to(folder).with_suffix("").as_posix(): path for path in reversed(present)}


def find_pictures(
    listed: Sequence[str],
    exact: Sequence[Path | None],
    folder: Path,
    listed_in: Path,
    missing: Missing = "few",
    present: Collection[Path] | None = None,
) -> list[Path | None]:
    """Find the file of each listed picture; None for pictures that are missing and left out.

    listed: names in the data set.
    exact: the files with these names, None for a file that must not be opened.
    folder: folder that is searched for pictures with other names (`photo_names`).
    listed_in: the file with the list, for messages.
    missing: how many pictures may be left out: "error" none, "skip" any number but not all, "few" up to
        MAX_MISSING_FRACTION.
    present: the pictures in `folder`, if known.
    Warns of pictures found under other names and of pictures that are left out. Raises InputError that names the
    missing pictures and similar names.
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
        names = f"{len(found.names):,} listed picture(s) not found by name; files with similar names are used instead"
        warn(f"{listed_in}: {names}: {'; '.join(found.how)}")
    if gone := [index for index in lost if files[index] is None]:
        shown = examples(legible(str(exact[index] or listed[index])) for index in gone)
        text = f"{listed_in}: lists {len(gone):,} image(s) that are missing: {shown}"
        allowed = {"error": 0, "skip": len(listed) - 1, "few": int(MAX_MISSING_FRACTION * len(listed))}[missing]
        if len(gone) > allowed:
            others = len(find_images(folder) if present is None else present)
            close = nearest(listed[gone[0]], sorted(set(free).difference(found.names.values())))
            text += f"; similar names are {close}" if close else f"; {others:,} others are in {folder}"
            usual = next((path.parent for path in exact if path is not None), folder)
            copies = [
                copy
                for factor in FALLBACK_FOLDER_FACTORS
                if has_pictures(copy := usual.with_name(f"{usual.name}_{factor}"))
            ]
            text += f"; smaller ones are in {copies[0]}" if copies else ""
            some = "; to train and evaluate with the others, add --missing skip"
            raise InputError(text + ("" if len(gone) == len(listed) else some))
        warn(f"{text}; the other {len(listed) - len(gone):,} are used")
    return files


def called(listed: str, exact: Path | None, file: Path | None, folder: Path) -> str:
    """Return the name of a picture in its scene: the listed name, with the file's extension if the name has none.

    If the listed name and the file's path have different numbers of folders, the path below `folder` is returned.

    exact: the file with the listed name.
    file: the file that was found, None for a missing picture.
    """
    plain = listed if listed.isprintable() else slashed(legible(listed))
    if file is None or file == exact:
        return plain
    inner = file.relative_to(folder).as_posix() if file.is_relative_to(folder) else slashed(plain)
    if inner.count("/") != slashed(plain).count("/"):
        return inner
    return slashed(plain) if PurePosixPath(plain).suffix else f"{slashed(plain)}{file.suffix}"


def by_name(folder: Path, present: Collection[Path], used: Sequence[Path]) -> dict[str, Path]:
    """Return the pictures, keyed by their paths relative to `folder`, without masks, depth maps and downscaled copies.

    present: the pictures in `folder`.
    used: pictures that the data set uses. Their masks and depth maps are recognised by name.
    """
    aside = companions(present, used, folder)
    copies = {path for path in {path.parent for path in present} if is_smaller_copy(path)}
    kept = (path for path in present if path not in aside and not copies.intersection(path.parents))
    return {path.relative_to(folder).as_posix(): path for path in kept if path.is_relative_to(folder)}


def is_smaller_copy(folder: Path) -> bool:
    """Return True for a folder such as images_2 if images/ next to it has pictures."""
    base, _, factor = folder.name.rpartition("_")
    return factor in map(str, FALLBACK_FOLDER_FACTORS) and bool(base) and has_pictures(folder.with_name(base))


def has_pictures(folder: Path) -> bool:
    """Return True if a folder exists and has pictures in it or below it."""
    return os.path.isdir(folder) and bool(find_images(folder))  # noqa: PTH112  # Path.is_dir raises for a long name


def or_smaller(folder: Path) -> Path:
    """Return the folder itself, or its largest downscaled copy (such as images_2) if only copies have pictures."""
    if has_pictures(folder):
        return folder
    copies = (folder.with_name(f"{folder.name}_{factor}") for factor in FALLBACK_FOLDER_FACTORS)
    return next((copy for copy in copies if has_pictures(copy)), folder)
