# SPDX-License-Identifier: Apache-2.0
"""Exceptions for users, warnings, and texts for their messages.

The command line prints an exception as one line, and ends with the exception's `exit_status`."""

from __future__ import annotations

import errno
import os
import warnings
from collections.abc import Iterable, Iterator
from contextlib import contextmanager


class ClsplatError(Exception):
    """Base class of errors that are reported as one line. Its exit status, 1, means that the work failed."""

    exit_status = 1


def plain(text: str) -> str:
    """Escape characters that are not printable, such as line breaks, since names in hostile files may contain them."""
    return "".join(char if char.isprintable() else char.encode("unicode_escape").decode() for char in text)


def warn(text: str) -> None:
    """Issue a Python warning of one line, attributed to the caller. The command line prints warnings of clsplat."""
    warnings.warn(plain(text), stacklevel=2)


def examples(names: Iterable[object], most: int = 3) -> str:
    """A text such as "a, b, c and 4 more": the first `most` items of a list, and the number of the others."""
    listed = [str(name) for name in names]
    more = len(listed) - most
    return ", ".join(listed[:most]) + (f" and {more:,} more" if more > 0 else "")


def amount(nbytes: int) -> str:
    """A number of bytes as text, in the largest unit in which it has at least two digits."""
    for unit, name in ((2**30, "GiB"), (2**20, "MiB"), (2**10, "KiB")):
        if nbytes >= 10 * unit or (unit == 2**30 and nbytes >= unit):
            return f"{nbytes / unit:,.1f} {name}" if unit == 2**30 else f"{nbytes / unit:,.0f} {name}"
    return f"{nbytes:,} bytes"


class InputError(ClsplatError):
    """Error about a wrong file, folder or argument (exit status 2).

    The message is one line with the wrong value and the expected one.
    """

    exit_status = 2

    def __init__(self, message: str = "") -> None:
        super().__init__(plain(message))


class WriteError(ClsplatError, OSError):
    """Error about a file that cannot be written. It has the system's error number, the reason in plain words, and the
    file's name.

    The exit status is 2 if the name is wrong, else 1.
    """

    def __init__(self, number: int, reason: str, path: str) -> None:
        OSError.__init__(self, number, reason, path)
        self.exit_status = 2 if number in _BAD_PATH_ERRNOS else 1

    def __str__(self) -> str:
        return plain(f"{self.filename}: cannot be written: {self.strerror}")


_BAD_PATH_ERRNOS = (errno.ENOENT, errno.EISDIR, errno.ENOTDIR, errno.ENAMETOOLONG)
_REASON_BY_ERRNO = {
    errno.ENOSPC: "the disk is full",
    errno.EDQUOT: "the disk's quota is used up",
    errno.EFBIG: "the file is larger than the system allows",
    errno.EIO: "the disk does not answer as it should (input/output error)",
    errno.EROFS: "the disk is read-only",
    errno.EACCES: "permission is denied",
    errno.EPERM: "permission is denied",
    errno.ENOENT: "there is no such file or folder",
    errno.ENOTDIR: "a part of the path is a file, not a folder",
    errno.EISDIR: "it is a folder",
    errno.ENAMETOOLONG: "the name is too long",
    errno.EMFILE: "too many files are open",
}


def reason_of(error: OSError) -> str:
    """The system's reason for an error, in plain words."""
    return _REASON_BY_ERRNO.get(error.errno or 0) or error.strerror or str(error) or type(error).__name__


def system_trouble(error: OSError) -> str:
    """One line about a system error that clsplat has no message for: the file and the reason."""
    names = [os.fsdecode(name) for name in (error.filename, error.filename2) if isinstance(name, str | bytes)]
    return plain(": ".join([" to ".join(names), reason_of(error)] if names else [reason_of(error)]))


def switched_on(variable: str) -> bool:
    """True if an environment variable is 1, False if it is unset, empty or 0. Raises InputError for any other value."""
    value = os.environ.get(variable, "")
    if value not in ("", "0", "1"):
        raise InputError(f"{variable}={value}: expected 1, or 0")
    return value == "1"


class DeviceError(InputError):
    """Error if no OpenCL device is found, or no device that matches the request."""


@contextmanager
def of_argument() -> Iterator[None]:
    """Context manager: make the messages of DeviceErrors name the Python argument `device`, not the flag --device."""
    try:
        yield
    except DeviceError as error:
        raise DeviceError(str(error).replace("--device ", "device ")) from None


class KernelBuildError(ClsplatError):
    """Error about a kernel that a driver refused to build.

    The message has the device, the build options and the log's first error. `log` has the whole log. `source` has the
    source with the line numbers that the log uses. CLSPLAT_DEBUG=1 shows both.
    """

    def __init__(self, message: str, log: str, source: str) -> None:
        super().__init__(message)
        self.log, self.source = log, source

    def __str__(self) -> str:
        debug = os.environ.get("CLSPLAT_DEBUG") == "1"
        return f"{self.args[0]}\n{self.log}\n{self.source}" if debug else str(self.args[0])


class DriverError(ClsplatError):
    """Error about a driver that aborted, hung, returned an invalid kernel or failed in a command.

    The message names the driver. If a kernel failed, it also names the kernel and its shape.
    """


class CapacityError(ClsplatError):
    """Error if a buffer would exceed the device's limit, or all buffers together would exceed --max-device-mem."""
