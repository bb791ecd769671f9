# SPDX-License-Identifier: Apache-2.0
"""Checks of file names: names that an operating system refuses, and names that it treats as the same file."""

from __future__ import annotations

import os
import re
import sys
import unicodedata
from pathlib import PurePath, PurePosixPath, PureWindowsPath

from clsplat.errors import InputError

ON_WINDOWS = os.name == "nt"
CASE_INSENSITIVE_FILES = sys.platform in ("win32", "darwin")
"""True if the system's usual file systems treat A.png and a.png as one file, and two Unicode forms of an accent."""
_FORBIDDEN_NAME_CHARACTERS = re.compile(r'[<>:"|?*\x00-\x1f]')
_WINDOWS_DEVICE_NAME = re.compile(
    r"(con|prn|aux|nul|conin\$|conout\$|(com|lpt)[0-9¹²³]) *(\..*)?", re.IGNORECASE | re.DOTALL
)


def name_trouble(name: str, *, windows: bool = ON_WINDOWS) -> str | None:
    """Reason why a file below a folder cannot have this name, as the end of a sentence; None if it can.

    name: path relative to the folder, with forward slashes. windows: apply the rules of Windows.
    """
    pure: PurePath = PureWindowsPath(name) if windows else PurePosixPath(name)
    if pure.anchor or ".." in pure.parts:
        return "leads out of the output folder"
    if not pure.name or "\0" in name:
        return "is not a file name"
    if windows:
        for part in pure.parts:
            if character := _FORBIDDEN_NAME_CHARACTERS.search(part):
                return f"has {character[0]!r} in it, which no file name on Windows may have"
            if _WINDOWS_DEVICE_NAME.fullmatch(part):
                return f"is a name that Windows reserves for a device ({part})"
            if part[-1] in ". ":
                return f"has {part!r} in it, which ends with a dot or a space; Windows drops that"
    return None


def native_name(path: str | os.PathLike[str]) -> str:
    """A path as text, for a library that expects UTF-8 in any locale. Raises InputError if the path is not UTF-8."""
    try:
        return os.fsencode(path).decode("utf-8")
    except UnicodeError:
        raise InputError(f"{path}: has a name that is not UTF-8 text; rename it") from None


def identity(path: PurePath, *, ignores_case: bool = CASE_INSENSITIVE_FILES) -> str:
    """A key that is equal for two paths if the system treats them as the same file. Links are not followed."""
    text = str(path)
    return unicodedata.normalize("NFC", text).casefold() if ignores_case else text
