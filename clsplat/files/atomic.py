# SPDX-License-Identifier: Apache-2.0
"""Files that are written whole or not at all, temporary names, and disks without room."""

from __future__ import annotations

import errno
import hashlib
import os
import re
import secrets
import shutil
import socket
import tempfile
import threading
import time
from collections.abc import Callable, Iterable, Iterator
from contextlib import contextmanager, suppress
from functools import cache
from pathlib import Path
from typing import BinaryIO

from clsplat.errors import InputError, WriteError, amount, reason_of
from clsplat.files.names import ON_WINDOWS

TEMPORARY_SUFFIX = ".clsplat-tmp"
ABANDONED_FILE_SECONDS = 600.0
"""Seconds without a write after which a temporary file from another machine counts as abandoned."""
DISK_FULL_ERRNOS = (errno.ENOSPC, errno.EDQUOT)
DISK_PROBE_BYTES = 1 << 16
"""Number of bytes that are written to find out whether a disk has room."""
WINDOWS_RETRY_SECONDS = 2.0
"""Seconds in which a file on Windows that another program has open is tried again: a virus scanner or an indexer lets
go of a new file within one."""
TEMPORARY_NAME = re.compile(rf"\.(.+)\.([0-9a-f]{{20}}){re.escape(TEMPORARY_SUFFIX)}", re.DOTALL)


@cache
def machine_mark() -> str:
    """Four hexadecimal digits of this machine's name."""
    return hashlib.sha256(socket.gethostname().encode()).hexdigest()[:4]


def temporary_name(target: Path) -> Path:
    """A new name for a file beside `target`. The name has marks of this machine and process."""
    token = f"{machine_mark()}{os.getpid():08x}{secrets.token_hex(4)}"
    return target.with_name(f".{target.name}.{token}{TEMPORARY_SUFFIX}")


def is_abandoned(path: Path, token: str) -> bool:
    """True if the writer that a temporary name's token names has ended, or has not written for ABANDONED_FILE_SECONDS
    seconds."""
    if token[:4] == machine_mark() and os.name == "posix":
        try:
            os.kill(int(token[4:12], 16), 0)
        except (ProcessLookupError, OverflowError):
            return True
        except PermissionError:
            pass
        return False
    return time.time() - path.stat().st_mtime > ABANDONED_FILE_SECONDS


def check_new(path: Path, *, overwrite: bool, sources: Iterable[Path] = ()) -> None:
    """Raise InputError where a file that is named to be written is there already, or is one of those that are read,
    unless it may be replaced; where it is a folder, or has none to be in, in any case."""
    if path.is_dir():
        raise InputError(f"{path}: is a folder, expected the name of a file to write")
    if not path.parent.is_dir():
        raise InputError(f"{path.parent}: no such folder, expected one for {path.name}")
    if overwrite or not (path.exists() or path.is_symlink()):
        return
    if any(source.exists() and path.exists() and source.samefile(path) for source in sources):
        raise InputError(
            f"{path}: is what is read, and would be replaced by what is made of it; name another file, or give "
            "--overwrite to change it in place"
        )
    raise InputError(f"{path}: is there already; name another file, or give --overwrite to replace it")


@contextmanager
def atomic_name(path: str | os.PathLike[str], needs: int | None = None) -> Iterator[Path]:
    """A name for a file that takes the place of `path` when the block ends well, and never exists otherwise.

    It is a temporary one in the same folder (a rename is atomic only within a file system). A link at `path` is
    followed. The folder must exist. needs: bytes that the file will have, for the message of a full disk, where they
    are known. Raises WriteError where the system refuses, with the name `path`; the temporary file is removed on any
    exception, KeyboardInterrupt included.
    """
    target = Path(os.path.realpath(path))
    temporary = temporary_name(target)
    try:
        if target.is_dir():
            raise IsADirectoryError(errno.EISDIR, os.strerror(errno.EISDIR), str(path))
        yield temporary
        replace(temporary, target)
    except BaseException as error:
        written = 0
        with suppress(OSError):
            written = temporary.stat().st_size
            temporary.unlink()  # first, so that the message has what is free without it
        names = (None, str(temporary), str(path))
        if isinstance(error, OSError) and error.errno and not isinstance(error, WriteError) and error.filename in names:
            # A full disk is found by `write`, which does not know the name; and the temporary one is unknown to users.
            raise write_error(path, error, written, needs) from None
        raise


@contextmanager
def atomic_writer(path: str | os.PathLike[str], needs: int | None = None) -> Iterator[BinaryIO]:
    """Open a binary file of an `atomic_name`, which is flushed to the disk before it takes its place."""
    # "x" and no mkstemp: the file gets the permissions that the user's umask gives any new file.
    with atomic_name(path, needs) as temporary, open(temporary, "xb") as file:
        yield file
        file.flush()
        os.fsync(file.fileno())
    _sync_folder(Path(os.path.realpath(path)).parent)


def write_error(path: str | os.PathLike[str], error: OSError, written: int = 0, needs: int | None = None) -> WriteError:
    """The system's error as a plain sentence about the file that was being written; of a full disk with how much the
    file needs, or at least what had been `written` of it, and how much is free."""
    number, reason = error.errno or 0, reason_of(error)
    folder = Path(os.path.realpath(path)).parent
    if number in DISK_FULL_ERRNOS:
        size = f"{amount(needs)} are needed" if needs is not None else f"more than {amount(written)} are needed"
        with suppress(OSError):
            size += f" and {amount(shutil.disk_usage(folder).free)} are free"
        reason += f": {size}; make room, or write to another disk"
    elif number == errno.ENOENT:
        reason = f"no file can be made in {folder}" if folder.is_dir() else f"there is no folder {folder}"
    elif number == errno.EISDIR:
        reason = "it is a folder, expected the name of a file"
    return WriteError(number, reason, str(path))


def room_error(folder: Path) -> OSError | None:
    """The reason that nothing more can be written to a folder, found by trying; for libraries that do not tell."""
    probe = temporary_name(folder / "probe")
    try:
        with open(probe, "xb") as file:
            file.write(os.urandom(DISK_PROBE_BYTES))
            file.flush()
            os.fsync(file.fileno())
    except OSError as error:
        return error
    finally:
        with suppress(OSError):
            probe.unlink()
    return None


_reserved: dict[int, int] = {}
_reserving = threading.Lock()


@contextmanager
def require_room(path: str | os.PathLike[str], needs: int) -> Iterator[None]:
    """Inside, a library may write a file of `needs` bytes at most beside others that do; for those that end the
    process, or say nothing, when the disk is full. Raises WriteError where there is no room."""
    folder = Path(os.path.realpath(path)).parent
    try:
        disk, free = folder.stat().st_dev, shutil.disk_usage(folder).free
    except OSError as error:
        raise write_error(path, error) from None
    with _reserving:
        if needs and free < needs + _reserved.get(disk, 0):
            raise write_error(path, OSError(errno.ENOSPC, os.strerror(errno.ENOSPC)), needs=needs)
        _reserved[disk] = _reserved.get(disk, 0) + needs
    try:
        yield
    finally:
        with _reserving:
            _reserved[disk] -= needs


@contextmanager
def scratch_folder(needs: int) -> Iterator[Path]:
    """A folder for files that a library makes by name, gone afterwards. Raises WriteError where its disk has no room
    for `needs` bytes, and where that runs full, which the library reports as anything but an OSError."""
    # a library may hold its file open for longer, which Windows does not remove
    with tempfile.TemporaryDirectory(prefix="clsplat-", ignore_cleanup_errors=True) as name:
        folder = Path(name)
        try:
            with require_room(folder / "file", needs):
                yield folder
        except WriteError as error:
            if not str(error.filename).startswith(name):
                raise
            raise WriteError(error.errno or 0, f"{error.strerror} (TMPDIR names another folder)", str(folder)) from None
        except (OSError, InputError, KeyboardInterrupt):
            raise
        except Exception:
            if refused := room_error(folder):
                raise write_error(folder, refused) from None
            raise


def atomic_write(path: str | os.PathLike[str], data: bytes) -> None:
    """Write `data` as the whole content of `path`; see `atomic_writer`."""
    with atomic_writer(path, len(data)) as file:
        file.write(data)


def replace(source: Path, target: Path) -> None:
    """Rename a file or a folder, in the place of a file that is there. Raises OSError."""
    _patiently(lambda: source.replace(target))


def remove(path: Path) -> None:
    """Remove a file, if it is there. Raises OSError."""
    _patiently(lambda: path.unlink(missing_ok=True))


def _patiently(act: Callable[[], object], *, windows: bool = ON_WINDOWS) -> None:
    """Do it; again and again for a while where Windows says that another program has the file open."""
    until = time.monotonic() + WINDOWS_RETRY_SECONDS
    while True:
        try:
            act()
        except PermissionError:
            if not windows or time.monotonic() > until:
                raise
            time.sleep(0.02)
        else:
            return


def _sync_folder(folder: Path) -> None:
    """Make a rename last through a power cut, where the file system can (not on Windows, nor on some shares)."""
    with suppress(OSError):
        descriptor = os.open(folder, os.O_RDONLY)
        try:
            os.fsync(descriptor)
        finally:
            os.close(descriptor)
