# SPDX-License-Identifier: Apache-2.0
"""Selection of the frames to render (`--frames`), and names of their files (`-o`)."""

from __future__ import annotations

import re
from collections.abc import Sequence
from glob import escape, glob
from pathlib import Path, PurePosixPath

from clsplat.errors import InputError
from clsplat.files.names import identity, name_trouble

MAX_LISTED_FRAMES = 10_000_000
"""Largest number of frames that one list may name."""
FRAME_RANGE_PATTERN = re.compile(r"(-?\d+)(?:-(-?\d+)(?:[:x](\d+))?)?")
FRAME_FIELD_PATTERN = re.compile(
    r"(?P<digits>#+|@{2,})|%(?P<printed>0\d+)?d|\{(?P<word>\w*)(?::(?P<padded>0\d+)d?)?\}"
    r"|\$F(?P<houdini>\d+)?(?!\w)|<F(?P<angled>\d+)?>",
    re.ASCII,
)
"""Pattern of a field in a file name, such as #### or {name}, that stands for a frame's number or name."""

KNOWN_FRAME_FIELDS = "{name}, {frame}, ####, @@@@, %04d, $F4 or <F4>"
UNKNOWN_FIELD_PATTERN = re.compile(r"%[-+ ]?\d*\.?\d*[diouxXeEfgGcsV]|[{}][^{}]*\}?|\$F\w*|<\w*>")
"""Pattern of text in a file name that looks like a field but does not match FRAME_FIELD_PATTERN."""


def parse_frames(text: str) -> list[int]:
    """Parse a list of frames such as 1-100, 1-100:2, 1-100x2, 10-1 or 7,12,30-40. Return the frame numbers without
    duplicates, in increasing order.

    A step counts from the start of its range and must be at least 1. Negative numbers are allowed: -5--1 is five
    frames. Raises InputError for any other text.
    """
    frames: set[int] = set()
    for word in text.split(","):
        match = FRAME_RANGE_PATTERN.fullmatch(word.strip())
        if match is None:
            raise InputError(
                f"--frames {text}: {word.strip()!r} is not a frame or a range, expected for example 1-100:2 or 7,12"
            )
        first = int(match[1])
        last, step = int(match[2] or first), int(match[3] or 1)
        if step < 1:
            raise InputError(f"--frames {text}: {word.strip()!r} has the step {step}, expected at least 1")
        if abs(last - first) // step + len(frames) >= MAX_LISTED_FRAMES:
            raise InputError(
                f"--frames {text}: lists more than {MAX_LISTED_FRAMES:,} frames; is there a digit too many?"
            )
        frames.update(range(first, last + 1, step) if first <= last else range(first, last - 1, -step))
    return sorted(frames)


def ranges(frames: Sequence[int]) -> str:
    """Write frame numbers in increasing order as text such as 1-3,7. Only the first eight ranges are listed."""
    runs: list[list[int]] = []
    for frame in frames:
        if runs and frame == runs[-1][1] + 1:
            runs[-1][1] = frame
        else:
            runs.append([frame, frame])
    words = [str(first) if first == last else f"{first}-{last}" for first, last in runs]
    return ",".join(words[:8]) + (",..." if len(words) > 8 else "")


def path_of(pattern: str, frame: int, name: str) -> Path:
    """Return the path of a frame's file: `pattern` with the frame's number and name in its fields.

    `####`, `@@@@`, `%04d`, `{frame:04}`, `$F4` and `<F4>` become the frame's number, padded to four digits. `%d`,
    `{frame}`, `$F` and `<F>` become the number without padding. `{name}` becomes the frame's name without extension,
    including its folders. Raises InputError for a name that leads out of the output folder.
    """

    def fill(match: re.Match[str]) -> str:
        if match["word"] == "name":
            return _stem(name)
        width = match["printed"] or match["padded"] or match["houdini"] or match["angled"]
        return f"{frame:0{int(width or len(match['digits'] or ''))}d}"

    # all fields are replaced in one pass, because a name may contain # or %
    return Path(FRAME_FIELD_PATTERN.sub(fill, pattern))


def _stem(name: str) -> str:
    if not PurePosixPath(name).name:
        raise InputError(f"image name {name!r} is empty, expected a name for the file")
    stem = str(PurePosixPath(name).with_suffix(""))
    for text in (name, stem):
        if trouble := name_trouble(text):
            raise InputError(f"image name {name!r} {trouble}, expected the name of a file in the output folder")
    return stem


def has_number(pattern: str) -> bool:
    """Return True if a file pattern has a field for a frame's number."""
    return any(match["word"] in (None, "frame") for match in FRAME_FIELD_PATTERN.finditer(pattern))


def numbered_files(pattern: str) -> dict[int, Path]:
    """Find the files of a pattern such as `model.####.ply`. Return their paths, keyed and sorted by frame number.

    If the pattern has several fields, such as one for a folder and one for the file, they stand for the same number.
    Raises InputError for an unknown field.
    """
    check_pattern(pattern)
    pieces = FRAME_FIELD_PATTERN.sub("\0", pattern).split("\0")
    number = re.compile(r"(-?\d+)".join(map(re.escape, pieces)))
    found = {}
    for text in glob("*".join(map(escape, pieces))):  # noqa: PTH207
        if (match := number.fullmatch(text)) and path_of(pattern, int(match[1]), "") == Path(text):
            found[int(match[1])] = Path(text)
    return dict(sorted(found.items()))


def check_pattern(pattern: str) -> None:
    """Raise InputError for an unknown field in a file pattern."""
    for match in FRAME_FIELD_PATTERN.finditer(pattern):
        if match["word"] not in (None, "frame") and not (match["word"] == "name" and match["padded"] is None):
            raise InputError(f"{pattern}: {match[0]} is not known, expected {KNOWN_FRAME_FIELDS}")
    if odd := UNKNOWN_FIELD_PATTERN.search(FRAME_FIELD_PATTERN.sub("", Path(pattern).name)):
        raise InputError(f"{pattern}: {odd[0]} is not known, expected {KNOWN_FRAME_FIELDS}")


def output_paths(pattern: str, frames: Sequence[tuple[int, str]]) -> list[Path]:
    """Return the path of each frame's file, from a file pattern and the number and name of each frame.

    Raises InputError if two frames share a file, a file would leave the folder, or the pattern is invalid.
    """
    check_pattern(pattern)
    if len(frames) > 1 and not FRAME_FIELD_PATTERN.search(pattern):
        raise InputError(
            f"{pattern}: names a single file for {len(frames)} frames, expected {{name}} or a frame number such as ####"
        )
    paths: list[Path] = []
    taken: dict[str, str] = {}
    for frame, name in frames:
        path = path_of(pattern, frame, name)
        if (key := identity(path)) in taken:
            raise InputError(f"{path}: would be the file of both {taken[key]} and {name}, expected a file for each")
        taken[key] = name
        paths.append(path)
    return paths
