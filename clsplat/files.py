# SPDX-License-Identifier: Apache-2.0
"""Writing files so that a crash, Ctrl-C or a full disk leaves the previous file whole; opening files of others; names
that a system takes."""

from __future__ import annotations

import errno
import hashlib
import json
import os
import re
import secrets
import shutil
import socket
import stat
import sys
import tempfile
import threading
import time
import unicodedata
from collections.abc import Callable, Iterable, Iterator
from contextlib import contextmanager, suppress
from functools import cache
from pathlib import Path, PurePath, PurePosixPath, PureWindowsPath
from typing import Any, BinaryIO

from clsplat.errors import InputError, WriteError, amount, reason_of

TEMPORARY_SUFFIX = ".clsplat-tmp"
MAX_DOCUMENT = 32 << 20
"""Bytes of a JSON or TOML file: as Python's objects they take up to 24 times as much."""
LFS_POINTER = b"version https://git-lfs.github.com/spec/v1"
MAX_POINTER = 1024
"""First bytes, and most bytes, of the note that Git LFS leaves in place of a file
(https://github.com/git-lfs/git-lfs/blob/main/docs/spec.md)."""
ABANDONED = 600.0
"""Seconds without a write after which a temporary file of another machine counts as abandoned."""
UNWRITTEN = 20
"""Seconds after which a claim in which nothing stands is taken over."""
FULL = (errno.ENOSPC, errno.EDQUOT)
PROBE = 1 << 16
"""Bytes that are written to find out whether a disk has room."""
WINDOWS = os.name == "nt"
IGNORES_CASE = sys.platform in ("win32", "darwin")
"""True if the system's usual file systems take A.png and a.png for one file, and an accented letter for its parts."""
CLAIM_SUFFIX = ".clsplat-claim"
_PROCESS = secrets.token_hex(4)
"""Mark that tells this process from one of the same number, before it or on another machine."""
PATIENCE = 2.0
"""Seconds in which a file on Windows that another program has open is tried again: a virus scanner or an indexer lets
go of a new file within one."""
_REFUSED = re.compile(r'[<>:"|?*\x00-\x1f]')
_DEVICE = re.compile(r"(con|prn|aux|nul|conin\$|conout\$|(com|lpt)[0-9¹²³]) *(\..*)?", re.IGNORECASE | re.DOTALL)
_TEMPORARY = re.compile(rf"\.(.+)\.([0-9a-f]{{20}}){re.escape(TEMPORARY_SUFFIX)}", re.DOTALL)


@cache
def _machine() -> str:
    return hashlib.sha256(socket.gethostname().encode()).hexdigest()[:4]


def temporary_name(target: Path) -> Path:
    """A new name beside a file, which says what machine and process writes there."""
    token = f"{_machine()}{os.getpid():08x}{secrets.token_hex(4)}"
    return target.with_name(f".{target.name}.{token}{TEMPORARY_SUFFIX}")


def _is_abandoned(path: Path, token: str) -> bool:
    if token[:4] == _machine() and os.name == "posix":
        try:
            os.kill(int(token[4:12], 16), 0)
        except (ProcessLookupError, OverflowError):
            return True
        except PermissionError:
            pass
        return False
    return time.time() - path.stat().st_mtime > ABANDONED


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
    if number in FULL:
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
            file.write(os.urandom(PROBE))
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


@contextmanager
def locked(path: Path, seconds: float = 5.0) -> Iterator[None]:
    """Inside, no other process is inside with this file, which need not be there: FILE.lock beside it says so.

    It is no lock of the system's, unlike `locks.locked`: those do not keep a process's own threads apart, and homes on
    a network, where this is used, may have none. A lock older than `seconds` is of a process that was killed, and is
    taken away. After waiting for twice as long a process goes on without. Raises OSError where the folder cannot be
    written.
    """
    lock, token = path.with_name(f"{path.name}.lock"), secrets.token_bytes(8)
    until = time.monotonic() + 2 * seconds
    while not (ours := _take(lock, token)) and time.monotonic() < until:
        with suppress(OSError):
            if time.time() - lock.stat().st_mtime > seconds:
                lock.unlink()
        time.sleep(0.005)
    try:
        yield
    finally:
        if ours:
            with suppress(OSError):  # it may have been taken away, and another's be there
                if lock.read_bytes() == token:
                    remove(lock)


def claim(target: Path) -> Path | None:
    """A file beside `target` that tells other processes that this one makes it, for `give_back`; None where another
    has claimed it. It has to be touched now and then: one that has not been for ABANDONED seconds is taken over, as is
    that of a process that has ended. Raises OSError where the folder cannot be written."""
    path = _claim_of(target)
    for _ in range(2):
        if _take(path, f"{_machine()}{os.getpid():08x}{_PROCESS}".encode()):
            return path
        try:
            if not _is_given_up(path):
                return None
            path.unlink()
        except (FileNotFoundError, PermissionError):  # given back, or taken over
            continue
    return None


def _claim_of(target: Path) -> Path:
    return target.with_name(f".{target.name}{CLAIM_SUFFIX}")


def _is_given_up(claimed: Path) -> bool:
    age = time.time() - claimed.stat().st_mtime
    if age > ABANDONED:
        return True
    token = claimed.read_text(encoding="ascii", errors="replace")
    if not token:  # it is just being written, or its process was killed as it did
        return age > UNWRITTEN
    if (
        token[:12] == f"{_machine()}{os.getpid():08x}"
    ):  # a process before this one, of the same number, as in containers
        return token[12:] != _PROCESS
    return _is_abandoned(claimed, token)


def give_back(claimed: Path) -> None:
    """Let others make what was claimed."""
    with suppress(FileNotFoundError):
        remove(claimed)


def _take(lock: Path, token: bytes) -> bool:
    try:
        file = lock.open("xb", buffering=0)
    except FileExistsError:
        return False
    except PermissionError:  # Windows says so of a file that is being removed
        if not WINDOWS:
            raise
        return False
    try:
        with file:
            file.write(token)
    except OSError:
        lock.unlink()
        raise
    return True


def replace(source: Path, target: Path) -> None:
    """Rename a file or a folder, in the place of a file that is there. Raises OSError."""
    _patiently(lambda: source.replace(target))


def remove(path: Path) -> None:
    """Remove a file, if it is there. Raises OSError."""
    _patiently(lambda: path.unlink(missing_ok=True))


def _patiently(act: Callable[[], object], *, windows: bool = WINDOWS) -> None:
    """Do it; again and again for a while where Windows says that another program has the file open."""
    until = time.monotonic() + PATIENCE
    while True:
        try:
            act()
        except PermissionError:
            if not windows or time.monotonic() > until:
                raise
            time.sleep(0.02)
        else:
            return


def name_trouble(name: str, *, windows: bool = WINDOWS) -> str | None:
    """The reason that no file below a folder can be called `name`, with its sub-folders before slashes; None where one
    can."""
    pure: PurePath = PureWindowsPath(name) if windows else PurePosixPath(name)
    if pure.anchor or ".." in pure.parts:
        return "leads out of the output folder"
    if not pure.name or "\0" in name:
        return "is no name for a file"
    if windows:
        for part in pure.parts:
            if character := _REFUSED.search(part):
                return f"has {character[0]!r} in it, which no name of a file on Windows may have"
            if _DEVICE.fullmatch(part):
                return f"is a name that Windows keeps for a device ({part})"
            if part[-1] in ". ":
                return f"ends {part!r} with a dot or a space, which Windows drops"
    return None


def native_name(path: str | os.PathLike[str]) -> str:
    """The name of a file for a library that takes names in UTF-8, whatever the locale says. Raises InputError."""
    try:
        return os.fsencode(path).decode("utf-8")
    except UnicodeError:
        raise InputError(f"{path}: has a name that is no text in UTF-8; rename it") from None


def identity(path: PurePath, *, ignores_case: bool = IGNORES_CASE) -> str:
    """Equal for two paths that the system takes for one file, whatever links there are."""
    text = str(path)
    return unicodedata.normalize("NFC", text).casefold() if ignores_case else text


def abandoned(targets: Iterable[Path]) -> list[Path]:
    """The temporary files and claims that writers of these files have left: their process has ended, or they are of
    another machine and have not been written to for ABANDONED seconds."""
    names: dict[Path, set[str]] = {}
    for target in targets:
        real = Path(os.path.realpath(target))
        names.setdefault(real.parent, set()).add(real.name)
    result = []
    for folder, wanted in names.items():
        with suppress(OSError):
            for entry in os.scandir(folder):
                match = _TEMPORARY.fullmatch(entry.name)
                if match and match[1] in wanted and _is_abandoned(path := Path(entry.path), match[2]):
                    result.append(path)
        for name in wanted:
            path = _claim_of(folder / name)
            with suppress(OSError):
                if _is_given_up(path):
                    result.append(path)
    return sorted(result)


def digest(path: str | os.PathLike[str]) -> str:
    """SHA-256 of the file's content, in hexadecimal. Raises OSError."""
    return _digest(path, hashlib.sha256())


def short_digest(path: Path) -> str | None:
    """BLAKE2b of 16 bytes of the file's content, in hexadecimal, which is quicker; None where there is no file."""
    return _digest(path, hashlib.blake2b(digest_size=16)) if is_file(path) else None


def _digest(path: str | os.PathLike[str], state: Any) -> str:
    with open(path, "rb") as file:
        while block := file.read(1 << 20):
            state.update(block)
    digits: str = state.hexdigest()
    return digits


def _sync_folder(folder: Path) -> None:
    """Make a rename last through a power cut, where the file system can (not on Windows, nor on some shares)."""
    with suppress(OSError):
        descriptor = os.open(folder, os.O_RDONLY)
        try:
            os.fsync(descriptor)
        finally:
            os.close(descriptor)


def is_file(path: str | os.PathLike[str]) -> bool:
    """True if there is a regular file; False, and no exception, for a name that no file can have."""
    try:
        return stat.S_ISREG(Path(path).stat().st_mode)
    except (OSError, ValueError):
        return False


@contextmanager
def open_input(path: Path, expected: str) -> Iterator[BinaryIO]:
    """Open a file to read it.

    `expected` ends the message of the InputError for one that is missing, a folder, or anything else that is no regular
    file, such as a pipe, which may never be written to; for one that cannot be read; and for Git LFS's note in place of
    one that was not fetched.
    """
    try:
        status = path.stat()
        mode = status.st_mode
        if stat.S_ISDIR(mode):
            raise InputError(f"{path}: is a folder, expected {expected}")
        if not stat.S_ISREG(mode):
            raise InputError(f"{path}: is no regular file, expected {expected}")
        file = open(path, "rb")  # noqa: SIM115  # closed below
    except FileNotFoundError:
        raise InputError(f"{path}: no such file, expected {expected}") from None
    except (OSError, ValueError) as error:  # ValueError: a zero byte in the name
        raise InputError(
            f"{path}: cannot be read ({reason_of(error) if isinstance(error, OSError) else error}), expected {expected}"
        ) from None
    with file:
        try:
            if status.st_size < MAX_POINTER:
                if file.read(len(LFS_POINTER)) == LFS_POINTER:
                    raise InputError(f"{path}: is Git LFS's note of a file that is not here; git lfs pull fetches it")
                file.seek(0)
            yield file
        except WriteError:
            raise
        except OSError as error:
            raise InputError(f"{path}: cannot be read ({reason_of(error)}), expected {expected}") from None


def read_document(path: Path, expected: str, limit: int = MAX_DOCUMENT) -> str:
    """The text of a file in UTF-8 of at most `limit` bytes, without the mark of the byte order that editors on Windows
    put before it. Raises InputError as `open_input`."""
    with open_input(path, expected) as file:
        data = file.read(limit + 1)
    if len(data) > limit:
        raise InputError(f"{path}: has more than {limit >> 20} MiB, expected {expected}")
    try:
        return data.decode("utf-8-sig")
    except UnicodeDecodeError as error:
        raise InputError(f"{path}: is not text in UTF-8 (byte {error.start}), expected {expected}") from None


def _once(pairs: list[tuple[str, Any]]) -> dict[str, Any]:
    result = dict(pairs)
    if len(result) < len(pairs):
        names = [name for name, _ in pairs]
        twice = next(name for name in result if names.count(name) > 1)
        raise ValueError(f"the key {twice[:40]!r} is there twice")
    return result


def parse_json(text: str | bytes, *, once: bool = False) -> Any:
    """The value. Raises ValueError for whatever does not parse, nested too deeply too. once: also for a key that an
    object has twice, of which the last would count."""
    try:
        return json.loads(text, object_pairs_hook=_once if once else None)
    except RecursionError:
        raise ValueError("it is nested too deeply") from None
