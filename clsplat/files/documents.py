# SPDX-License-Identifier: Apache-2.0
"""Reading of files: existence checks, digests, text and JSON."""

from __future__ import annotations

import hashlib
import json
import os
import stat
from collections.abc import Iterator
from contextlib import contextmanager
from functools import lru_cache
from pathlib import Path
from typing import Any, BinaryIO

from clsplat.errors import InputError, WriteError, reason_of

MAX_DOCUMENT_BYTES = 32 << 20
"""Largest size of a JSON or TOML file in bytes, unless a reader allows more. The parsed file takes up to 32 times as
much memory."""
MAX_PARSED_BYTES = 1 << 30
"""Most memory in bytes that a file of more than MAX_DOCUMENT_BYTES may take, by `parsed_bytes`, unless a reader allows
more."""
_OBJECT_BYTES = {b"[": 72, b"{": 256, b",": 48, b'"': 32}
"""Most bytes of the Python object that a sign of JSON stands for: a list, a dict, a value after a comma, half a string.

A string has two quotes.
"""
MAX_SETTINGS_BYTES = 1 << 20
"""Size limit of a run's config.toml in bytes."""
LFS_POINTER = b"version https://git-lfs.github.com/spec/v1"
"""First bytes of the pointer file that Git LFS leaves in place of a file that was not fetched."""
MAX_LFS_POINTER_BYTES = 1024
"""Largest size in bytes of a pointer file of Git LFS (https://github.com/git-lfs/git-lfs/blob/main/docs/spec.md)."""


def digest(path: str | os.PathLike[str]) -> str:
    """SHA-256 of the file's content, in hexadecimal. Raises OSError."""
    return _digest(path, hashlib.sha256())


def known_digest(path: Path) -> str:
    """SHA-256 of a file's content, cached until its modification time changes. Raises InputError for a missing file."""
    try:
        changed = path.stat().st_mtime_ns
    except OSError as error:
        raise InputError(f"{path}: cannot be read: {reason_of(error)}") from None
    return _digest_at(path, changed)


@lru_cache(maxsize=4096)
def _digest_at(path: Path, changed: int) -> str:  # noqa: ARG001  # a cache key: a changed file is read again
    return digest(path)


def short_digest(path: Path) -> str | None:
    """BLAKE2b digest of the file's content, 16 bytes in hexadecimal; None without a file. Quicker than `digest`."""
    return _digest(path, hashlib.blake2b(digest_size=16)) if is_file(path) else None


def _digest(path: str | os.PathLike[str], state: Any) -> str:
    with open(path, "rb") as file:
        while block := file.read(1 << 20):
            state.update(block)
    digits: str = state.hexdigest()
    return digits


def is_file(path: str | os.PathLike[str]) -> bool:
    """True if `path` is a regular file. False, and no exception, for a name that no file can have."""
    try:
        return stat.S_ISREG(os.stat(path).st_mode)  # noqa: PTH116  # Path(path) takes longer than the call
    except (OSError, ValueError):
        return False


@contextmanager
def open_input(path: Path, expected: str) -> Iterator[BinaryIO]:
    """Context manager that opens a file to read.

    Raises InputError if the file is missing, cannot be read, or is not a regular file: a pipe could block for
    ever. Also raises InputError for the pointer that Git LFS leaves in place of a file that was not fetched.

    expected: text that follows "expected" in error messages.
    """
    try:
        status = path.stat()
        mode = status.st_mode
        if stat.S_ISDIR(mode):
            raise InputError(f"{path}: is a folder, expected {expected}")
        if not stat.S_ISREG(mode):
            raise InputError(f"{path}: is not a regular file, expected {expected}")
        file = open(path, "rb")  # noqa: SIM115  # closed below
    except FileNotFoundError:
        raise InputError(f"{path}: no such file, expected {expected}") from None
    except (OSError, ValueError) as error:  # ValueError is raised for a zero byte in the name
        raise InputError(
            f"{path}: cannot be read ({reason_of(error) if isinstance(error, OSError) else error}), expected {expected}"
        ) from None
    with file:
        try:
            if status.st_size < MAX_LFS_POINTER_BYTES:
                if file.read(len(LFS_POINTER)) == LFS_POINTER:
                    raise InputError(f"{path}: is a Git LFS pointer, not the file itself; run git lfs pull to fetch it")
                file.seek(0)
            yield file
        except WriteError:
            raise
        except OSError as error:
            raise InputError(f"{path}: cannot be read ({reason_of(error)}), expected {expected}") from None


def read_document(
    path: Path, expected: str, limit: int = MAX_DOCUMENT_BYTES, parsed_limit: int = MAX_PARSED_BYTES
) -> str:
    """The text of a UTF-8 file of at most `limit` bytes, without a byte order mark.

    expected: text that follows "expected" in error messages.
    Raises InputError like `open_input`, and for a longer file or another encoding. Also raises it for a file of more
    than MAX_DOCUMENT_BYTES whose JSON would take more than `parsed_limit` bytes of memory.
    """
    with open_input(path, expected) as file:
        size = max(os.fstat(file.fileno()).st_size, MAX_DOCUMENT_BYTES)
        data = file.read(min(limit, size) + 1)
    if len(data) > limit:
        raise InputError(f"{path}: has more than {limit >> 20} MiB, expected {expected}")
    if len(data) > MAX_DOCUMENT_BYTES and (needed := parsed_bytes(data)) > parsed_limit:
        raise InputError(
            f"{path}: its {len(data) >> 20} MiB may take {needed >> 20:,} MiB of memory, expected {expected} that "
            f"takes at most {parsed_limit >> 20:,} MiB; remove values that are not needed"
        )
    try:
        return data.decode("utf-8-sig")
    except UnicodeDecodeError as error:
        raise InputError(f"{path}: is not text in UTF-8 (byte {error.start}), expected {expected}") from None


def parsed_bytes(data: bytes) -> int:
    """Upper estimate of the memory in bytes that a JSON text takes while it is parsed: the text and Python's objects.

    data: the text in UTF-8. Its brackets, commas and quotes are counted, so that nothing is parsed.
    """
    objects = sum(size * data.count(sign) for sign, size in _OBJECT_BYTES.items())
    return objects + len(data) * (2 if data.isascii() else 5)  # the file, and 1 or up to 4 bytes a character of text


def is_settings_of_run(path: Path) -> bool:
    """True if a file is the config.toml of a run, which clsplat wrote."""
    try:
        text = read_document(path, "the settings of a run", MAX_SETTINGS_BYTES)
    except InputError:
        return False
    return any(line.startswith("clsplat = ") for line in text.split("\n"))


def _unique_keys(pairs: list[tuple[str, Any]]) -> dict[str, Any]:
    result = dict(pairs)
    if len(result) < len(pairs):
        names = [name for name, _ in pairs]
        twice = next(name for name in result if names.count(name) > 1)
        raise ValueError(f"the key {twice[:40]!r} occurs twice")
    return result


def parse_json(text: str | bytes, *, once: bool = False) -> Any:
    """The value of a JSON text. Raises ValueError if it does not parse, or is nested too deeply.

    once: also raise ValueError if an object has a key twice. Otherwise the key's last value is used.
    """
    try:
        return json.loads(text, object_pairs_hook=_unique_keys if once else None)
    except RecursionError:
        raise ValueError("it is nested too deeply") from None


def load_document(path: Path, expected: str, key: str, limit: int = MAX_DOCUMENT_BYTES) -> dict[str, Any]:
    """Load the JSON object in a file of at most `limit` bytes.

    expected: the kind of file in words, for the error message.
    key: a key that the object must have, for the error message; the caller checks it.
    Raises InputError if the file cannot be read or has no JSON object.
    """
    try:
        document = parse_json(read_document(path, expected, limit), once=True)
    except ValueError as error:
        raise InputError(f"{path}: is not JSON: {error}; expected {expected}") from None
    if not isinstance(document, dict):
        raise InputError(f"{path}: is not a JSON object, expected one with {key}")
    return document
