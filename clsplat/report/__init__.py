# SPDX-License-Identifier: Apache-2.0
"""HTML pages: report.html with the results of a run, and the comparison of runs (docs/report.md).

`run_numbers` reads the numbers of a run, `charts` draws charts as SVG, `thumbnails` embeds pictures, `page` and
`compare` build the pages. `training.telemetry` records their input during training.
"""

from __future__ import annotations

from pathlib import Path

from clsplat.errors import InputError
from clsplat.files.atomic import check_new

REPORT_FILE_NAME = "report.html"
"""Name of the report's file in a run folder."""


def check_page(path: Path, *, overwrite: bool) -> None:
    """Raise InputError if a page cannot be written to `path`: `check_new` refuses it, or its ending is not HTML's."""
    check_new(path, overwrite=overwrite)
    if path.suffix.lower() not in (".html", ".htm"):
        raise InputError(f"{path}: its ending is {path.suffix or 'none'}, expected .html or .htm for a web page")
