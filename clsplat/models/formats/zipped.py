# SPDX-License-Identifier: Apache-2.0
"""A .zip archive that contains one model: search for the model among the files, and unpacking.

Format: https://pkware.cachefly.net/webdocs/casestudies/APPNOTE.TXT. Files added by Finder and Explorer (__MACOSX,
hidden files) are ignored. If several files have a model's suffix, those whose first bytes show no Gaussians are ignored
too. All files in the model's folder of the archive are unpacked, since a model may have several.
"""

from __future__ import annotations

import lzma
import warnings
import zipfile
import zlib
from collections.abc import Callable, Iterator
from contextlib import ExitStack, contextmanager
from dataclasses import dataclass
from pathlib import Path, PurePosixPath
from typing import Any

from clsplat.errors import InputError, examples, plain, warn
from clsplat.files.atomic import scratch_folder, write_error
from clsplat.files.documents import open_input
from clsplat.gaussians import Gaussians

MAX_ARCHIVE_FILES = 100_000
MAX_UNCHECKED_UNPACKED_BYTES = 64 << 20
MAX_UNPACK_RATIO = 100
"""Largest ratio of unpacked to packed bytes of an archive. Up to MAX_UNCHECKED_UNPACKED_BYTES, any ratio is allowed.

The ratio of a PLY whose spherical harmonics are all 0 is about 5. A decompression bomb reaches deflate's limit, 1032.
"""
ZIP_FILE_MAGIC = b"PK\x03\x04"
"""First bytes of an archive that is not empty."""
MACOS_METADATA_FOLDER = "__MACOSX"
ZIP_MEMBER_HEAD_BYTES = 16 << 20
"""Number of bytes at the beginning of a file that are searched for signs of Gaussians: all of a JSON or PLY header."""
ENCRYPTED_FLAG = 1
"""Bit that is set in the flags of an encrypted file."""


def recognises(head: bytes) -> bool:
    """True if a file begins like a zip archive."""
    return head.startswith((ZIP_FILE_MAGIC, b"PK\x05\x06"))  # an archive without files begins with the second signature


@dataclass(frozen=True)
class ZipReader:
    """Reads the model in a zip archive. The three functions are passed in, since their module imports this one.

    is_model_name(path): True if a path has the suffix of a model file.
    has_gaussians(path, head): True if `head`, the first bytes of a file with such a suffix, shows Gaussians.
    resolve(path): the model's file and its `Format`.
    """

    is_model_name: Callable[[Path], bool]
    has_gaussians: Callable[[Path, bytes], bool]
    resolve: Callable[[Path], tuple[Path, Any]]

    @contextmanager
    def model(self, path: Path) -> Iterator[tuple[Path, Any]]:
        """Context manager that yields the unpacked model's file and its `Format`. Raises InputError like `unpacked`."""
        with unpacked(path, self) as model:
            yield self.resolve(model)

    def read(self, path: Path) -> Gaussians:
        """Read the model. Raises InputError like `unpacked` and the format's `read`."""
        with self.model(path) as (file, row):
            gaussians: Gaussians = row.read(file)
        return gaussians

    def describe(self, path: Path) -> dict[str, Any]:
        """Details of the model for `clsplat info`, including its format and what the format loses."""
        with self.model(path) as (file, row):
            return {"format": f"{row.name} in a .zip", "loses": row.loses, **row.describe(file)}

    def space(self, path: Path) -> str:
        """Colour space of the model."""
        with self.model(path) as (file, row):
            space: str = row.space(file)
        return space

    def names(self, path: Path) -> list[str]:
        """Names of the files that may be the model; empty for a damaged archive."""
        try:
            with _opened(path) as archive:
                return [_parts(member)[-1] for member in _possible_models(archive, self)]
        except InputError:
            return []


@contextmanager
def unpacked(path: Path, reader: ZipReader) -> Iterator[Path]:
    """Context manager that unpacks the model to a temporary file and yields the file's path.

    Warnings and errors about the temporary file name the archive instead. Raises InputError if the archive is damaged,
    encrypted, too large unpacked, or does not contain exactly one model.
    """
    with ExitStack() as stack:
        with _opened(path) as archive:
            model = _only_model(path, archive, reader)
            folder = _parts(model)[:-1]
            beside = [member for member in archive.infolist() if _parts(member)[:-1] == folder]
            total, limit = (
                sum(member.file_size for member in beside),
                max(MAX_UNCHECKED_UNPACKED_BYTES, MAX_UNPACK_RATIO * path.stat().st_size),
            )
            if total > limit:
                raise InputError(f"{path}: has {total:,} bytes unpacked, expected at most {limit:,}; unpack it first")
            scratch = stack.enter_context(scratch_folder(total))
            for member in beside:
                _unpack(archive, member, scratch)
        yield from _renamed(scratch / _parts(model)[-1], f"{path}: {plain(model.filename)[:80]}")


@contextmanager
def _opened(path: Path) -> Iterator[zipfile.ZipFile]:
    """Context manager that opens an archive.

    Raises InputError if the archive is damaged or encrypted, on opening or when the caller reads from it.
    """
    with open_input(path, "a .zip archive") as file:
        try:
            with zipfile.ZipFile(file) as archive:
                if len(archive.infolist()) > MAX_ARCHIVE_FILES:
                    raise InputError(f"{path}: has more than {MAX_ARCHIVE_FILES:,} files, expected one model")
                yield archive
        except (zipfile.BadZipFile, zlib.error, lzma.LZMAError, EOFError, ValueError, RuntimeError) as error:
            raise InputError(f"{path}: does not unpack ({plain(str(error))[:120]}); is it damaged?") from None


def _parts(member: zipfile.ZipInfo) -> tuple[str, ...]:
    """Split the path of a file in an archive into its folders and its name."""
    return PurePosixPath(member.filename.replace("\\", "/")).parts


def _possible_models(archive: zipfile.ZipFile, reader: ZipReader) -> list[zipfile.ZipInfo]:
    """Return the files that may be the model: all files with the suffix of a model format.

    If there are several, files whose first bytes show no Gaussians are left out, unless no file shows any.
    """
    models = []
    for member in archive.infolist():
        parts = _parts(member)
        added = any(part.startswith(".") or part == MACOS_METADATA_FOLDER for part in parts)
        if parts and not (added or member.is_dir()) and reader.is_model_name(Path(parts[-1])):
            models.append(member)
    if len(models) < 2:
        return models
    return [member for member in models if _has_gaussians(archive, member, reader)] or models


def _has_gaussians(archive: zipfile.ZipFile, member: zipfile.ZipInfo, reader: ZipReader) -> bool:
    if member.flag_bits & ENCRYPTED_FLAG:
        return True
    with archive.open(member) as file:
        return reader.has_gaussians(Path(_parts(member)[-1]), file.read(ZIP_MEMBER_HEAD_BYTES))


def _only_model(path: Path, archive: zipfile.ZipFile, reader: ZipReader) -> zipfile.ZipInfo:
    """The only model in an archive. Raises InputError for no model, several models, or an encrypted model."""
    models = _possible_models(archive, reader)
    if len(models) != 1:
        names = f" ({examples(member.filename[:80] for member in models)})" if models else ""
        raise InputError(f"{path}: contains {len(models)} model files{names}, expected one; unpack it first")
    if models[0].flag_bits & ENCRYPTED_FLAG:
        raise InputError(f"{path}: is encrypted, expected a .zip without a password; unpack it first")
    return models[0]


def _unpack(archive: zipfile.ZipFile, member: zipfile.ZipInfo, folder: Path) -> None:
    if member.is_dir() or member.flag_bits & ENCRYPTED_FLAG:
        return
    target = folder / _parts(member)[-1]
    with archive.open(member) as source, target.open("wb") as file:
        while block := source.read(1 << 20):  # zipfile stops at the size that the archive states
            try:
                file.write(block)
                file.flush()  # a full disk raises its error here, and not in close
            except OSError as error:
                raise write_error(target, error) from None


def _renamed(model: Path, name: str) -> Iterator[Path]:
    """Yield a model's path, and replace it by `name` in the warnings and InputErrors of the code that uses it."""
    with warnings.catch_warnings(record=True) as caught:
        warnings.simplefilter("always", UserWarning)
        try:
            yield model
            trouble = None
        except InputError as error:
            trouble = InputError(str(error).replace(str(model), name))
    for warning in caught:
        if warning.category is UserWarning:
            warn(str(warning.message).replace(str(model), name))
        else:
            warnings.warn_explicit(warning.message, warning.category, warning.filename, warning.lineno)
    if trouble:
        raise trouble
