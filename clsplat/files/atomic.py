# SPDX-License-Identifier: Apache-2.0
"""Atomic writes of files and folders by temporary ones and renames, checks of disk space, errors about full disks."""

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
"""Seconds without a write after which another machine's temporary file, or claim of a file, counts as abandoned."""
DISK_FULL_ERRNOS = (errno.ENOSPC, errno.EDQUOT)
DISK_PROBE_BYTES = 1 << 16
"""Size in bytes of the file that tests whether a disk has room."""
WINDOWS_RETRY_SECONDS = 2.0
"""Seconds during which an operation is repeated on Windows while another program has the file open. A virus scanner or
an indexer closes a new file within one second."""
TEMPORARY_NAME = re.compile(rf"\.(.+)\.([0-9a-f]{{20}}){re.escape(TEMPORARY_SUFFIX)}", re.DOTALL)
"""Pattern of the names that `temporary_name` makes. Its groups: the target's name, and the token for `is_abandoned`."""

_BOOT_ID_FILE, _PID_NAMESPACE_FILE = Path("/proc/sys/kernel/random/boot_id"), Path("/proc/self/ns/pid")


@cache
def machine_mark() -> str:
    """Four hexadecimal digits that identify this machine, or this container, by which a process id is unique.

    They are the beginning of a digest of the host name and, on Linux, of the boot and of the process id namespace.
    Containers may have the same host name, and machines may be copies of one image.
    """
    parts = [socket.gethostname()]
    with suppress(OSError):
        parts.append(_BOOT_ID_FILE.read_text(encoding="ascii").strip())
    with suppress(OSError):
        parts.append(str(_PID_NAMESPACE_FILE.stat().st_ino))
    return hashlib.sha256(" ".join(parts).encode()).hexdigest()[:4]


def temporary_name(target: Path) -> Path:
    """A new name for a temporary file beside `target`. The name identifies this machine and process."""
    token = f"{machine_mark()}{os.getpid():08x}{secrets.token_hex(4)}"
    return target.with_name(f".{target.name}.{token}{TEMPORARY_SUFFIX}")


def is_abandoned(path: Path, token: str) -> bool:
    """True if the process that made a temporary file has ended.

    This cannot be checked for a process on another machine, or on Windows. There, a process counts as ended if the file
    has not changed for ABANDONED_FILE_SECONDS.

    token: the part of the file's name that identifies machine and process.
    """
    if token[:4] == machine_mark() and os.name == "posix":
        try:
            os.kill(int(token[4:12], 16), 0)
        except (ProcessLookupError, OverflowError):
            return True
        except PermissionError:
            pass
        return False
    return is_older(path, ABANDONED_FILE_SECONDS)


def is_older(path: Path, seconds: float) -> bool:
    """True if a file was last changed more than `seconds` ago, by the clock of its file system. Raises OSError.

    The clock of a shared folder may differ from this machine's by hours, in both directions. So a new file is made in
    the folder to compare with. If the folder cannot be written, this machine's clock counts.
    """
    changed, now = path.stat().st_mtime, time.time()
    with suppress(OSError), tempfile.NamedTemporaryFile(dir=path.parent, prefix=".clsplat-clock-") as probe:
        now = os.fstat(probe.fileno()).st_mtime
    return now - changed > seconds


def check_new(path: Path, *, overwrite: bool, sources: Iterable[Path] = ()) -> None:
    """Check that a file may be written at `path`.

    Raises InputError if the file exists and `overwrite` is not set, if `path` is a folder, or if its folder is missing.
    sources: files from which the new file is made. The message says if `path` is one of them.
    """
    if path.is_dir():
        raise InputError(f"{path}: is a folder, expected the name of a file to write")
    if not path.parent.is_dir():
        raise InputError(f"{path.parent}: no such folder, expected an existing one for {path.name}")
    if overwrite or not (path.exists() or path.is_symlink()):
        return
    if any(source.exists() and path.exists() and source.samefile(path) for source in sources):
        raise InputError(
            f"{path}: is an input, and would be replaced by the result; name another file, or give --overwrite to "
            "change it in place"
        )
    raise InputError(f"{path}: exists already; name another file, or give --overwrite to replace it")


@contextmanager
def atomic_name(path: str | os.PathLike[str], needs: int | None = None) -> Iterator[Path]:
    """Context manager that yields a temporary path, and renames its file to `path` at the end of the block.

    The temporary file is in the same folder, since a rename is atomic only within a file system. The folder must exist.
    A link at `path` is followed. On any exception, also KeyboardInterrupt, the temporary file is removed, and `path`
    stays as it was. Raises WriteError with the name `path` if the system refuses to write.

    needs: size of the file in bytes if it is known, for the message on a full disk.
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
            temporary.unlink()  # the file must not take disk space while `write_error` measures the free space
        names = (None, str(temporary), str(path))
        if isinstance(error, OSError) and error.errno and not isinstance(error, WriteError) and error.filename in names:
            # The system's error names the temporary file, or no file if the disk is full. Users know only `path`.
            raise write_error(path, error, written, needs) from None
        raise


@contextmanager
def atomic_writer(path: str | os.PathLike[str], needs: int | None = None) -> Iterator[BinaryIO]:
    """Context manager that yields a binary file to write. At the end it is flushed to disk and renamed to `path`.

    needs: size of the file in bytes if it is known, as in `atomic_name`.
    """
    # mode "x" instead of mkstemp, so that the file gets the permissions of the user's umask
    with atomic_name(path, needs) as temporary, open(temporary, "xb") as file:
        yield file
        file.flush()
        os.fsync(file.fileno())
    sync_folder(Path(os.path.realpath(path)).parent)


def write_error(path: str | os.PathLike[str], error: OSError, written: int = 0, needs: int | None = None) -> WriteError:
    """WriteError that says why the file `path` could not be written. For a full disk, it has the free and needed bytes.

    error: the system's error.
    written: bytes written so far, which the message gives as a lower limit if `needs` is None.
    needs: size of the file in bytes, if it is known.
    """
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
    """Write a small test file to a folder and remove it. Returns the system's error, or None.

    Use it after a library failed to write and reported no reason.
    """
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
"""Bytes that `require_room` has reserved on each disk, by the disk's number (st_dev)."""
_reserving = threading.Lock()


@contextmanager
def require_room(path: str | os.PathLike[str], needs: int) -> Iterator[None]:
    """Context manager that reserves `needs` bytes of disk space for a file. Raises WriteError if the disk has less.

    Use it for libraries that crash or report nothing when the disk is full. Space reserved by other threads of this
    process counts as used.
    """
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
    """Context manager that yields a temporary folder, for a library that writes files by name.

    Raises WriteError if the disk has less than `needs` bytes, or becomes full while the library writes. If the library
    raises an exception of its own, a test file is written to find out whether the disk is full.
    """
    # cleanup errors are ignored: Windows does not remove a file that the library still has open
    with tempfile.TemporaryDirectory(prefix="clsplat-", ignore_cleanup_errors=True) as name:
        folder = Path(name)
        try:
            with require_room(folder / "file", needs):
                yield folder
        except WriteError as error:
            if not str(error.filename).startswith(name):
                raise
            raise WriteError(error.errno or 0, f"{error.strerror} (TMPDIR sets another folder)", str(folder)) from None
        except (OSError, InputError, KeyboardInterrupt):
            raise
        except Exception:
            if refused := room_error(folder):
                raise write_error(folder, refused) from None
            raise


def atomic_write(path: str | os.PathLike[str], data: bytes) -> None:
    """Write a file atomically. `data` is its whole content."""
    with atomic_writer(path, len(data)) as file:
        file.write(data)


def sync_folder(folder: Path) -> None:
    """Flush a folder to disk, so that a rename survives a power cut. Windows and some network shares cannot do this."""
    with suppress(OSError):
        descriptor = os.open(folder, os.O_RDONLY)
        try:
            os.fsync(descriptor)
        finally:
            os.close(descriptor)


def replace(source: Path, target: Path) -> None:
    """Rename a file or a folder. An existing file at the target is replaced. Raises OSError."""
    _retry_on_windows(lambda: source.replace(target))


@contextmanager
def work_folder(output: Path) -> Iterator[Path]:
    """Context manager that yields a new hidden folder beside `output`, and removes it at the end.

    The block makes its result in a sub-folder, which `move_into_place` then renames to `output`.
    """
    work = temporary_name(Path(os.path.realpath(output)))
    work.mkdir(parents=True)
    try:
        yield work
    finally:
        shutil.rmtree(work, ignore_errors=True)


def move_into_place(*moves: tuple[Path, Path]) -> None:
    """Rename finished folders, which are in a `work_folder`, to their outputs, in place of earlier folders.

    moves: the finished folder and the output of each rename.
    If a rename fails, all earlier folders are restored. Raises OSError.
    """
    begun: list[tuple[Path, Path, Path]] = []
    try:
        for made, output in moves:
            target, earlier = Path(os.path.realpath(output)), made.with_name(f"{made.name}.earlier")
            begun.append((made, target, earlier))
            if target.exists():
                replace(target, earlier)
            replace(made, target)
    except BaseException:
        for made, target, earlier in reversed(begun):
            if target.exists() and not made.exists():
                replace(target, made)
            if earlier.exists():
                replace(earlier, target)
        raise


def remove(path: Path) -> None:
    """Remove a file if it exists. Raises OSError."""
    _retry_on_windows(lambda: path.unlink(missing_ok=True))


def _retry_on_windows(act: Callable[[], object], *, windows: bool = ON_WINDOWS) -> None:
    """Call `act`. On Windows, repeat the call for WINDOWS_RETRY_SECONDS while another program has the file open.

    windows: True to behave as on Windows.
    """
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
