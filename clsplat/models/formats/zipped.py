# SPDX-License-Identifier: Apache-2.0
"""A .zip that holds one model, as a download does: which of its files that is, and unpacking it.

https://pkware.cachefly.net/webdocs/casestudies/APPNOTE.TXT has the format. What Finder and Explorer add (__MACOSX,
hidden files) does not count; of several files with a model's name those whose beginning says that they have no
Gaussians do not. A model of several files has them in one folder of the archive, which is unpacked with it.
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
from clsplat.files import open_input, scratch_folder, write_error
from clsplat.gaussians import Gaussians

MAX_MEMBERS = 100_000
FREE_BYTES = 64 << 20
MOST_RATIO = 100
"""Bytes that are unpacked at most: these, or so many for each byte of the archive. A PLY all of whose spherical
harmonics are 0 has some 5; deflate's own limit, and a bomb, 1032."""
FILE = b"PK\x03\x04"
"""The first bytes of an archive that has a file."""
ADDED = "__MACOSX"
HEAD_BYTES = 16 << 20
"""Of a file that tell whether it has Gaussians: a whole JSON, and the header of any PLY."""
ENCRYPTED = 1
"""Of the flags of a file."""


def recognises(head: bytes) -> bool:
    """True if a file begins as an archive."""
    return head.startswith((FILE, b"PK\x05\x06"))  # the second of one without files


@dataclass(frozen=True)
class Inside:
    """The row of the table of formats that is the model's in an archive. is_model_name: True for the name of one;
    has_gaussians: False for a file of that name whose first bytes have none of what says so; resolve: the model's file
    and its row, a `Format`."""

    is_model_name: Callable[[Path], bool]
    has_gaussians: Callable[[Path, bytes], bool]
    resolve: Callable[[Path], tuple[Path, Any]]

    @contextmanager
    def model(self, path: Path) -> Iterator[tuple[Path, Any]]:
        """The model's file, which is there for as long, and its row. Raises InputError as `unpacked`."""
        with unpacked(path, self) as model:
            yield self.resolve(model)

    def read(self, path: Path) -> Gaussians:
        """Read the model. Raises InputError as `unpacked`, and as the model's own format."""
        with self.model(path) as (file, row):
            gaussians: Gaussians = row.read(file)
        return gaussians

    def describe(self, path: Path) -> dict[str, Any]:
        """The model's part of `clsplat info`, with its format and what that loses."""
        with self.model(path) as (file, row):
            return {"format": f"{row.name} in a .zip", "loses": row.loses, **row.describe(file)}

    def space(self, path: Path) -> str:
        """The space of the model's colours."""
        with self.model(path) as (file, row):
            space: str = row.space(file)
        return space

    def names(self, path: Path) -> list[str]:
        """The names of the files that may be its model; none where there are none, or the archive is damaged."""
        try:
            with _opened(path) as archive:
                return [_parts(member)[-1] for member in _models_in(archive, self)]
        except InputError:
            return []


@contextmanager
def unpacked(path: Path, inside: Inside) -> Iterator[Path]:
    """The model in the archive, as a file that is there for as long; warnings and errors that name that file name the
    archive and its file in it. Raises InputError: no archive, damaged, encrypted, too large unpacked, no model or
    several."""
    with ExitStack() as stack:
        with _opened(path) as archive:
            model = _model_in(path, archive, inside)
            folder = _parts(model)[:-1]
            beside = [member for member in archive.infolist() if _parts(member)[:-1] == folder]
            total, limit = sum(member.file_size for member in beside), max(FREE_BYTES, MOST_RATIO * path.stat().st_size)
            if total > limit:
                raise InputError(f"{path}: has {total:,} bytes unpacked, expected at most {limit:,}; unpack it first")
            scratch = stack.enter_context(scratch_folder(total))
            for member in beside:
                _unpack(archive, member, scratch)
        yield from _renamed(scratch / _parts(model)[-1], f"{path}: {plain(model.filename)[:80]}")


@contextmanager
def _opened(path: Path) -> Iterator[zipfile.ZipFile]:
    """The archive. Raises InputError for one that is damaged or encrypted, here and where it is read."""
    with open_input(path, "a .zip archive") as file:
        try:
            with zipfile.ZipFile(file) as archive:
                if len(archive.infolist()) > MAX_MEMBERS:
                    raise InputError(f"{path}: has more than {MAX_MEMBERS:,} files, expected one model")
                yield archive
        except (zipfile.BadZipFile, zlib.error, lzma.LZMAError, EOFError, ValueError, RuntimeError) as error:
            raise InputError(f"{path}: does not unpack ({plain(str(error))[:120]}); is it damaged?") from None


def _parts(member: zipfile.ZipInfo) -> tuple[str, ...]:
    """The folders and the name of a file in an archive."""
    return PurePosixPath(member.filename.replace("\\", "/")).parts


def _models_in(archive: zipfile.ZipFile, inside: Inside) -> list[zipfile.ZipInfo]:
    """The files with a model's name; of several those that have Gaussians by their beginning, if any do."""
    models = []
    for member in archive.infolist():
        parts = _parts(member)
        added = any(part.startswith(".") or part == ADDED for part in parts)
        if parts and not (added or member.is_dir()) and inside.is_model_name(Path(parts[-1])):
            models.append(member)
    if len(models) < 2:
        return models
    return [member for member in models if _has_gaussians(archive, member, inside)] or models


def _has_gaussians(archive: zipfile.ZipFile, member: zipfile.ZipInfo, inside: Inside) -> bool:
    if member.flag_bits & ENCRYPTED:
        return True
    with archive.open(member) as file:
        return inside.has_gaussians(Path(_parts(member)[-1]), file.read(HEAD_BYTES))


def _model_in(path: Path, archive: zipfile.ZipFile, inside: Inside) -> zipfile.ZipInfo:
    """The only model. Raises InputError for none, for several, which it names, and for one that is encrypted."""
    models = _models_in(archive, inside)
    if len(models) != 1:
        names = f" ({examples(member.filename[:80] for member in models)})" if models else ""
        raise InputError(f"{path}: holds {len(models)} model files{names}, expected one; unpack it first")
    if models[0].flag_bits & ENCRYPTED:
        raise InputError(f"{path}: is encrypted, expected a .zip without a password; unpack it first")
    return models[0]


def _unpack(archive: zipfile.ZipFile, member: zipfile.ZipInfo, folder: Path) -> None:
    if member.is_dir() or member.flag_bits & ENCRYPTED:
        return
    target = folder / _parts(member)[-1]
    with archive.open(member) as source, target.open("wb") as file:
        while block := source.read(1 << 20):  # no more than the archive says that the file has
            try:
                file.write(block)
                file.flush()  # here and not at the end, where it would seem that reading failed
            except OSError as error:
                raise write_error(target, error) from None


def _renamed(model: Path, name: str) -> Iterator[Path]:
    """Give the model; in warnings and InputErrors of what is done with it, `name` stands for it."""
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
