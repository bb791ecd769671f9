# SPDX-License-Identifier: Apache-2.0
"""report.html, what a run came to in one file, and runs side by side (docs/report.md).

`figures` reads a run, `svg` draws, `thumbnails` embeds, `page` and `compare` put pages together; `training.telemetry`
is what training notes for them.
"""

from __future__ import annotations

from pathlib import Path

from clsplat.errors import InputError
from clsplat.files import check_new

NAME = "report.html"
"""File name of the report in a run's folder."""


def check_page(path: Path, *, overwrite: bool) -> None:
    """Raise InputError where no page may be written at `path`, as `check_new`, or by its name."""
    check_new(path, overwrite=overwrite)
    if path.suffix.lower() not in (".html", ".htm"):
        raise InputError(f"{path}: its ending is {path.suffix or 'none'}, expected .html or .htm: a page is written")
