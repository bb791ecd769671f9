# SPDX-License-Identifier: Apache-2.0
"""`clsplat report` and `clsplat compare`: pages of runs, and the same figures as JSON."""

from __future__ import annotations

import sys
from contextlib import nullcontext

from clsplat.cli.options import Compare, Report
from clsplat.errors import InputError, plain
from clsplat.files import check_new
from clsplat.runs.locks import locked
from clsplat.runs.run import Run


def report(verb: Report) -> int:
    """Write the page of a run."""
    run = Run.open(verb.run)
    if verb.views < 0:
        raise InputError(f"--views {verb.views}: expected at least 0")
    path = verb.output or run.path / "report.html"
    check_new(path, overwrite=verb.overwrite or verb.output is None)
    from clsplat.report.page import json_text, write_report

    with nullcontext() if verb.output else locked(run.path, "report"):
        figures = write_report(run, path, views=verb.views)
    if verb.json:
        print(json_text(figures.document()))
    for note in figures.notes:
        print(f"clsplat: warning: {plain(note)}", file=sys.stderr)
    print(f"report in {path}", file=sys.stderr)
    return 0


def compare(verb: Compare) -> int:
    """Print runs side by side, and write their page."""
    if len(verb.runs) < 2:
        raise InputError(f"{verb.runs[0]}: expected at least two runs to compare")
    runs = [Run.open(path) for path in verb.runs]
    if verb.output is not None:
        check_new(verb.output, overwrite=verb.overwrite)
    from clsplat.report.compare import compare_runs, comparison_table, write_comparison
    from clsplat.report.page import json_text

    found = compare_runs(runs)
    if verb.output is not None:
        write_comparison(found, verb.output)
        print(f"page in {verb.output}", file=sys.stderr)
    print(json_text(found.document()) if verb.json else comparison_table(found))
    for note in found.notes:
        print(f"clsplat: warning: {plain(note)}", file=sys.stderr)
    return 0
