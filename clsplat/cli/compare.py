# SPDX-License-Identifier: Apache-2.0
"""`clsplat compare`: table and HTML page that compare the results of several runs."""

from __future__ import annotations

import json
import sys
from dataclasses import dataclass
from pathlib import Path
from typing import Annotated

from tyro.conf import Positional, arg

from clsplat.cli.options import Flag, OutputFile, Verb
from clsplat.cli.session import Services
from clsplat.errors import InputError, warn


@dataclass(frozen=True)
class CompareVerb(Verb):
    """Compare runs in a table: scores, Gaussians, times, and the settings that differ."""

    runs: Annotated[Positional[tuple[Path, ...]], arg(metavar="RUN")]
    """Folders of two or more runs."""
    output: OutputFile = None
    """Also write one self-contained HTML page with overlaid curves and a chart of PSNR against time."""
    overwrite: Flag = False
    """Replace an existing page."""
    json: Flag = False
    """Print JSON instead of the table."""


def run(verb: CompareVerb, _: Services) -> int:
    """Print the comparison of the runs, and with --output write it as an HTML page."""
    from clsplat.files.atomic import atomic_write
    from clsplat.report import check_page
    from clsplat.report.compare import compare_runs, comparison_page, comparison_table
    from clsplat.runs.run import Run

    if len(verb.runs) < 2:
        raise InputError(f"{verb.runs[0]}: expected at least two runs to compare")
    runs = [Run.open(path) for path in verb.runs]
    if verb.output is not None:
        check_page(verb.output, overwrite=verb.overwrite)
    comparison = compare_runs(runs)
    if verb.output is not None:
        atomic_write(verb.output, comparison_page(comparison).encode("utf-8", "replace"))
        print(f"page in {verb.output}", file=sys.stderr)
    print(json.dumps(comparison.document(), indent=2, allow_nan=False) if verb.json else comparison_table(comparison))
    for note in comparison.notes:
        warn(note)
    return 0
