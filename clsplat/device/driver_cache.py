# SPDX-License-Identifier: Apache-2.0
"""A place for what a driver builds, where the user's home can take nothing."""

from __future__ import annotations

import atexit
import os
import shutil
import tempfile
from collections.abc import MutableMapping
from pathlib import Path


def make_room(environment: MutableMapping[str, str] = os.environ) -> Path | None:
    """Give PoCL a folder for this process and its children, where it could not make its own below the home.

    PoCL shows no device at all then, as if it were not installed. Returns the folder, which goes when this process
    ends; None where nothing had to be done, or could be. Call it before a driver is loaded.
    """
    if os.name == "nt" or environment.get("POCL_CACHE_DIR"):
        return None
    home = environment.get("HOME")
    base = environment.get("XDG_CACHE_HOME") or (f"{home}/.cache" if home else "")
    if not base or _can_be_made(Path(base) / "pocl" / "kcache"):
        return None
    try:
        folder = tempfile.mkdtemp(prefix="clsplat-pocl-")
    except OSError:
        return None
    owner = os.getpid()

    def remove() -> None:
        if os.getpid() == owner:  # and not a fork of it
            shutil.rmtree(folder, ignore_errors=True)

    atexit.register(remove)
    environment["POCL_CACHE_DIR"] = folder
    return Path(folder)


def _can_be_made(folder: Path) -> bool:
    """True if files can be put there, once folders that are missing are made."""
    for place in (folder, *folder.parents):
        if os.path.lexists(place):
            return place.is_dir() and os.access(place, os.W_OK | os.X_OK)
    return False
