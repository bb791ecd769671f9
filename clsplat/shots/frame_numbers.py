# SPDX-License-Identifier: Apache-2.0
"""Choice of the frames that are rendered (`--frames`), and the file of each (`-o`)."""

from __future__ import annotations

import re
from collections.abc import Sequence
from glob import escape, glob
from pathlib import Path, PurePosixPath

from clsplat.errors import InputError
from clsplat.files import identity, name_trouble

MOST_FRAMES = 10_000_000
RANGE = re.compile(r"(-?\d+)(?:-(-?\d+)(?:[:x](\d+))?)?")
FIELD = re.compile(
    r"(?P<digits>#+|@{2,})|%(?P<printed>0\d+)?d|\{(?P<word>\w*)(?::(?P<padded>0\d+)d?)?\}"
    r"|\$F(?P<houdini>\d+)?(?!\w)|<F(?P<angled>\d+)?>",
    re.ASCII,
)
"""A frame's number or name in a file's, as render programs and compositors write it."""

KNOWN = "{name}, {frame}, ####, @@@@, %04d, $F4 or <F4>"
ODD = re.compile(r"%[-+ ]?\d*\.?\d*[diouxXeEfgGcsV]|[{}][^{}]*\}?|\$F\w*|<\w*>")
"""Text that is meant as a field, and is none."""


def parse_frames(text: str) -> list[int]:
    """The frames of a list such as 1-100, 1-100:2, 1-100x2, 10-1 or 7,12,30-40, each once, in rising order.

    A step counts from a range's begin and must be at least 1. Negative numbers are frames like any other: -5--1 is five
    of them. Raises InputError for anything else.
    """
    frames: set[int] = set()
    for word in text.split(","):
        match = RANGE.fullmatch(word.strip())
        if match is None:
            raise InputError(
                f"--frames {text}: {word.strip()!r} is no frame or range, expected such as 1-100:2 or 7,12"
            )
        first = int(match[1])
        last, step = int(match[2] or first), int(match[3] or 1)
        if step < 1:
            raise InputError(f"--frames {text}: {word.strip()!r} has the step {step}, expected at least 1")
        if abs(last - first) // step + len(frames) >= MOST_FRAMES:
            raise InputError(f"--frames {text}: lists more than {MOST_FRAMES:,} frames; is a digit too many in it?")
        frames.update(range(first, last + 1, step) if first <= last else range(first, last - 1, -step))
    return sorted(frames)


def ranges(frames: Sequence[int]) -> str:
    """Rising frames in short, such as 1-3,7; the first ones where there are many gaps."""
    runs: list[list[int]] = []
    for frame in frames:
        if runs and frame == runs[-1][1] + 1:
            runs[-1][1] = frame
        else:
            runs.append([frame, frame])
    words = [str(first) if first == last else f"{first}-{last}" for first, last in runs]
    return ",".join(words[:8]) + (",..." if len(words) > 8 else "")


def path_of(pattern: str, frame: int, name: str) -> Path:
    """The file of a frame. Raises InputError for a name that leads out of the output folder.

    `####`, `@@@@`, `%04d`, `{frame:04}`, `$F4` and `<F4>` are the frame's number in at least four digits, `%d`,
    `{frame}`, `$F` and `<F>` in as few as it has; `{name}` is its name without extension, with its folders.
    """

    def fill(match: re.Match[str]) -> str:
        if match["word"] == "name":
            return _stem(name)
        width = match["printed"] or match["padded"] or match["houdini"] or match["angled"]
        return f"{frame:0{int(width or len(match['digits'] or ''))}d}"

    # one pass: a name may have # or % in it
    return Path(FIELD.sub(fill, pattern))


def _stem(name: str) -> str:
    if not PurePosixPath(name).name:
        raise InputError(f"image name {name!r} is empty, expected a name for the file")
    stem = str(PurePosixPath(name).with_suffix(""))
    for text in (name, stem):
        if trouble := name_trouble(text):
            raise InputError(f"image name {name!r} {trouble}, expected one for a file in the output folder")
    return stem


def has_number(pattern: str) -> bool:
    """True if a path has a field for a frame's number in it."""
    return any(match["word"] in (None, "frame") for match in FIELD.finditer(pattern))


def numbered_files(pattern: str) -> dict[int, Path]:
    """The files that there are of a pattern such as `model.####.ply`, by the frame's number, in rising order. Several
    fields, as of a folder a frame, are of one number. Raises InputError for a field that is not known."""
    check_pattern(pattern)
    pieces = FIELD.sub("\0", pattern).split("\0")
    number = re.compile(r"(-?\d+)".join(map(re.escape, pieces)))
    found = {}
    for text in glob("*".join(map(escape, pieces))):  # noqa: PTH207
        if (match := number.fullmatch(text)) and path_of(pattern, int(match[1]), "") == Path(text):
            found[int(match[1])] = Path(text)
    return dict(sorted(found.items()))


def check_pattern(pattern: str) -> None:
    """Raise InputError for a field in the names of files that is not known."""
    for match in FIELD.finditer(pattern):
        if match["word"] not in (None, "frame") and not (match["word"] == "name" and match["padded"] is None):
            raise InputError(f"{pattern}: {match[0]} is not known, expected {KNOWN}")
    if odd := ODD.search(FIELD.sub("", Path(pattern).name)):
        raise InputError(f"{pattern}: {odd[0]} is not known, expected {KNOWN}")


def output_paths(pattern: str, frames: Sequence[tuple[int, str]]) -> list[Path]:
    """The file of every frame (number, name). Raises InputError where two would be one, or one would leave the
    folder, or the pattern is none."""
    check_pattern(pattern)
    if len(frames) > 1 and not FIELD.search(pattern):
        raise InputError(
            f"{pattern}: has no {{name}} in it, expected one to tell {len(frames)} cameras apart, or a frame number "
            "such as ####"
        )
    paths: list[Path] = []
    taken: dict[str, str] = {}
    for frame, name in frames:
        path = path_of(pattern, frame, name)
        if (key := identity(path)) in taken:
            raise InputError(f"{path}: would be both {taken[key]} and {name}")
        taken[key] = name
        paths.append(path)
    return paths
