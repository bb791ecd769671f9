# SPDX-License-Identifier: Apache-2.0
"""Matching of picture names in data sets to files with similar names.

A listed name and a file's name may differ in slashes, Unicode form (macOS decomposes accents), or encoding (COLMAP on
Windows writes the system's code page). They may also differ in case (RealityScan), in the extension (Metashape lists
labels, and photographs are converted), and in leading folders. docs/conventions.md (Names of pictures) lists the steps.
"""

from __future__ import annotations

import re
import unicodedata
from collections import Counter
from collections.abc import Callable, Iterable, Iterator, Sequence
from dataclasses import dataclass, field
from difflib import get_close_matches
from functools import partial
from pathlib import PurePosixPath

from clsplat.errors import examples
from clsplat.images.reading import IMAGE_SUFFIXES

SOURCE_EXTENSIONS = (
    ".heic",
    ".heif",
    ".avif",
    ".jxl",
    ".jp2",
    ".gif",
    ".dng",
    ".cr2",
    ".cr3",
    ".nef",
    ".arw",
    ".raf",
    ".rw2",
    ".orf",
)
"""Extensions of photographs that users convert before training. A data set may list photographs with the old extension.
"""
NAME_ENCODINGS = ("utf-8", "gb18030", "cp932", "cp949", "big5", "cp1252", "cp1250", "cp1251", "cp1253", "cp1254",
                  "cp1255", "cp1256", "cp437", "cp850", "cp866", "mac_roman", "latin-1")  # fmt: skip
"""Encodings of names, in the order in which they are tried."""
DRIVE_PREFIX = re.compile(r"\A[A-Za-z]:(?=/)")
"""A drive at the beginning of a path, such as "C:"."""
FOLDER_STEP_LABEL = "folder"
"""Prefix of the labels of the matching steps that ignore folders."""
Key = Callable[[str], str]
"""Function that reduces a name to a key. Names with equal keys match."""


@dataclass(frozen=True)
class Found:
    """Result of `match`.

    names: the matching present name for each listed name.
    how: for each matching step that found names, a text with the ignored difference and a first example.
    """

    names: dict[str, str]
    how: list[str] = field(default_factory=list)


def match(listed: Sequence[str], present: Iterable[str], settled: Iterable[str] = ()) -> Found:
    """Match listed names to names of present files, both with folders, where the match is unambiguous.

    Matching has several steps. Each handles the names that remain, and ignores larger differences than the step before.
    In a step, a listed name matches a present one if each is the only match of the other.

    Pictures of a listed folder are searched in other folders only if none of them is found in the listed folder, and no
    name of `settled` is in it. Surrogates in names (`os.fsdecode`) stand for bytes of an unknown encoding.

    settled: listed names whose files are known already.
    """
    there = dict.fromkeys(present)
    found = {name: name for name in listed if name in there}
    how = []
    for label, key in _steps([*listed, *there]):
        open_names = [name for name in dict.fromkeys(listed) if name not in found]
        if label.startswith(FOLDER_STEP_LABEL):
            in_place = {_folder_of(name) for name, at in found.items() if _folder_of(name) == _folder_of(at)}
            in_place |= {_folder_of(name) for name in settled}
            open_names = [name for name in open_names if _folder_of(name) not in in_place]
        if not open_names:
            break
        taken = set(found.values())
        by_key: dict[str, list[str]] = {}
        for name in there:
            if name not in taken and (its := key(name)):
                by_key.setdefault(its, []).append(name)
        wanted = Counter(key(name) for name in open_names)
        new = {}
        for name in open_names:
            its = key(name)
            if its and wanted[its] == 1 and len(by_key.get(its, ())) == 1:
                new[name] = by_key[its][0]
        if new:
            found |= new
            first = next(iter(new))
            shown = new[first] if _is_raw(first) else f"{first} is {new[first]}"
            how.append(f"{len(new):,} by {label} ({legible(shown)})")
    return Found(found, how)


def nearest(name: str, present: Iterable[str]) -> str:
    """Return the present names that most resemble a listed one, for an error message; "" if none does."""
    by_base: dict[str, str] = {}
    for other in present:
        by_base.setdefault(PurePosixPath(other).name.casefold(), other)
    close = get_close_matches(PurePosixPath(slashed(name)).name.casefold(), by_base, 3, 0.7)
    return examples(legible(by_base[base]) for base in close)


def slashed(name: str) -> str:
    """Return a name with forward slashes, in Unicode form NFC, without a drive and without "." parts."""
    text = DRIVE_PREFIX.sub("", unicodedata.normalize("NFC", name).replace("\\", "/"))
    return "/".join(part for part in text.split("/") if part not in ("", "."))


def legible(name: str) -> str:
    """Return a name as printable text. If its encoding is unknown, the first encoding that gives such text is used."""
    return next((text for text in _decoded(name) if text.isprintable()), ascii(name))


def is_legible(name: str) -> bool:
    """Return True if a name is printable, in UTF-8 or an encoding of NAME_ENCODINGS."""
    return any(text.isprintable() for text in _decoded(name))


def _is_raw(name: str) -> bool:
    """Return True if a name has bytes of an unknown encoding."""
    return not name.isascii() and any("\udc80" <= char <= "\udcff" for char in name)


def _decoded(name: str) -> Iterator[str]:
    """Yield the name, or each possible decoding if it has bytes of an unknown encoding."""
    if not _is_raw(name):
        yield name
        return
    raw = name.encode("utf-8", "surrogateescape")
    for encoding in NAME_ENCODINGS:
        try:
            yield raw.decode(encoding)
        except UnicodeDecodeError:
            continue


def _steps(names: Iterable[str]) -> Iterator[tuple[str, Key]]:
    """Yield the steps of `match`: a label for the ignored difference, and the function that reduces names to keys.

    Names with equal keys match. An empty key matches no name.
    """
    yield "slashes or Unicode form", slashed
    for encoding in NAME_ENCODINGS[1:]:
        yield f"encoding ({encoding})", partial(_in, encoding)
    yield "case", _lower
    yield "extension", _without_extension
    deepest = max((slashed(name).count("/") for name in names), default=0)
    for count in range(deepest, 0, -1):  # the last `count` folders and the name
        yield FOLDER_STEP_LABEL, partial(_ending, count, _lower)
        yield f"{FOLDER_STEP_LABEL} and extension", partial(_ending, count, _without_extension)


def _lower(name: str) -> str:
    return slashed(name).casefold()


def _in(encoding: str, name: str) -> str:
    if not _is_raw(name):
        return slashed(name)
    try:
        return slashed(name.encode("utf-8", "surrogateescape").decode(encoding))
    except UnicodeDecodeError:
        return ""


def _folder_of(name: str) -> str:
    return _lower(name).rpartition("/")[0]


def _without_extension(name: str) -> str:
    text = _lower(name)
    return next((text.removesuffix(end) for end in (*IMAGE_SUFFIXES, *SOURCE_EXTENSIONS) if text.endswith(end)), text)


def _ending(count: int, key: Key, name: str) -> str:
    """Return the last `count` parts of a path's key, or all parts if there are fewer."""
    return "/".join(key(name).split("/")[-count:])
