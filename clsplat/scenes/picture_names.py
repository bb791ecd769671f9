# SPDX-License-Identifier: Apache-2.0
"""Pictures by the names under which other programs list them.

A listed name and a file's may differ in the kind of slashes, in Unicode form (macOS decomposes accents), in encoding
(COLMAP on Windows writes the system's code page), in case (RealityScan), in the extension (Metashape lists labels, and
photographs are converted), and in the folders before them. docs/conventions.md (Names of pictures) has the steps.
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
from clsplat.images.reading import EXTENSIONS

RAW = (
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
"""Extensions of photographs before they were converted."""
ENCODINGS = ("utf-8", "gb18030", "cp932", "cp949", "big5", "cp1252", "cp1250", "cp1251", "cp1253", "cp1254", "cp1255",
             "cp1256", "cp437", "cp850", "cp866", "mac_roman", "latin-1")  # fmt: skip
"""Encodings of names, in the order in which they are tried."""
DRIVE = re.compile(r"\A[A-Za-z]:(?=/)")
FOLDER = "folder"
"""Beginning of the names of the steps that pass over folders."""
Key = Callable[[str], str]


@dataclass(frozen=True)
class Found:
    """names: the names that are there, by the listed ones; how: by what some differ, of each step with the first."""

    names: dict[str, str]
    how: list[str] = field(default_factory=list)


def match(listed: Sequence[str], present: Iterable[str], settled: Iterable[str] = ()) -> Found:
    """The present name for each listed one, both with folders, as far as it is unambiguous.

    Each step is looser than the one before it and takes what is left: a listed name finds a present one where neither
    looks like another that is left. Another folder counts for all pictures of a listed folder or for none: where one of
    them is found in place, or a name of `settled` is, the others are missing. Names with surrogates (`os.fsdecode`) are
    bytes of an encoding that is not known.
    """
    there = dict.fromkeys(present)
    found = {name: name for name in listed if name in there}
    how = []
    for label, key in _steps([*listed, *there]):
        open_names = [name for name in dict.fromkeys(listed) if name not in found]
        if label.startswith(FOLDER):
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
    """The present names that a listed one looks most like, for the line of an error; empty where none does."""
    by_base: dict[str, str] = {}
    for other in present:
        by_base.setdefault(PurePosixPath(other).name.casefold(), other)
    close = get_close_matches(PurePosixPath(slashed(name)).name.casefold(), by_base, 3, 0.7)
    return examples(legible(by_base[base]) for base in close)


def slashed(name: str) -> str:
    """The name with forward slashes and without a drive, composed (NFC), without "." parts."""
    text = DRIVE.sub("", unicodedata.normalize("NFC", name).replace("\\", "/"))
    return "/".join(part for part in text.split("/") if part not in ("", "."))


def legible(name: str) -> str:
    """The name as text: bytes of an unknown encoding as one in which they are printable."""
    return next((text for text in _decoded(name) if text.isprintable()), ascii(name))


def is_legible(name: str) -> bool:
    """True if a name is printable, in UTF-8 or an encoding of ENCODINGS."""
    return any(text.isprintable() for text in _decoded(name))


def _is_raw(name: str) -> bool:
    """True if a name has bytes of an encoding that is not known."""
    return not name.isascii() and any("\udc80" <= char <= "\udcff" for char in name)


def _decoded(name: str) -> Iterator[str]:
    """The name; where it has bytes of an unknown encoding what they are in each that has them."""
    if not _is_raw(name):
        yield name
        return
    raw = name.encode("utf-8", "surrogateescape")
    for encoding in ENCODINGS:
        try:
            yield raw.decode(encoding)
        except UnicodeDecodeError:
            continue


def _steps(names: Iterable[str]) -> Iterator[tuple[str, Key]]:
    """The steps: the difference that each passes over, for people, and its key. Names of one key are alike; an empty
    key is like no other."""
    yield "slashes or Unicode form", slashed
    for encoding in ENCODINGS[1:]:
        yield f"encoding ({encoding})", partial(_in, encoding)
    yield "case", _lower
    yield "extension", _without_extension
    deepest = max((slashed(name).count("/") for name in names), default=0)
    for count in range(deepest, 0, -1):  # the longest ending that fits comes first
        yield FOLDER, partial(_ending, count, _lower)
        yield f"{FOLDER} and extension", partial(_ending, count, _without_extension)


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
    return next((text.removesuffix(end) for end in (*EXTENSIONS, *RAW) if text.endswith(end)), text)


def _ending(count: int, key: Key, name: str) -> str:
    """The last parts of a path, as many as the count; all of one that has no more."""
    return "/".join(key(name).split("/")[-count:])
