# SPDX-License-Identifier: Apache-2.0
"""Folder for files of the user that clsplat can make or fetch again."""

from __future__ import annotations

import os
from pathlib import Path


def cache_folder() -> Path:
    """Return $XDG_CACHE_HOME/clsplat or ~/.cache/clsplat; without a home folder, a path that cannot be written to."""
    try:
        return Path(os.environ.get("XDG_CACHE_HOME") or Path.home() / ".cache") / "clsplat"
    except RuntimeError:
        return Path(os.devnull) / "clsplat"
