# SPDX-License-Identifier: Apache-2.0
"""`clsplat report`: HTML report of a run."""

from __future__ import annotations

import json
import sys
from contextlib import nullcontext
from dataclasses import dataclass
from pathlib import Path
from typing import Annotated

from tyro.conf import Positional, arg

from clsplat.cli.options import Flag, OutputFile, Verb
from clsplat.cli.session import Services
from clsplat.errors import InputError, warn


@dataclass(frozen=True)
class ReportVerb(Verb):
    """Write a run's report: one self-contained HTML file with curves, pictures, figures and settings.

    docs/report.md describes its content. Unfinished runs can have reports too.
    """

    run: Annotated[Positional[Path], arg(metavar="RUN")]
    """A run's folder."""
    output: OutputFile = None
    """Output file. If not given: report.html in the run's folder."""
    overwrite: Flag = False
    """Replace an existing file of --output."""
    views: int = 8
    """Largest number of held-out views with pictures: the worst, the best and some between. The table has all views."""
    json: Flag = False
    """Print the figures as JSON."""


def run(verb: ReportVerb, _: Services) -> int:
    """Write the run's report, and print its figures with --json."""
    from clsplat.report import check_page
    from clsplat.report.page import write_report
    from clsplat.runs.locks import locked
    from clsplat.runs.run import Run

    run = Run.open(verb.run)
    if verb.views < 0:
        raise InputError(f"--views {verb.views}: expected at least 0")
    path = verb.output or run.path / "report.html"
    check_page(path, overwrite=verb.overwrite or verb.output is None)
    with nullcontext() if verb.output else locked(run.path, "report"):
        numbers = write_report(run, path, views=verb.views)
    if verb.json:
        print(json.dumps(numbers.document(), indent=2, allow_nan=False))
    for note in numbers.notes:
        warn(note)
    print(f"report in {path}", file=sys.stderr)
    return 0
