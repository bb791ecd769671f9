# SPDX-License-Identifier: Apache-2.0
"""The errors that a user can meet. The command line turns them into one line and an exit status."""

from __future__ import annotations

import os


class ClsplatError(Exception):
    """Base of every error that is reported as one line: the work failed (exit status 1)."""

    exit_status = 1


def plain(text: str) -> str:
    """`text` as one line that any terminal shows as it is: names in hostile files may hold anything."""
    return "".join(each if each.isprintable() else each.encode("unicode_escape").decode() for each in text)


class InputError(ClsplatError):
    """A file, folder or argument is wrong (exit status 2). The message, one line, names it, and what was expected."""

    exit_status = 2

    def __init__(self, message: str = "") -> None:
        super().__init__(plain(message))


class DeviceError(InputError):
    """No OpenCL device, or not the one asked for."""


class KernelBuildError(ClsplatError):
    """A driver refused a kernel. The message has the device, the options and the log's first error; `log` and `source`,
    with its lines numbered as the log counts them, have the rest, which CLSPLAT_DEBUG=1 shows."""

    def __init__(self, message: str, log: str, source: str) -> None:
        super().__init__(message)
        self.log, self.source = log, source

    def __str__(self) -> str:
        return f"{self.args[0]}\n{self.log}\n{self.source}" if os.environ.get("CLSPLAT_DEBUG") else str(self.args[0])


class DriverError(ClsplatError):
    """A driver aborted, hung, or gave what is no kernel. The message has the driver, the shape and the kernel."""


class CapacityError(ClsplatError):
    """A buffer would be larger than the device allows, or all of them together than --max-device-mem does."""
