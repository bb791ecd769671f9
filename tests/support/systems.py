# SPDX-License-Identifier: Apache-2.0
"""Requirements of tests that not every operating system meets."""

from __future__ import annotations

import errno
import os
import tempfile
from functools import cache
from pathlib import Path

import pytest
from calls import noted


@cache
def can_link() -> bool:
    """True if this user may make symbolic links, which requires a privilege on Windows."""
    with tempfile.TemporaryDirectory() as folder:
        try:
            (Path(folder) / "link").symlink_to("target")
        except OSError:
            return False
    return True


def locked(monkeypatch: pytest.MonkeyPatch, folder: Path) -> None:
    """Make a folder that this process cannot list, even as root."""
    folder.mkdir()

    def refuse(path: object = ".") -> None:
        if str(path) == str(folder):
            raise PermissionError(errno.EACCES, os.strerror(errno.EACCES), str(path))

    noted(monkeypatch, os, "scandir", refuse)


posix = pytest.mark.skipif(os.name != "posix", reason="needs POSIX signals, pipes or file modes")
links = pytest.mark.skipif(not can_link(), reason="this user may not make symbolic links")


def alive(pid: int) -> bool:
    """True if a process runs; a process that has ended but was not waited for does not."""
    try:
        os.kill(pid, 0)
    except ProcessLookupError:
        return False
    stat = Path(f"/proc/{pid}/stat")
    return not (stat.exists() and stat.read_text().rpartition(")")[2].split()[0] == "Z")
