# SPDX-License-Identifier: Apache-2.0
"""HTML reports: report.html with the results of a run, and the page that compares runs (docs/report.md).

`run_numbers` reads the numbers of a run, `charts` draws charts as SVG, `thumbnails` embeds pictures, `page` and
`compare` build the pages. `training.telemetry` records their input during training.
"""

from __future__ import annotations

from pathlib import Path

from clsplat.errors import InputError
from clsplat.files.atomic import check_new

REPORT_FILE_NAME = "report.html"
"""Name of the report's file in a run folder."""
PLAN_PICTURE_FILE = "plan.svg"
"""Name, in a run folder, of the picture of the plan by which the scene was trained in blocks."""


def check_page(path: Path, *, overwrite: bool) -> None:
    """Raise InputError if `path` may not be written (`check_new`), or if its ending is not .html or .htm."""
    check_new(path, overwrite=overwrite)
    if path.suffix.lower() not in (".html", ".htm"):
        raise InputError(f"{path}: its ending is {path.suffix or 'none'}, expected .html or .htm for a web page")
