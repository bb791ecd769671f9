# SPDX-License-Identifier: Apache-2.0
"""What tests need of a system that not every one has."""

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
    """Whether this user may make symbolic links: on Windows that takes a right."""
    with tempfile.TemporaryDirectory() as folder:
        try:
            (Path(folder) / "link").symlink_to("target")
        except OSError:
            return False
    return True


def locked(monkeypatch: pytest.MonkeyPatch, folder: Path) -> None:
    """Make a folder that this user may not look into, root neither."""
    folder.mkdir()

    def refuse(path: object = ".") -> None:
        if str(path) == str(folder):
            raise PermissionError(errno.EACCES, os.strerror(errno.EACCES), str(path))

    noted(monkeypatch, os, "scandir", refuse)


posix = pytest.mark.skipif(os.name != "posix", reason="needs signals, pipes or modes of files as POSIX has them")
links = pytest.mark.skipif(not can_link(), reason="this user may not make symbolic links")
