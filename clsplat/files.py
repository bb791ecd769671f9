# SPDX-License-Identifier: Apache-2.0
"""Writing files so that a crash, Ctrl-C or a full disk leaves the previous file whole."""

from __future__ import annotations

import hashlib
import os
import re
import secrets
from collections.abc import Iterable, Iterator
from contextlib import contextmanager, suppress
from pathlib import Path
from typing import BinaryIO

TEMPORARY_SUFFIX = ".clsplat-tmp"
_TEMPORARY = re.compile(rf"\.(.+)\.[0-9a-f]{{12}}{re.escape(TEMPORARY_SUFFIX)}", re.DOTALL)


@contextmanager
def atomic_writer(path: str | os.PathLike[str]) -> Iterator[BinaryIO]:
    """Open a binary file that takes the place of `path` when the block ends well, and never exists otherwise.

    The data goes to a temporary name in the same folder (a rename is atomic only within a file system), is flushed
    to the disk and renamed. A link at `path` is followed. The folder must exist. Raises OSError as `open` and
    `write` do, with the name `path`; the temporary file is removed on any exception, KeyboardInterrupt included.
    """
    target = Path(os.path.realpath(path))
    temporary = target.with_name(f".{target.name}.{secrets.token_hex(6)}{TEMPORARY_SUFFIX}")
    try:
        # "x" and no mkstemp: the file gets the permissions that the user's umask gives any new file.
        with open(temporary, "xb") as file:
            yield file
            file.flush()
            os.fsync(file.fileno())
        temporary.replace(target)
    except BaseException as error:
        with suppress(OSError):
            temporary.unlink()
        if isinstance(error, OSError) and error.errno and error.filename in (None, str(temporary)):
            # A full disk is found by `write`, which does not know the name; and nobody knows the temporary one.
            raise OSError(error.errno, error.strerror, str(path)) from None
        raise
    _sync_folder(target.parent)


def atomic_write(path: str | os.PathLike[str], data: bytes) -> None:
    """Write `data` as the whole content of `path`; see `atomic_writer`."""
    with atomic_writer(path) as file:
        file.write(data)


def temporaries(targets: Iterable[Path]) -> list[Path]:
    """The temporary files that writers of these files have left, or are writing still."""
    names: dict[Path, set[str]] = {}
    for target in targets:
        real = Path(os.path.realpath(target))
        names.setdefault(real.parent, set()).add(real.name)
    found = []
    for folder, wanted in names.items():
        with suppress(OSError):
            for entry in os.scandir(folder):
                match = _TEMPORARY.fullmatch(entry.name)
                if match and match[1] in wanted:
                    found.append(Path(entry.path))
    return sorted(found)


def digest(path: str | os.PathLike[str]) -> str:
    """SHA-256 of the file's content, in hexadecimal. Raises OSError."""
    found = hashlib.sha256()
    with open(path, "rb") as file:
        while block := file.read(1 << 20):
            found.update(block)
    return found.hexdigest()


def _sync_folder(folder: Path) -> None:
    """Make a rename last through a power cut, where the file system can (not on Windows, nor on some shares)."""
    with suppress(OSError):
        descriptor = os.open(folder, os.O_RDONLY)
        try:
            os.fsync(descriptor)
        finally:
            os.close(descriptor)
